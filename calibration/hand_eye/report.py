"""What a hand-eye calibration found, for programs and for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calibration.gates import HandEyeGates
from calibration.hand_eye.comparison import ClosedForm, rms_of
from calibration.hand_eye.leave_out import in_outer_frame, misses_of, mistakes
from calibration.hand_eye.next_poses import NextPose
from calibration.hand_eye.observations import Observations
from calibration.hand_eye.pictures import by_pose
from calibration.hand_eye.single_pose import align
from calibration.hand_eye.solution import Solution
from calibration.outcome import SCHEMA, Figures
from surfclass.types import Float64

_SHIFT, _TURN = slice(3, 6), slice(0, 3)


def result_of(
    solution: Solution,
    seen: Observations,
    forms: Mapping[str, ClosedForm],
    proposals: Sequence[NextPose],
    verdict: str,
    reasons: Sequence[str],
) -> dict[str, Any]:
    """Returns what `--json` writes, but for the provenance."""
    problem, fit, left = solution.problem, solution.fit, solution.left_out
    eye, fixed = (
        ("flange_T_camera", "base_T_target") if problem.in_hand else ("base_T_camera", "flange_T_target")
    )
    rms = rms_of(problem, fit, misses_of(problem, fit.state))
    adjusted = rms_of(problem, fit, misses_of(problem, fit.state, deviated=True))
    out = (None, None) if left is None else rms_of(problem, fit, left.misses)
    return {
        "schema": SCHEMA,
        "verdict": verdict,
        "reasons": list(reasons),
        "mounting": seen.mounting,
        eye: fit.state.x.tolist(),
        fixed: target_pose(solution).tolist(),
        "intrinsics": _intrinsics(solution, seen),
        "rms_px": rms[0],
        "rms_m": rms[1],
        "leave_one_out_px": out[0],
        "leave_one_out_m": out[1],
        "adjusted_rms_px": adjusted[0],
        "adjusted_rms_m": adjusted[1],
        "jackknife_sd": _split(solution.sd),
        "formal_sd": _split(np.sqrt(np.diag(in_outer_frame(fit, fit.covariance)))),
        "camera_share": _split(solution.camera_sd),
        "covariance_rotation_translation": solution.covariance.tolist(),
        "outlier_poses": outlier_numbers(solution),
        "poses": _poses(solution, seen),
        "noise": _noise(solution),
        "points": {
            "target": len(problem.target),
            "pixels": len(problem.pixels.pose),
            "positions": len(problem.positions.pose),
            "mistaken": int(mistakes(fit.pixel_weight).sum() + mistakes(fit.position_weight).sum()),
            "probed": len(problem.probed),
        },
        "scale": None if solution.scale is None else dict(zip(("value", "sd"), solution.scale, strict=True)),
        "closed_forms": {name: _form(form, eye) for name, form in forms.items()},
        "arm": _arm(solution),
        "next_poses": [
            {"base_T_flange": one.base_T_flange.tolist(), "words": one.words, "gain": one.gain}
            for one in proposals
        ],
    }


def outlier_numbers(solution: Solution) -> list[int]:
    """Returns which of the observations' poses do not fit, by their places in the file."""
    return sorted(int(number) for number in solution.problem.order[~solution.fit.keep])


def outlier_sentences(solution: Solution, seen: Observations) -> list[str]:
    """Returns what is wrong with each pose that does not fit."""
    sentences = []
    left = solution.left_out
    for place in np.flatnonzero(~solution.fit.keep):
        number = int(solution.problem.order[place])
        how = ""
        if left is not None:
            turn, shift = (float(np.linalg.norm(left.deviation[place][part])) for part in (_TURN, _SHIFT))
            how = f": its arm pose is {1e3 * shift:.2f} mm and {np.degrees(turn):.3f}° off by the other poses"
        sentences.append((number, f"pose {_called(number, seen)} does not fit and is left out{how}"))
    return [sentence for _, sentence in sorted(sentences)]


def failures(solution: Solution, seen: Observations, gates: HandEyeGates) -> list[str]:
    """Returns which limits are not kept, a sentence each with the figure and what is allowed."""
    reasons = []
    wrong = outlier_numbers(solution)
    if len(wrong) > gates.outlier_poses:
        reasons += outlier_sentences(solution, seen)
        reasons.append(
            f"{len(wrong)} of {solution.problem.poses} poses left out, allowed are {gates.outlier_poses}: "
            "capture again where they are, or take them out of the set"
        )
    if solution.left_out is None:
        count = int(solution.fit.keep.sum())
        reasons.append(f"{count} poses leave nothing to check the result with; take 12 or more")
    shift, turn = float(solution.sd[_SHIFT].max()), float(solution.sd[_TURN].max())
    if shift > gates.translation_sd_m:
        reasons.append(
            f"translation known to ± {1e3 * shift:.2f} mm, allowed {1e3 * gates.translation_sd_m:g} mm"
        )
    if turn > gates.rotation_sd_rad:
        allowed = np.degrees(gates.rotation_sd_rad)
        reasons.append(f"rotation known to ± {np.degrees(turn):.3f}°, allowed {allowed:.2g}°")
    if solution.left_out is not None:
        px, m = rms_of(solution.problem, solution.fit, solution.left_out.misses)
        if px is not None and px > gates.leave_one_out_px:
            reasons.append(f"leave-one-out {px:.2f} px, allowed {gates.leave_one_out_px:g} px")
        if m is not None and m > gates.leave_one_out_m:
            reasons.append(f"leave-one-out {1e3 * m:.2f} mm, allowed {1e3 * gates.leave_one_out_m:g} mm")
    return reasons


