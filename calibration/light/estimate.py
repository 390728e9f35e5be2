"""What captures of boards tell about light and lens: the fit, its uncertainty, and what was left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calibration.light import fit, near_light
from calibration.light.fit import LightFit, PositionPrior, fit_light
from calibration.light.near_light import GLOBAL, POSITION
from calibration.light.samples import BoardSamples, enough, sample_board, too_bright
from calibration.outcome import Note, RefusedError
from calibration.rotations import rotation_matrix
from calibration.source import Source
from surfclass.errors import InputError
from surfclass.rig import Rig
from surfclass.types import Float64

Use = Literal["all", "boards", "lambertian"]
ROLES: dict[Use, tuple[str, ...]] = {
    "all": ("light", "response"),
    "boards": ("light",),
    "lambertian": ("response",),
}
LEAST_BOARDS = 3
LEAST_DISTANCES = 3
_LEAST_DISTANCE_RATIO = 1.2
_MOST_BAD_SHARE = 0.5  # of one role's views
_UNDETERMINED_M = 0.10
_THOUGHT_M = 0.5  # a light farther from the camera than this is no part of the package


@dataclass(frozen=True, slots=True, eq=False)
class LightEstimate:
    """Light and lens with all that says how good they are.

    Attributes:
        views: What was fitted.
        fit: Light and lens.
        covariance: (10, 10) of them: jackknife over views, and what is uneven in all views.
        alone: By view: the position (3,) without it.
        held_out: By view: rms relative error of its diffuse light as the other views have light and lens
            (and,
            for a Lambertian view, its K_d).
        left_out: Views that were of no use, and why.
    """

    views: tuple[BoardSamples, ...]
    fit: LightFit
    covariance: Float64
    alone: dict[str, Float64]
    held_out: dict[str, float]
    left_out: tuple[str, ...]

    @property
    def position_sd(self) -> float:
        """The longest half-axis of the position's ellipsoid of one standard deviation, m."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[POSITION, POSITION]).max()))

    @property
    def held_out_rms(self) -> float:
        """Over all views."""
        return float(np.sqrt(np.mean(np.square(list(self.held_out.values())))))


def board_views(source: Source, rig: Rig, inverse: Float64, use: Use, note: Note) -> list[BoardSamples]:
    """Returns the views of boards in their order, all scaled to the first one's exposure.

    Raises:
        RefusedError: If there is no capture of the roles, or a board cannot be seen in one.
    """
    views: list[BoardSamples] = []
    reference_s = None
    for capture in source.captures(ROLES[use]):
        if reference_s is None and capture.colour is not None:
            reference_s = capture.colour.exposure_s
        try:
            views.append(sample_board(capture, rig, inverse, reference_s))
        except InputError as error:
            raise RefusedError(str(error)) from error
    if not views:
        roles = " or ".join(f"'{role}'" for role in ROLES[use])
        raise RefusedError(
            f"there is no capture of role {roles}; take {LEAST_BOARDS + 1} or more of a semi-gloss board "
            "(role 'light'), turned differently, and some of a grey card at several distances (role "
            "'response')"
        )
    note(f"read {len(views)} views of boards")
    return views


def estimate_light(
    views: Sequence[BoardSamples],
    known: PositionPrior | None = None,
    between_sd: Sequence[float] | None = None,
) -> LightEstimate:
    """Returns light and lens.

    Args:
        views: Of boards.
        known: What is known of the position besides.
        between_sd: (6,) standard deviations of `rgb_T_depth`, rotation (rad) and translation (m): all boards
            are where it says, so no view shows its error.

    Raises:
        RefusedError: If the views cannot determine them, saying what is missing.
    """
    usable, left_out = _usable(views)
    found = fit_light(usable, starting_position(usable), known)
    if not near_light.shines_everywhere(found.parameters, found.observed).all():
        raise RefusedError(
            "the fit puts the light where it does not shine on the boards: the depth image and the colour "
            "image do not belong together, or something else lights the boards"
        )
    rows = fit.leave_out(found)
    covariance = fit.covariance(found, rows)
    if between_sd is not None:
        covariance = covariance + _from_between(usable, found, between_sd)
    names = found.observed.names
    estimate = LightEstimate(
        tuple(usable),
        found,
        covariance,
        {name: row[POSITION] for name, row in zip(names, rows, strict=True)},
        _held_out(found, rows),
        left_out,
    )
    if known is None and estimate.position_sd > _UNDETERMINED_M:
        raise RefusedError(
            f"the views leave the light's position open by {1e3 * estimate.position_sd:.0f} mm; take "
            "boards that are turned differently (by 10° about both image axes), or a grey card at "
            "distances from 0.6 to 1.3 m"
        )
    return estimate


