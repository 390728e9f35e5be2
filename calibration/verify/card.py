"""Light, response and vignetting together: a grey card's K_d, which is one number whatever the distance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.gates import VerifyGates
from calibration.light.samples import Plane, board_plane
from calibration.outcome import Figures, Note, RefusedError
from calibration.plots import drawing
from calibration.source import Source
from calibration.verify.part import Finding, Part
from surfclass.errors import InputError, MissingCalibrationError
from surfclass.frames import Capture
from surfclass.geometry import rays
from surfclass.pipeline import lit_image
from surfclass.reflectance import lacking_for_full_model
from surfclass.rig import Rig
from surfclass.routes import ReflectanceMode, colour_features, exposure_ratio
from surfclass.types import Float32, Float64, SurfaceView
from surfclass.viewing import view_surface

KEY, TITLE = "grey_card", "Grey card"
_ROWS = 60  # of blocks in an image: single pixels' noise is no fault of the calibration
_LEAST_PIXELS = 0.6  # of a block's must be usable
_LEAST_BLOCKS = 50
_APART = 1.1  # distances count as different from this ratio on
_SHOWN = 4


@dataclass(frozen=True, slots=True, eq=False)
class CardView:
    """K_d of one capture.

    Attributes:
        name: Of the capture.
        distance_m: Mean distance of the card from the light.
        k_d: (rows, columns, 3) means of blocks, by the full model with the card's plane; NaN where the
            card is not, or cannot be used.
        own_normals: The same with each pixel's own depth and normal, as the map gets it.
        thesis: By Eq. 4.12 with the card's plane, or None.
    """

    name: str
    distance_m: float
    k_d: Float64
    own_normals: Float64
    thesis: Float64 | None


def check_card(source: Source, gates: VerifyGates, note: Note) -> Part:
    """Returns how constant K_d is over the captures of role `response`, by the full model.

    Raises:
        RefusedError: If fewer than two captures can be used.
        MissingCalibrationError: If the rig lacks what the full model needs.
    """
    if not source.count("response"):
        raise RefusedError("no capture of role response shows the grey card")
    rig = source.rig.whole()
    if rig.light is None:
        raise MissingCalibrationError("the rig has no light.position_rgb_m: calibrate light first")
    lacking = lacking_for_full_model(rig)
    if lacking:
        raise MissingCalibrationError(
            f"the rig lacks {', '.join(lacking)}: calibrate response and light first"
        )
    views = list(_card_views(source, rig, note))
    if len(views) < 2:
        raise RefusedError(f"{len(views)} captures of the grey card can be used, needed are 2 or more")
    return _judged(views, gates)


def _card_views(source: Source, rig: Rig, note: Note) -> Iterator[CardView]:
    reference_s: float | None = None
    for capture in source.captures("response"):
        try:
            exposure_s = None if capture.colour is None else capture.colour.exposure_s
            reference_s = reference_s or exposure_s
            yield _card_view(capture, rig, exposure_ratio(reference_s, exposure_s))
        except InputError as error:
            note(f"grey card: capture {capture.name} is left out: {error}")


def _card_view(capture: Capture, rig: Rig, ratio: float) -> CardView:
    image = lit_image(capture, rig)
    view = view_surface(capture.depth.depth_mm, rig)
    plane = board_plane(capture, rig)
    away = np.abs(np.tensordot(plane.normal.astype(np.float32), view.point, axes=1) - plane.offset)
    card = view.has_point & (away < 5 * plane.thickness_m + 0.003)

    flat = flat_view(view, plane, rig)

    def blocks(mode: ReflectanceMode, geometry: SurfaceView) -> Float64:
        k_d, valid = colour_features("K_d", image, geometry, rig, mode, ratio)
        return block_means(k_d, valid & card)

    full = blocks("full", flat)
    count = int(np.isfinite(full[..., 0]).sum())
    if count < _LEAST_BLOCKS:
        raise InputError(
            f"of the card {count} blocks can be used, needed are {_LEAST_BLOCKS}; the rest is over- or "
            "under-exposed, too oblique, or without depth"
        )
    has_thesis = rig.response is not None and rig.response.a2_a1_a0 is not None and abs(ratio - 1) < 0.01
    return CardView(
        capture.name,
        _distance(flat, card),
        full,
        blocks("full", view),
        blocks("thesis", flat) if has_thesis else None,
    )


def flat_view(view: SurfaceView, plane: Plane, rig: Rig) -> SurfaceView:
    """Returns the same view with every point moved along its ray onto the plane, whose normal it gets.

    The card is flat: what a noisy depth image adds to distances and angles is then not taken for a fault
    of light or response.
    """
    assert rig.light is not None  # check_card has seen it
    x, y = rays(rig.rgb)
    normal = plane.normal.astype(np.float32)
    z = np.float32(plane.offset) / (normal[0] * x + normal[1] * y + normal[2])
    point = np.stack([x * z, y * z, z])
    length = np.sqrt(np.einsum("ihw,ihw->hw", point, point))
    to_light = np.array(rig.light.position_rgb_m, np.float32)[:, None, None] - point
    light_distance = np.sqrt(np.einsum("ihw,ihw->hw", to_light, to_light))
    return replace(
        view,
        point=point,
        normal=np.broadcast_to(normal[:, None, None], point.shape),
        viewing_distance_m=length,
        viewing_cosine=np.float32(-plane.offset) / length,
        light_distance_m=light_distance,
        light_cosine=np.einsum("i,ihw->hw", normal, to_light) / light_distance,
        has_normal=view.has_point,
    )


def block_means(planes: Float32, usable: NDArray[np.bool_]) -> Float64:
    """Returns square blocks' means (rows, columns, 3) of planes (3, h, w), NaN where too little is usable."""
    h, w = usable.shape
    side = max(1, h // _ROWS)
    rows, columns = h // side, w // side
    cut = (slice(0, rows * side), slice(0, columns * side))
    shape = (rows, side, columns, side)
    count = usable[cut].reshape(shape).sum(axis=(1, 3))
    total = (planes[:, cut[0], cut[1]] * usable[cut]).reshape(3, *shape).sum(axis=(2, 4), dtype=np.float64)
    enough = count >= _LEAST_PIXELS * side * side
    means = np.divide(total, count, out=np.full(total.shape, np.nan), where=enough)
    return np.asarray(means.transpose(1, 2, 0))


def _distance(view: SurfaceView, card: NDArray[np.bool_]) -> float:
    assert view.light_distance_m is not None  # the rig has a light
    return float(view.light_distance_m[card].mean())


def variation(grids: list[Float64]) -> tuple[float, float]:
    """Returns how much K_d varies: over all blocks of all captures, and between the captures' means.

    Standard deviation over mean, of the channel that varies most.
    """
    blocks = [grid[np.isfinite(grid[..., 0])] for grid in grids]
    every = np.concatenate(blocks)
    means = np.array([block.mean(axis=0) for block in blocks])
    return (
        float((every.std(axis=0) / every.mean(axis=0)).max()),
        float((means.std(axis=0, ddof=1) / means.mean(axis=0)).max()),
    )


def _judged(views: list[CardView], gates: VerifyGates) -> Part:
    over_all, between = variation([view.k_d for view in views])
    distances = [view.distance_m for view in views]
    what = "K_d over all places and captures, deviation / mean"
    findings = [Finding("k_d_variation", what, over_all, gates.k_d_variation, "%", 100)]
    apart = max(distances) / min(distances)
    limit = gates.k_d_between if apart >= _APART else None
    findings.append(
        Finding("k_d_between", "K_d between the captures, deviation / mean", between, limit, "%", 100)
    )
    own = variation([view.own_normals for view in views])[0]
    with_own = "the first with each pixel's own normal, as in the map"
    findings.append(Finding("own_normals_variation", with_own, own, None, "%", 100))
    thesis = [view.thesis for view in views if view.thesis is not None]
    result: dict[str, Any] = {
        "distances_m": {view.name: view.distance_m for view in views},
        "k_d": {view.name: np.nanmean(view.k_d, axis=(0, 1)).tolist() for view in views},
        "thesis_variation": None,
    }
    if len(thesis) == len(views):
        result["thesis_variation"] = variation(thesis)[0]
        findings.append(
            Finding(
                "thesis_variation",
                "the first by Eq. 4.12, the thesis' model",
                variation(thesis)[0],
                None,
                "%",
                100,
            )
        )
    rows = [
        [
            view.name,
            f"{view.distance_m:.3f}",
            *(f"{value:.4f}" for value in np.nanmean(view.k_d, axis=(0, 1))),
            f"{100 * variation([view.k_d, view.k_d])[0]:.2f}",
        ]
        for view in views
    ]
    return Part(
        KEY,
        TITLE,
        tuple(findings),
        suspect="the light's position and fall-off, the vignetting or the response are wrong, or the card is "
        "not of one colour: calibrate response and light again",
        result=result,
        figures=(
            Figures("Grey card", ("view", "distance, m", "K_d R", "K_d G", "K_d B", "variation, %"), rows),
        ),
        pictures={"verify-grey-card": lambda path: _draw(views, path)},
    )


def _draw(views: list[CardView], path: Path) -> None:
    chosen = [views[round(i)] for i in np.linspace(0, len(views) - 1, min(_SHOWN, len(views)))]
    mean = np.nanmean([np.nanmean(view.k_d[..., 1]) for view in views])
    with drawing(path, 2, 2, figsize=(4.2, 3.6)) as (figure, axes):
        for ax in axes.flat:
            ax.set_axis_off()
        for ax, view in zip(axes.flat, chosen, strict=False):
            picture = ax.imshow(100 * (view.k_d[..., 1] / mean - 1), cmap="RdBu_r", vmin=-5, vmax=5)
            ax.set_title(f"{view.distance_m:.2f} m", fontsize=9)
        figure.colorbar(picture, ax=list(axes.flat), label="K_d (green) off its mean, %")