def sentence_of(solution: Solution) -> str:
    """Returns the figures that decide, in one sentence."""
    fit = solution.fit
    parts = [f"{int(fit.keep.sum())} poses"]
    wrong = outlier_numbers(solution)
    if wrong:
        parts[0] += f" ({len(wrong)} left out: {', '.join(str(number) for number in wrong)})"
    shift, turn = float(solution.sd[_SHIFT].max()), float(solution.sd[_TURN].max())
    parts.append(f"translation ± {1e3 * shift:.2f} mm, rotation ± {np.degrees(turn):.3f}°")
    if solution.left_out is not None:
        px, m = rms_of(solution.problem, fit, solution.left_out.misses)
        figures = [f"{px:.2f} px"] if px is not None else []
        figures += [f"{1e3 * m:.2f} mm"] if m is not None else []
        parts.append(f"leave-one-out {' and '.join(figures)}")
    return ", ".join(parts)


def figures_of(
    solution: Solution, seen: Observations, forms: Mapping[str, ClosedForm], proposals: Sequence[NextPose]
) -> tuple[Figures, ...]:
    """Returns the tables for people."""
    x, sd = solution.fit.state.x, solution.sd
    result = [
        Figures(
            "Camera on the flange" if solution.problem.in_hand else "Camera in the base",
            ("axis", "translation, mm", "sd, mm", "sd of rotation, °"),
            [
                (axis, f"{1e3 * x[k, 3]:.3f}", f"{1e3 * sd[3 + k]:.3f}", f"{np.degrees(sd[k]):.4f}")
                for k, axis in enumerate("xyz")
            ],
        ),
        Figures(
            "Closed forms against the joint fit",
            ("method", "apart, mm", "apart, °", "rms, px", "rms, mm", "left out, px", "left out, mm"),
            [_form_row(solution, name, form) for name, form in forms.items()] + [_joint_row(solution)],
        ),
        Figures(
            "Poses",
            (
                "pose",
                "used",
                "rms, px",
                "rms, mm",
                "left out, px",
                "left out, mm",
                "arm off, mm",
                "arm off, °",
            ),
            [_pose_row(pose) for pose in _poses(solution, seen)],
        ),
    ]
    if proposals:
        rows = [(one.words, f"{100 * one.gain:.0f}") for one in proposals]
        result.append(Figures("Poses that would tell most next", ("pose", "less uncertainty, %"), rows))
    arm = _arm(solution)
    if arm is not None:
        offsets = [
            (key, f"{np.degrees(value):+.4f}", f"{np.degrees(error):.4f}")
            for key, value, error in zip(arm["estimated"], arm["values_rad"], arm["sd_rad"], strict=True)
        ]
        offsets += [(f"{key}: {why}", "–", "–") for key, why in arm["not_observable"].items()]
        result.append(Figures("Joint offsets", ("key", "offset, °", "sd, °"), offsets))
    return tuple(result)


def target_pose(solution: Solution) -> Float64:
    """Returns (4, 4) where the target is fixed; of points that were fitted one by one, the best for all."""
    problem, state = solution.problem, solution.fit.state
    if not problem.shape_from_probing or len(problem.target) < 3:
        return state.y
    placed = state.target @ state.y[:3, :3].T + state.y[:3, 3]
    return align(problem.target, placed, "fixed", "target").matrix


def _called(number: int, seen: Observations) -> str:
    """A pose by its place in the file, and by its name where it has one."""
    name = seen.views[number].name
    return f"{number}" if name == f"{number}" else f"{number} ({name})"


def _split(sd: Float64) -> dict[str, list[float]]:
    return {"translation_m": sd[_SHIFT].tolist(), "rotation_rad": sd[_TURN].tolist()}


def _intrinsics(solution: Solution, seen: Observations) -> dict[str, Any] | None:
    if not len(solution.problem.pixels.pose) and seen.intrinsics is None:
        return None
    told = solution.fit.state.intrinsics if seen.intrinsics is None else seen.intrinsics.vector
    values = dict(zip(("fx", "fy", "cx", "cy"), told[:4].tolist(), strict=True))
    return {**values, "distortion": told[4:].tolist(), "estimated": seen.intrinsics is None}