def _from_between(views: Sequence[BoardSamples], found: LightFit, between_sd: Sequence[float]) -> Float64:
    """(10, 10) what the uncertainty of `rgb_T_depth` adds: each of its numbers moved, and fitted again."""
    added = np.zeros((GLOBAL, GLOBAL))
    for step in np.diag(between_sd):
        if not step.any():
            continue
        turn = rotation_matrix(step[:3])
        moved = []
        for view in views:
            normal = turn @ view.plane.normal
            plane = replace(view.plane, normal=normal, offset=view.plane.offset + float(normal @ step[3:]))
            moved.append(replace(view, plane=plane))
        off = (fit.refit(found, moved) - found.parameters)[:GLOBAL]
        added += np.outer(off, off)
    return added


def starting_position(views: Sequence[BoardSamples]) -> Float64:
    """Returns about where the light is (3,): where the highlights' mirrored rays (Eq. 4.6) come together.

    Without highlights, the camera's own place.
    """
    normal, moment = np.eye(3) / _THOUGHT_M**2, np.zeros(3)
    for view in views:
        if view.kind != "board":
            continue
        ray = view.saturated.mean(axis=0) if len(view.saturated) else view.ray[view.light[:, 1].argmax()]
        towards = np.append(ray, 1.0)
        point = towards * (view.plane.offset / (towards @ view.plane.normal))
        line = towards - 2 * (towards @ view.plane.normal) * view.plane.normal
        line /= np.linalg.norm(line)
        across = (np.eye(3) - np.outer(line, line)) / 0.02**2  # a centroid is off by centimetres
        normal += across
        moment += across @ point
    return np.asarray(np.linalg.solve(normal, moment))


def _usable(views: Sequence[BoardSamples]) -> tuple[list[BoardSamples], tuple[str, ...]]:
    usable = enough(views)
    names = {view.name for view in usable}
    bad = [view for view in views if view.name not in names]
    exposure = too_bright(views)
    for kind, what in (("board", "boards"), ("lambertian", "views of the grey card")):
        of_kind = [view for view in views if view.kind == kind]
        wrong = [view for view in of_kind if too_bright([view])]
        if of_kind and len(wrong) > _MOST_BAD_SHARE * len(of_kind):
            raise RefusedError(
                f"{len(wrong)} of {len(of_kind)} {what} are badly exposed: {too_bright(wrong)}"
            )
    boards = [view for view in usable if view.kind == "board"]
    cards = [view for view in usable if view.kind == "lambertian"]
    distances = [abs(view.plane.offset) for view in cards]
    spread = max(distances) / min(distances) if distances else 1.0
    if len(boards) < LEAST_BOARDS and (len(cards) < LEAST_DISTANCES or spread < _LEAST_DISTANCE_RATIO):
        reason = (
            f"{len(boards)} boards and {len(cards)} views of a grey card (farthest over nearest: "
            f"{spread:.2f}) do not determine the light; needed are {LEAST_BOARDS} differently turned "
            f"boards, or a grey card at {LEAST_DISTANCES} distances that differ by "
            f"{_LEAST_DISTANCE_RATIO - 1:.0%} and more"
        )
        raise RefusedError(f"{reason}; {exposure}" if exposure else reason)
    told = tuple(too_bright([view]) or f"{view.name} shows too little of the board" for view in bad)
    return usable, told


def _held_out(found: LightFit, rows: Float64) -> dict[str, float]:
    observed = found.observed
    _, specular = near_light.emitted(found.parameters, observed)
    errors = {}
    for view, (name, row) in enumerate(zip(observed.names, rows, strict=True)):
        places = observed.view == view
        matte = places & (specular < 0.01 * observed.light)
        places = matte if matte.sum() > 0.2 * places.sum() else places
        diffuse, shine = near_light.emitted(row, observed)
        away = np.log(observed.light[places] / (diffuse + shine)[places])
        if (observed.lobe[places] >= 0).any():
            away -= np.median(away)  # a board's own K_d is known from itself alone
        near = np.clip(away, *np.quantile(away, (0.01, 0.99)))
        errors[name] = float(np.sqrt(np.mean(near**2)))
    return errors


def correlations(covariance: Float64) -> Float64:
    """Returns (10, 10) the correlations of light and lens; 0 where something does not vary."""
    sd = np.sqrt(np.maximum(np.diag(covariance)[:GLOBAL], 0))
    scale = np.divide(1, sd, out=np.zeros_like(sd), where=sd > 1e-12)
    return np.asarray(covariance * np.outer(scale, scale))
