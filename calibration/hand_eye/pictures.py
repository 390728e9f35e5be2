"""What a hand-eye calibration looks like: residuals by pose, the poses in space, and the closed forms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibration.hand_eye.adjustment_columns import Free, layout, pixel_rows, position_rows
from calibration.hand_eye.comparison import ClosedForm
from calibration.hand_eye.leave_out import misses_of
from calibration.hand_eye.solution import Solution
from calibration.plots import drawing
from surfclass.types import Float64

_USED, _LEFT_OUT, _WRONG = "#2b6cb0", "#dd8a2e", "#c53030"
_AXIS_M = 0.06
_TOWERS = 10  # times the middle pose's residuals: so much only a logarithmic scale shows


def pictures_of(
    solution: Solution, names: Sequence[str], forms: Mapping[str, ClosedForm]
) -> dict[str, Callable[[Path], None]]:
    """Returns the pictures by file name.

    Args:
        solution: What was found.
        names: Of the poses, in the solution's order.
        forms: The closed forms.
    """
    return {
        "hand_eye_poses": lambda path: _draw_poses(path, solution, names),
        "hand_eye_space": lambda path: _draw_space(path, solution),
        "hand_eye_residuals": lambda path: _draw_residuals(path, solution),
        "hand_eye_closed_forms": lambda path: _draw_forms(path, solution, forms),
    }


def by_pose(pose: Any, lengths: Float64, poses: int) -> Float64:
    """Returns (n,) root mean squares of each pose's residuals; nan where it has none."""
    squares = np.bincount(pose, lengths**2, poses)
    counts = np.bincount(pose, minlength=poses)
    return np.sqrt(np.where(counts > 0, squares / np.maximum(counts, 1), np.nan))


def _draw_poses(path: Path, solution: Solution, names: Sequence[str]) -> None:
    problem, fit = solution.problem, solution.fit
    as_read = misses_of(problem, fit.state)
    left = None if solution.left_out is None else solution.left_out.misses
    kinds = [("px", 1.0, problem.pixels.pose, as_read.pixel, None if left is None else left.pixel)]
    kinds.append(
        ("mm", 1e3, problem.positions.pose, as_read.position, None if left is None else left.position)
    )
    kinds = [kind for kind in kinds if len(kind[2])]
    by_name = sorted(range(len(names)), key=lambda place: problem.order[place])
    size = (max(6.0, 0.35 * len(names) + 2), 3.0 * len(kinds))
    with drawing(path, len(kinds), figsize=size) as (_, axes):
        for ax, (unit, factor, pose, lengths, out) in zip(axes[:, 0], kinds, strict=True):
            places = np.arange(len(names))
            height = factor * by_pose(pose, lengths, problem.poses)[by_name]
            colours = [_USED if fit.keep[place] else _WRONG for place in by_name]
            ax.bar(places - 0.2, height, 0.4, color=colours, label="of the fit")
            if out is not None:
                beside = factor * by_pose(pose, out, problem.poses)[by_name]
                ax.bar(places + 0.2, beside, 0.4, color=_LEFT_OUT, label="left out, from the others")
            ax.set_xticks(places, [names[place] for place in by_name], rotation=90, fontsize=8)
            ax.set_ylabel(f"rms residual, {unit}")
            ax.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize=8)
            if np.nanmax(height) > _TOWERS * np.nanmedian(height):
                ax.set_yscale("log")
        marked = "; red: a pose that does not fit" if not fit.keep.all() else ""
        axes[0, 0].set_title(f"Residuals by pose of the arm{marked}")