def _noise(solution: Solution) -> dict[str, float]:
    problem, noise = solution.problem, solution.fit.noise
    told: dict[str, float] = {}
    if len(problem.pixels.pose):
        told["pixel_px"] = noise.pixel
    if len(problem.positions.pose):
        told["along_ray_m"] = noise.along
        if problem.new_across.any():
            told["across_ray_m"] = noise.across
    if len(problem.probed):
        told["probed_m"] = float(noise.probed * np.median(problem.fixed_sd))
    if problem.jacobian is not None:
        return {**told, "joint_rad": noise.turn}
    return {**told, "arm_turn_rad": noise.turn, "arm_shift_m": noise.shift}


def _form(form: ClosedForm, eye: str) -> dict[str, Any]:
    return {
        eye: form.x.tolist(),
        "from_joint_fit_m": float(np.linalg.norm(form.apart[_SHIFT])),
        "from_joint_fit_rad": float(np.linalg.norm(form.apart[_TURN])),
        "rms_px": form.rms[0],
        "rms_m": form.rms[1],
        "leave_one_out_px": form.left_out[0],
        "leave_one_out_m": form.left_out[1],
    }


def _poses(solution: Solution, seen: Observations) -> list[dict[str, Any]]:
    problem, fit, left = solution.problem, solution.fit, solution.left_out
    as_read = misses_of(problem, fit.state)
    out = None if left is None else left.misses
    kinds = {
        "rms_px": by_pose(problem.pixels.pose, as_read.pixel, problem.poses),
        "rms_m": by_pose(problem.positions.pose, as_read.position, problem.poses),
    }
    if out is not None:
        kinds["leave_one_out_px"] = by_pose(problem.pixels.pose, out.pixel, problem.poses)
        kinds["leave_one_out_m"] = by_pose(problem.positions.pose, out.position, problem.poses)
    told: list[dict[str, Any]] = [{} for _ in range(problem.poses)]
    for place, number in enumerate(problem.order):
        one: dict[str, Any] = {"index": int(number), "name": seen.views[number].name}
        one["used"] = bool(fit.keep[place])
        one |= {key: float(v[place]) if np.isfinite(v[place]) else None for key, v in kinds.items()}
        if left is not None:
            one["arm_off_m"] = float(np.linalg.norm(left.deviation[place][_SHIFT]))
            one["arm_off_rad"] = float(np.linalg.norm(left.deviation[place][_TURN]))
        told[number] = one
    return told


def _arm(solution: Solution) -> dict[str, Any] | None:
    if solution.arm is None:
        return None
    fit = solution.fit
    joints = list(fit.free.joints)
    formal = np.diag(fit.covariance)[fit.places.joints]
    both = formal
    if solution.left_out is not None:
        both = np.maximum(formal, np.diag(solution.left_out.parameters)[fit.places.joints])
    return {
        "estimated": [f"arm.joint_offsets_rad[{joint}]" for joint in joints],
        "values_rad": [float(fit.state.offsets[joint]) for joint in joints],
        "sd_rad": np.sqrt(np.maximum(both, 0)).tolist(),
        "not_observable": dict(solution.arm.not_observable),
    }


def _form_row(solution: Solution, name: str, form: ClosedForm) -> Sequence[str]:
    apart = (float(np.linalg.norm(form.apart[part])) for part in (_SHIFT, _TURN))
    shift, turn = apart
    return name, f"{1e3 * shift:.3f}", f"{np.degrees(turn):.4f}", *_two(form.rms), *_two(form.left_out)


def _joint_row(solution: Solution) -> Sequence[str]:
    problem, fit, left = solution.problem, solution.fit, solution.left_out
    out = (None, None) if left is None else rms_of(problem, fit, left.misses)
    return "joint fit", "0", "0", *_two(rms_of(problem, fit, misses_of(problem, fit.state))), *_two(out)


def _pose_row(pose: Mapping[str, Any]) -> Sequence[str]:
    fitted = _two((pose["rms_px"], pose["rms_m"]))
    left = _two((pose.get("leave_one_out_px"), pose.get("leave_one_out_m")))
    off = ("–", "–")
    if "arm_off_m" in pose:
        off = (f"{1e3 * pose['arm_off_m']:.2f}", f"{np.degrees(pose['arm_off_rad']):.3f}")
    called = f"{pose['index']}" if pose["name"] == str(pose["index"]) else f"{pose['index']} ({pose['name']})"
    return called, "yes" if pose["used"] else "no", *fitted, *left, *off


def _two(figures: tuple[float | None, float | None]) -> tuple[str, str]:
    px, m = figures
    return "–" if px is None else f"{px:.3f}", "–" if m is None else f"{1e3 * m:.3f}"
