"""How uncertain a calibrated camera's projection is, over its image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.projection import by_motion, projected_with_jacobians
from surfclass.geometry import rays
from surfclass.rig import Camera
from surfclass.types import Bool, Float64

_GRID = (24, 18)
CENTRAL = 0.8  # of each side of the image: where the worst value is judged


@dataclass(frozen=True, slots=True, eq=False)
class ProjectionUncertainty:
    """Standard deviation of where a point projects, in its worst direction.

    Attributes:
        pixel: (rows, columns, 2) px, where.
        infinity_px: (rows, columns) of a point at infinity; `metre_px` of one at 1 m.
    """

    pixel: Float64
    infinity_px: Float64
    metre_px: Float64

    def worst(self, camera: Camera) -> tuple[float, float]:
        """Returns the largest of both in the central 80 % of the image."""
        size = np.array(camera.size)
        inside = (np.abs(self.pixel - (size - 1) / 2) <= CENTRAL * size / 2).all(axis=-1)
        return float(self.infinity_px[inside].max()), float(self.metre_px[inside].max())


def projection_uncertainty(
    camera: Camera, parameters: Float64, free: Bool, covariance: Float64, seen: Float64
) -> ProjectionUncertainty:
    """Propagates the parameters' covariance to the projection, with the camera's pose allowed to float.

    Other parameters go with another pose of the camera: a shifted principal point is nearly a turned
    camera. What counts is what is left after the motion that makes up for most of it over the part of
    the image where corners were seen: a rotation for points at infinity, any motion at 1 m (as in mrcal,
    D. Kogan, "Projection uncertainty").

    Args:
        camera: The camera.
        parameters: (9,).
        free: (9,) which of them were adjusted.
        covariance: (k, k) of those.
        seen: (n, 2) px, where corners were seen.

    Raises:
        ConfigurationError: If the distortion folds the image over.
    """
    width, height = camera.size
    u, v = np.linspace(0, width - 1, _GRID[0]), np.linspace(0, height - 1, _GRID[1])
    pixel = np.stack(np.meshgrid(u, v), axis=-1)
    x, y = rays(camera)[:, np.rint(pixel[..., 1]).astype(int), np.rint(pixel[..., 0]).astype(int)]
    ray = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3).astype(np.float64)
    _, by_point, by_parameters = projected_with_jacobians(ray, parameters)
    by_pose = by_point @ by_motion(ray)
    by_free = by_parameters[:, :, free]
    cell = np.array([width / _GRID[0], height / _GRID[1]])
    place = np.clip((seen // cell).astype(int), 0, np.array(_GRID) - 1)
    weight = np.zeros((_GRID[1], _GRID[0]))
    np.add.at(weight, (place[:, 1], place[:, 0]), 1.0)
    root = np.sqrt(np.repeat(weight.reshape(-1), 2))[:, None]
    result = []
    for count in (3, 6):
        turn = by_pose[:, :, :count].reshape(-1, count)
        change = by_free.reshape(len(turn), -1)
        implied, *_ = np.linalg.lstsq(turn * root, change * root, rcond=None)
        left = (change - turn @ implied).reshape(len(ray), 2, -1)
        spread = left @ covariance @ np.swapaxes(left, 1, 2)
        result.append(np.sqrt(np.linalg.eigvalsh(spread)[:, -1].clip(0)).reshape(weight.shape))
    return ProjectionUncertainty(pixel, *result)
