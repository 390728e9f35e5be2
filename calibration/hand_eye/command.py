"""`surfclass calibrate hand-eye`: where the camera sits, by one least squares over all poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from calibration.gates import HandEyeGates
from calibration.hand_eye.boards_seen import Eye, eye_of, observe_board
from calibration.hand_eye.comparison import compare
from calibration.hand_eye.discs import observe
from calibration.hand_eye.next_poses import propose
from calibration.hand_eye.observations import Observations
from calibration.hand_eye.observations_file import read_observations
from calibration.hand_eye.pictures import pictures_of
from calibration.hand_eye.report import failures, figures_of, outlier_sentences, result_of, sentence_of
from calibration.hand_eye.solution import Solution, solve
from calibration.outcome import Note, Outcome, RefusedError
from calibration.source import Source
from drivers.recordings.board import Board
from surfclass.errors import InputError
from surfclass.frames import Capture
from surfclass.rig import Arm, DepthRig
from surfclass.types import Float64, Transform

TargetKind = Literal["discs", "checkerboard", "charuco"]


@dataclass(frozen=True, slots=True)
class Options:
    """What the command line sets.

    Attributes:
        observations: A file of observations instead of captures.
        target: What the captures look at.
        board: The board, for "checkerboard" and "charuco"; None: the captures' own.
        eye: Which camera looks at a board; None: the colour camera where its place is known, else IR.
        joint_offsets: Whether to find the joints' offsets that can be seen.
        flange_offset: Whether to find the last D-H length.
        camera_sd: By camera, the standard deviations of fx, fy, cx, cy in px, where they are known: what they
            do to the result is part of its own.
    """

    observations: Path | None = None
    target: TargetKind = "discs"
    board: Board | None = None
    eye: Eye | None = None
    joint_offsets: bool = False
    flange_offset: bool = False
    camera_sd: Mapping[Eye, Sequence[float]] = field(default_factory=dict)


def calibrate(source: Source | None, options: Options, gates: HandEyeGates, note: Note) -> Outcome:
    """Returns the hand-eye transform from captures or from observations.

    Args:
        source: The captures; not needed with `options.observations`, but their rig says the arm's lengths.
        options: What to do.
        gates: Limits of the verdict.
        note: Called at each step.

    Raises:
        RefusedError: If the data cannot determine the result.
        InputError: If neither captures nor observations are given, or a file cannot be read.
    """
    arm = Arm() if source is None else source.rig.arm
    eye: Eye = "depth"
    if options.observations is not None:
        seen = read_observations(options.observations)
    elif source is not None:
        seen, eye = _observed(source, options, note)
    else:
        raise InputError("hand-eye: needed is either a recording (--from) or an observations file")
    pinhole_sd = options.camera_sd.get(eye)
    solution = solve(
        seen, arm.flange_offset_m, note, options.joint_offsets, options.flange_offset, pinhole_sd
    )
    note("comparing with the closed forms")
    forms = compare(solution.problem, solution.fit)
    proposals = propose(solution.problem, solution.fit, seen)
    reasons = failures(solution, seen, gates)
    verdict: Literal["pass", "fail"] = "fail" if reasons else "pass"
    for sentence in outlier_sentences(solution, seen):
        note(sentence)
    names = [seen.views[number].name for number in solution.problem.order]
    rig = None if source is None else source.rig
    return Outcome(
        kind="hand-eye",
        verdict=verdict,
        reasons=tuple(reasons),
        sentence=sentence_of(solution),
        result=result_of(solution, seen, forms, proposals, verdict, reasons),
        rig=_rig_values(solution, arm, eye, rig),
        figures=figures_of(solution, seen, forms, proposals),
        pictures=pictures_of(solution, names, forms),
    )


def _observed(source: Source, options: Options, note: Note) -> tuple[Observations, Eye]:
    if options.target == "discs":
        if source.plate is None:
            raise RefusedError(
                "the captures come without plate.toml, which says where the reflector discs are; add it to "
                "the data folder or the configuration, or choose another target"
            )
        captures = _with_joints(list(source.captures("hand_eye")), "hand_eye")
        return observe(captures, source.rig, source.plate, note), "depth"
    board = options.board or source.board
    if board is None:
        raise RefusedError(f"which {options.target}? say its inner corners and the side of its squares")
    if board.kind != options.target:
        raise InputError(f"--target {options.target}: the board is a {board.kind}")
    captures = _with_joints(list(source.captures(("board", "hand_eye"))), "board")
    eye = options.eye or eye_of(source.rig, all(capture.colour is not None for capture in captures))[0]
    if eye == "rgb":
        source.rig.whole()  # says what is missing
    return observe_board(captures, source.rig, board, eye, note), eye


def _with_joints(captures: list[Capture], role: str) -> list[Capture]:
    """The captures, which must say where the flange was."""
    if not captures:
        raise RefusedError(f"no capture has the role {role!r}, which is what this target needs")
    if all(capture.joints is None for capture in captures):
        raise RefusedError(
            "no capture has joint angles: base_T_depth, where it is recorded, was computed with a hand-eye "
            "transform, so it cannot tell a new one; capture with the arm's read-out (q1…q6)"
        )
    return captures


def _rig_values(solution: Solution, arm: Arm, eye: Eye, rig: DepthRig | None) -> dict[str, Any]:
    """What the rig takes over: nothing where the camera is not on the flange."""
    if not solution.problem.in_hand:
        return {}
    values: dict[str, Any] = {
        "transforms": {"flange_T_depth": _depth(solution.fit.state.x, eye, rig).tolist()}
    }
    if solution.fit.free.joints:
        offsets = np.array(arm.joint_offsets_rad) + solution.fit.state.offsets
        values["arm"] = {"joint_offsets_rad": offsets.tolist()}
    return values


def _depth(flange_T_camera: Float64, eye: Eye, rig: DepthRig | None) -> Float64:
    if eye == "depth" or rig is None:
        return flange_T_camera
    return (Transform("flange", "rgb", flange_T_camera) @ rig.rgb_T_depth).matrix
