"""The values that flow through the pipeline; each is frozen and says its shapes, units and frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias, overload

import numpy as np
from numpy.typing import NDArray

Float32: TypeAlias = NDArray[np.float32]
Float64: TypeAlias = NDArray[np.float64]
Int32: TypeAlias = NDArray[np.int32]
Bool: TypeAlias = NDArray[np.bool_]

_ROTATION_TOLERANCE = 1e-4  # poses in files carry 4 to 9 digits


def freeze(array: NDArray[Any]) -> NDArray[Any]:
    """Returns a view of `array` that cannot be written through."""
    view = array.view()
    view.flags.writeable = False
    return view


@dataclass(frozen=True, slots=True, eq=False)
class Transform:
    """The pose of frame `src` in frame `dst`: `T_dst_src @ point_in_src` is the point in `dst`.

    Attributes:
        dst: The frame that coordinates come out in.
        src: The frame that coordinates go in from.
        matrix: (4, 4) float64, metres.

    Raises:
        ValueError: If the matrix is not a rigid motion (a rotation with determinant +1).
    """

    dst: str
    src: str
    matrix: Float64

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, dtype=np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise ValueError(f"{self.dst}_T_{self.src}: needs 4 × 4 finite numbers")
        rotation = matrix[:3, :3]
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if error > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
            raise ValueError(
                f"{self.dst}_T_{self.src}: the upper 3 × 3 is no rotation (R·Rᵀ is off by "
                f"{error:.2g}, det {np.linalg.det(rotation):+.3f}; allowed {_ROTATION_TOLERANCE:g}, +1)"
            )
        if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 0:
            raise ValueError(f"{self.dst}_T_{self.src}: the last row must be 0 0 0 1")
        object.__setattr__(self, "matrix", freeze(matrix))

    @property
    def rotation(self) -> Float64:
        """(3, 3)."""
        return self.matrix[:3, :3]

    @property
    def translation(self) -> Float64:
        """(3,) m."""
        return self.matrix[:3, 3]

    @property
    def inverse(self) -> Transform:
        """The pose of `dst` in `src`."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation.T
        matrix[:3, 3] = -self.rotation.T @ self.translation
        return Transform(self.src, self.dst, matrix)

    @overload
    def __matmul__(self, other: Transform) -> Transform: ...
    @overload
    def __matmul__(self, other: NDArray[Any]) -> NDArray[Any]: ...

    def __matmul__(self, other: Transform | NDArray[Any]) -> Transform | NDArray[Any]:
        """Chains two poses whose inner frames agree, or moves points of shape (…, 3).

        Points are rows, so this is `points @ R.T + t` (Eq. A.10 with the transpose it lacks); the
        points' dtype is kept.

        Raises:
            ValueError: If the inner frames differ.
        """
        if isinstance(other, Transform):
            if self.src != other.dst:
                raise ValueError(
                    f"{self.dst}_T_{self.src} @ {other.dst}_T_{other.src}: "
                    f"the inner frames {self.src!r} and {other.dst!r} differ"
                )
            return Transform(self.dst, other.src, self.matrix @ other.matrix)
        kind = other.dtype if np.issubdtype(other.dtype, np.floating) else np.dtype(np.float64)
        moved: NDArray[Any] = other @ self.rotation.T.astype(kind) + self.translation.astype(kind)
        return moved

    def move_planes(self, planes: Float32) -> Float32:
        """Returns (3, …) coordinates, held as planes x, y, z, moved from `src` to `dst`."""
        flat = planes.reshape(3, -1)
        moved: Float32 = self.rotation.astype(np.float32) @ flat
        moved += self.translation.astype(np.float32)[:, None]
        return moved.reshape(planes.shape)


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceView:
    """What each colour pixel looks at, in the `rgb` frame; images are planes of shape (h, w).

    A pixel without a surface point has zeros and `has_point` false; one without a trustworthy
    normal has a zero normal and `has_normal` false. Nothing here is NaN.

    Attributes:
        point: (3, h, w) float32, m.
        normal: (3, h, w) float32, unit, turned to the camera.
        viewing_distance_m: (h, w) float32, point to the colour camera's centre (d_c, Eq. 3.8).
        viewing_cosine: (h, w) float32, cosine of the viewing angle (theta_c, Eq. 3.7).
        light_distance_m: (h, w) float32, point to the light (d_l, Eq. 4.14); None without a light.
        light_cosine: (h, w) float32, cosine of the incidence angle (theta_l, Eq. 4.13), negative
            where the light is behind the surface; None without a light.
        has_point: (h, w) bool.
        has_normal: (h, w) bool; implies `has_point`.
    """

    point: Float32
    normal: Float32
    viewing_distance_m: Float32
    viewing_cosine: Float32
    light_distance_m: Float32 | None
    light_cosine: Float32 | None
    has_point: Bool
    has_normal: Bool


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """One route's class distribution over an image of cells: pixels, or windows of the texture route.

    Attributes:
        probability: (h, w, k) float32, sums to 1 where `valid`, else 0.
        valid: (h, w) bool; a cell that is unseen, unusable or rejected is False, never guessed.
        rejected: (h, w) bool; seen and usable, but far from every class (label "unknown").
        cell_px: Side of a cell in colour pixels: 1, or the window of the texture route. Cell
            (r, c) covers the pixels [r·cell_px, (r+1)·cell_px) × [c·cell_px, (c+1)·cell_px).
    """

    probability: Float32
    valid: Bool
    rejected: Bool
    cell_px: int = 1

    def label(self) -> NDArray[np.uint8]:
        """(h, w): 1 + the index of the most probable class, 0 where not `valid`."""
        best = self.probability.argmax(axis=2).astype(np.uint8) + np.uint8(1)
        return np.where(self.valid, best, np.uint8(0))


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What one frame says about n surface points, ready for the map.

    Likelihoods are posteriors divided by the classifier's training prior, in log space, clipped so
    that no class ever reaches zero.

    Attributes:
        point_base: (n, 3) float32, m, in `base`.
        colour: (n, k) float32 log-likelihoods, zero rows where `has_colour` is False.
        texture: (n, k) float32 log-likelihoods, zero rows where `has_texture` is False.
        has_colour: (n,) bool.
        has_texture: (n,) bool.
        weight: (n,) float32 in [0, 1], the probability map's value (Eq. 5.19) for each point;
            0 where `has_texture` is False.
    """

    point_base: Float32
    colour: Float32
    texture: Float32
    has_colour: Bool
    has_texture: Bool
    weight: Float32

    def of(self, chosen: Bool) -> Observation:
        """Returns the points where `chosen` (n,) is True."""
        return Observation(
            self.point_base[chosen],
            self.colour[chosen],
            self.texture[chosen],
            self.has_colour[chosen],
            self.has_texture[chosen],
            self.weight[chosen],
        )


@dataclass(frozen=True, slots=True, eq=False)
class MapUpdate:
    """The new state of some voxels: a delta (those that changed) or a snapshot (all of them).

    State, not increments: applying an update twice, or after a newer snapshot that contains it,
    changes nothing. `sequence` counts the deltas of one `epoch` from 1; a snapshot carries the
    number of the last delta that it contains.

    Attributes:
        epoch: Random id of one life of the map (hex uuid); a new one means: start from nothing.
        sequence: As above.
        t_ns: Mid-exposure of the newest capture in it, CLOCK_MONOTONIC of the robot PC.
        index: (n, 3) int32, the voxels.
        colour: (n, k) float32, accumulated log-likelihood of the colour layer.
        texture: (n, k) float32, the same of the texture layer.
        weight: (n,) float32, sum of the probability map's values.
        colour_count: (n,) int32, observations in the colour layer.
        texture_count: (n,) int32, observations in the texture layer.
    """

    epoch: str
    sequence: int
    t_ns: int
    index: Int32
    colour: Float32
    texture: Float32
    weight: Float32
    colour_count: Int32
    texture_count: Int32
