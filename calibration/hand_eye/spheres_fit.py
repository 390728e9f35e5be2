"""Where a fixed depth camera stands, from two spheres on a rod that the arm holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.hand_eye.single_pose import align
from calibration.hand_eye.spheres import SpherePair
from calibration.outcome import RefusedError
from calibration.resampling import jackknife_covariance
from calibration.rotations import rotation_vector
from surfclass.errors import InputError
from surfclass.types import Bool, Float64, Transform

LEAST_POSES = 6
_FARTHEST = 20.0  # of the spheres' distance: where on the line the tool centre is looked for
_LEAST_TURN_RAD = np.radians(1.0)
_GRID = 81
_LEAST_WIDTH = 1e-3  # of the tool centres across their longest direction, as a share of it
_OUTLIER = 4.0  # times the middle pose's miss
_OUTLIER_M = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class SpheresFit:
    """The camera's pose, and how far it can be relied on.

    Attributes:
        base_T_camera: The result.
        along_m: From the middle of the two centres to the tool centre, in the direction of the second.
        residual_m: (n, 3) in `base`, tool centre as seen less as read, of every pose.
        left_out_m: (n,) how far each pose is from what the others say.
        translation_sd_m: (3,) by jackknife over the poses, in `base`, of the camera's place.
        rotation_sd_rad: (3,) likewise, of rotation vectors in the camera's frame.
        along_sd_m: Of `along_m`.
        used: (n,) poses that are no outliers; the others counted for nothing but their own figures.
    """

    base_T_camera: Transform
    along_m: float
    residual_m: Float64
    left_out_m: Float64
    translation_sd_m: Float64
    rotation_sd_rad: Float64
    along_sd_m: float
    used: Bool


def fit_spheres(pairs: Sequence[SpherePair], tool_base_m: Float64) -> SpheresFit:
    """Returns the fixed camera's pose from the spheres' places and the arm's read-outs.

    The rod's turn about itself cannot be seen, so only what lies on its line can be told in the camera's
    frame: the tool centre is taken to, and where on it is found together with the pose. That takes
    poses in which the rod points in different directions.

    Args:
        pairs: n sightings.
        tool_base_m: (n, 3) the tool centre in `base` for each.

    Raises:
        RefusedError: If there are too few poses, they lie on a line, or the rod always points the same way.
        InputError: If the numbers do not fit each other.
    """
    tool = np.asarray(tool_base_m, np.float64)
    if tool.shape != (len(pairs), 3) or not np.isfinite(tool).all():
        raise InputError(f"spheres: {len(pairs)} sightings but tool centres {tool.shape}, needed are (n, 3)")
    if len(pairs) < LEAST_POSES:
        raise RefusedError(f"spheres: {len(pairs)} poses, needed are {LEAST_POSES} or more")
    middle = np.array([pair.middle_m for pair in pairs])
    axis = np.array([pair.axis for pair in pairs])
    mean = axis.mean(axis=0) / np.linalg.norm(axis.mean(axis=0))
    turn = float(np.sqrt(np.mean(np.sum((axis - mean) ** 2, axis=1))))
    if turn < _LEAST_TURN_RAD:
        raise RefusedError(
            f"spheres: the rod points the same way within {np.degrees(turn):.2f}° in all poses, so where on "
            "it the tool centre lies stays open; tilt the tool by 5° or more between poses"
        )
    width = np.linalg.svd(tool - tool.mean(axis=0), compute_uv=False)
    if width[1] <= _LEAST_WIDTH * width[0]:
        raise RefusedError("spheres: the tool centres lie on a line; move the tool in all three directions")
    reach = _FARTHEST * float(np.median([pair.distance_m for pair in pairs]))
    used = np.ones(len(tool), bool)
    for _ in range(len(tool)):
        misses = _left_out(middle, axis, tool, used, reach)[0]
        limit = max(_OUTLIER * float(np.median(misses[used])), _OUTLIER_M)
        worst = int(np.argmax(np.where(used, misses, -1)))
        if misses[worst] <= limit or used.sum() <= max(LEAST_POSES, 0.7 * len(tool)):
            break
        used[worst] = False
    misses, estimates = _left_out(middle, axis, tool, used, reach)
    pose, along = _posed(middle[used], axis[used], tool[used], reach)
    turns = np.array([rotation_vector(pose.rotation.T @ other.rotation) for other, _ in estimates])
    places = np.array([other.translation for other, _ in estimates])
    alongs = np.array([[other] for _, other in estimates])
    return SpheresFit(
        base_T_camera=pose,
        along_m=along,
        residual_m=pose @ (middle + along * axis) - tool,
        left_out_m=misses,
        translation_sd_m=np.sqrt(np.diag(jackknife_covariance(places))),
        rotation_sd_rad=np.sqrt(np.diag(jackknife_covariance(turns))),
        along_sd_m=float(np.sqrt(jackknife_covariance(alongs)[0, 0])),
        used=used,
    )


def _left_out(
    middle: Float64, axis: Float64, tool: Float64, used: Bool, reach: float
) -> tuple[Float64, list[tuple[Transform, float]]]:
    """Returns each pose's miss by a fit without it, and those fits of the poses that are used."""
    misses, estimates = np.zeros(len(tool)), []
    _, near = _posed(middle[used], axis[used], tool[used], reach)
    for number in range(len(tool)):
        others = used.copy()
        others[number] = False
        pose, along = _posed(middle[others], axis[others], tool[others], reach, near)
        seen = pose @ (middle[number] + along * axis[number])
        misses[number] = float(np.linalg.norm(seen - tool[number]))
        if used[number]:
            estimates.append((pose, along))
    return misses, estimates


def _posed(
    middle: Float64, axis: Float64, tool: Float64, reach: float, near: float | None = None
) -> tuple[Transform, float]:
    """Returns the pose and the place on the rod's line that together leave least: one number is searched.

    Near `near` if that is given, else all over `reach` to both sides.
    """
    from scipy.optimize import minimize_scalar

    centred = tool - tool.mean(axis=0)
    middles, axes = middle - middle.mean(axis=0), axis - axis.mean(axis=0)
    of_middle, of_axis = middles.T @ centred, axes.T @ centred

    def misfit(along: float) -> float:
        # The least that any rigid motion leaves (Arun, Huang and Blostein 1987), less a constant.
        cross = of_middle + along * of_axis
        u, values, vt = np.linalg.svd(cross)
        handed = np.sign(np.linalg.det(u) * np.linalg.det(vt))
        spread = float(np.sum((middles + along * axes) ** 2))
        return spread - 2 * float(values[0] + values[1] + handed * values[2])

    grid = np.linspace(-reach, reach, _GRID)
    step = float(grid[1] - grid[0])
    start = near if near is not None else float(grid[int(np.argmin([misfit(along) for along in grid]))])
    found = minimize_scalar(
        misfit, bounds=(start - step, start + step), method="bounded", options={"xatol": 1e-8}
    )
    along = float(found.x)
    try:
        return align(middle + along * axis, tool, "base", "camera"), along
    except InputError as error:
        raise RefusedError(f"spheres: {error}; move the tool in all three directions") from error
