"""How constant K_d comes out: over every pixel of captures of one target, as the classifiers will get it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.light.samples import board_plane, on_board, on_plane
from calibration.source import Source
from surfclass.colour import as_fraction
from surfclass.frames import Capture
from surfclass.geometry import rays
from surfclass.pipeline import lit_image
from surfclass.reflectance import diffuse_reflectance
from surfclass.rig import Rig
from surfclass.routes import ReflectanceMode
from surfclass.types import Float64, SurfaceView
from surfclass.viewing import view_surface


@dataclass(slots=True)
class Moments:
    """Count, sum and sum of squares of K_d, (4,): R, G, B and their mean."""

    count: int
    total: Float64
    square: Float64

    @property
    def variation(self) -> Float64:
        """(4,) standard deviation over mean."""
        mean = self.total / max(self.count, 1)
        variance = np.maximum(self.square / max(self.count, 1) - mean**2, 0)
        return np.asarray(np.sqrt(variance) / mean)


def k_d_variation(
    source: Source, rig: Rig, names: tuple[str, ...], mode: ReflectanceMode
) -> tuple[Float64, dict[str, float]] | None:
    """Returns the variation of K_d over all pixels of these captures together, and of each by itself.

    Every pixel of the card that the reflectance model holds valid counts, with its noise. The card is flat:
    its plane gives every pixel's normal, so that the noise of single normals is not put down to the light.

    Args:
        source: Holds the `response` captures.
        rig: With what the mode needs.
        names: Of the captures of one target.
        mode: "full" or "thesis" (there only captures of the first one's exposure are used).

    Returns:
        Standard deviations over means: (4,) of R, G, B and the mean of the three in all captures; and that
        of the mean in each. None if no pixel is valid.
    """
    whole = Moments(0, np.zeros(4), np.zeros(4))
    each: dict[str, float] = {}
    reference_s: float | None = None
    for capture in source.captures("response"):
        if capture.name not in names or capture.colour is None:
            continue
        exposure_s = capture.colour.exposure_s
        reference_s = reference_s or exposure_s
        ratio = reference_s / exposure_s if reference_s and exposure_s else 1.0
        if mode == "thesis" and abs(ratio - 1) > 0.01:
            continue
        view, image = _flat(capture, rig), lit_image(capture, rig)
        values, valid = diffuse_reflectance(
            as_fraction(image), view, rig, mode, ratio, 8 * image.dtype.itemsize
        )
        kept = values[:, valid].astype(np.float64)
        kept = np.concatenate([kept, kept.mean(axis=0, keepdims=True)])
        if not kept.size:
            continue
        one = Moments(kept.shape[1], kept.sum(axis=1), (kept**2).sum(axis=1))
        each[capture.name] = float(one.variation[3])
        whole.count += one.count
        whole.total = whole.total + one.total
        whole.square = whole.square + one.square
    return (whole.variation, each) if whole.count else None


def _flat(capture: Capture, rig: Rig) -> SurfaceView:
    """The view of a card, with its plane's points and normal at all of its pixels."""
    plane = board_plane(capture, rig)
    card = on_board(capture, rig, plane)
    view = view_surface(capture.depth.depth_mm, rig)
    height, width = card.shape
    point = on_plane(rays(rig.rgb).reshape(2, -1).T.astype(np.float64), plane).T.reshape(3, height, width)
    away = np.array(rig.light.position_rgb_m if rig.light else (0.0, 0.0, 0.0))[:, None, None] - point
    distance = np.linalg.norm(away, axis=0)
    cosine = np.tensordot(plane.normal, away, axes=1) / distance
    normal = np.broadcast_to(plane.normal[:, None, None], point.shape)
    return replace(
        view,
        point=(point * card).astype(np.float32),
        normal=(normal * card).astype(np.float32),
        light_distance_m=(distance * card).astype(np.float32),
        light_cosine=(cosine * card).astype(np.float32),
        has_point=card,
        has_normal=card,
    )