def _draw_space(path: Path, solution: Solution) -> None:
    problem, fit = solution.problem, solution.fit
    flange = problem.flange
    if problem.in_hand:
        cameras, target = flange @ fit.state.x, _moved(fit.state.y, fit.state.target)[None]
    else:
        cameras, target = (
            fit.state.x[None],
            np.stack([_moved(f @ fit.state.y, fit.state.target) for f in flange]),
        )
    with drawing(path, figsize=(7, 6), subplot_kw={"projection": "3d"}) as (_, axes):
        ax = axes[0, 0]
        for points in target:
            ax.scatter(*points.T, s=6, color="#4a5568", alpha=1.0 if problem.in_hand else 0.3)
        for poses, colour, length in ((flange, "#a0aec0", _AXIS_M / 2), (cameras, _USED, _AXIS_M)):
            ends = poses[:, :3, 3] + length * poses[:, :3, 2]
            for start, end in zip(poses[:, :3, 3], ends, strict=True):
                ax.plot(*np.stack([start, end]).T, color=colour, linewidth=2)
        wrong = flange[~fit.keep]
        if len(wrong):
            ax.scatter(*wrong[:, :3, 3].T, color=_WRONG, s=30)
        ax.set_xlabel("base x, m")
        ax.set_ylabel("base y, m")
        ax.set_zlabel("base z, m")
        ax.set_aspect("equal")
        ax.set_title("Cameras (blue, along their view), flanges (grey), target (points)")


def _draw_residuals(path: Path, solution: Solution) -> None:
    problem, fit = solution.problem, solution.fit
    free, places = Free(), layout(problem, Free())
    kinds: list[tuple[str, Float64, tuple[str, str]]] = []
    if len(problem.pixels.pose):
        rows = pixel_rows(problem, fit.state, free, places)
        kinds.append(("pixels", rows.residual[fit.keep[rows.pose]], ("u, px", "v, px")))
    if len(problem.positions.pose):
        rows = position_rows(problem, fit.state, free, places)
        sides = 1e3 * rows.residual[fit.keep[rows.pose]][:, 1:]
        kinds.append(("positions", sides, ("across the ray, mm", "along the ray, mm")))
    with drawing(path, 1, len(kinds), figsize=(4.5 * len(kinds), 4.5)) as (_, axes):
        for ax, (what, sides, labels) in zip(axes[0], kinds, strict=True):
            ax.scatter(*sides.T, s=8, alpha=0.5, color=_USED)
            most = 1.1 * max(float(np.abs(sides).max()), 1e-9)
            ax.set_xlim(-most, most)
            ax.set_ylim(-most, most)
            ax.set_aspect("equal")
            ax.axhline(0, color="#a0aec0", linewidth=0.8)
            ax.axvline(0, color="#a0aec0", linewidth=0.8)
            ax.set_xlabel(labels[0])
            ax.set_ylabel(labels[1])
            ax.set_title(f"Residuals of the {what}, the arm's own errors taken out", fontsize=9)


def _draw_forms(path: Path, solution: Solution, forms: Mapping[str, ClosedForm]) -> None:
    sd = solution.sd
    with drawing(path, 1, 2, figsize=(9, 3.5)) as (_, axes):
        for ax, part, factor, unit in (
            (axes[0, 0], slice(3, 6), 1e3, "translation, mm"),
            (axes[0, 1], slice(0, 3), 180 / np.pi, "rotation, °"),
        ):
            names = list(forms)
            for axis in range(3):
                values = [factor * forms[name].apart[part][axis] for name in names]
                ax.scatter(np.arange(len(names)) + 0.12 * (axis - 1), values, s=20, label="xyz"[axis])
                level = factor * sd[part][axis]
                ax.fill_between([-0.5, len(names) - 0.5], -level, level, color=f"C{axis}", alpha=0.12)
            ax.axhline(0, color="black", linewidth=0.8)
            ax.set_xticks(range(len(names)), names)
            ax.set_title(f"Closed forms less the joint fit: {unit}", fontsize=9)
        beside = {"loc": "center left", "bbox_to_anchor": (1, 0.5), "fontsize": 8}
        axes[0, 1].legend(**beside, title="bands:\n± 1 sd", title_fontsize=8)


def _moved(matrix: Float64, points: Float64) -> Float64:
    moved: Float64 = points @ matrix[:3, :3].T + matrix[:3, 3]
    return moved
