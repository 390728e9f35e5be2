"""The near-light model: what a flat board sends to the camera, and its derivatives by everything unknown.

    E = vignetting(r) · cosⁿψ / d² · (K_d cos θ_l (T(θ_l) T(θ_c))^c + K_s / cos θ_c · lobe(α))

Torrance–Sparrow (Eq. 4.1, 4.3) with the LED's angular fall-off and the lens' vignetting, linear in light. The
lobe is `(1 + q t)^(−1/q)` with `t = tan²α / m²`: Gaussian facets for q → 0, long tails as of GGX for q = ½.
What a semi-gloss board shines diffusely goes through its coat twice, and Fresnel's T lets a little less
through
at an angle (Wolff 1994): 0.1 % at 25°, and enough to move the light by 5 mm where only boards are seen. How
much of a coat there is, c from 0 to 1, is fitted too; Lambertian targets have none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from calibration.light.samples import BoardSamples
from surfclass.types import Bool, Float64

POSITION, AXIS, EXPONENT, VIGNETTING = slice(0, 3), slice(3, 5), 5, slice(6, 9)
COAT = 9
GLOBAL = 10
"""How many parameters all views share: x, y, z; axis x/z, y/z; n; v2, v4, v6; c."""

NAMES = ("x", "y", "z", "axis x", "axis y", "n", "v2", "v4", "v6", "c")
EXPECTED = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0, -2.0, 3.0, -2.0, 0.5])
"""What is thought of them beforehand: a Lambertian LED that looks ahead, and a lens that darkens by cos⁴."""

_LOBE = 3  # parameters of a board's lobe: ln K_s, ln m, √q
_LEAST = 1e-6
_INDEX = 1.5  # of refraction of coats and plastics


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """The places of all views, stacked: n of them.

    Attributes:
        names: Of the views.
        view: (n,) which view.
        albedo: (n,) which K_d: each board has its own, all Lambertian views share one.
        lobe: (n,) which lobe, −1 for Lambertian views.
        ray: (n, 2); `point` (n, 3) m; `normal` (n, 3) of the board.
        light: (n,) measured irradiance, the mean of the channels.
        sd: (n,) of it.
        level: (n, 3) intensities that it was computed from, fractions of full scale.
    """

    names: tuple[str, ...]
    view: NDArray[np.intp]
    albedo: NDArray[np.intp]
    lobe: NDArray[np.intp]
    ray: Float64
    point: Float64
    normal: Float64
    light: Float64
    sd: Float64
    level: Float64

    @classmethod
    def of(cls, views: Sequence[BoardSamples]) -> Observed:
        """Stacks the views."""
        albedo: list[int] = []
        lobe: list[int] = []
        boards = sum(view.kind == "board" for view in views)
        for view in views:
            board = view.kind == "board"
            albedo.append(sum(lobe_ >= 0 for lobe_ in lobe) if board else boards)
            lobe.append(albedo[-1] if board else -1)
        view_of = np.repeat(np.arange(len(views)), [len(view.ray) for view in views])
        normals = np.array([view.plane.normal for view in views])
        sd = np.concatenate([view.sd for view in views])
        return cls(
            tuple(view.name for view in views),
            view_of,
            np.array(albedo)[view_of],
            np.array(lobe)[view_of],
            np.concatenate([view.ray for view in views]),
            np.concatenate([view.point for view in views]),
            normals[view_of],
            np.concatenate([view.light for view in views]).mean(axis=1),
            np.asarray(np.sqrt((sd**2).sum(axis=1)) / 3),
            np.concatenate([view.level for view in views]),
        )

    @property
    def albedos(self) -> int:
        """How many K_d there are."""
        return int(self.albedo.max()) + 1

    @property
    def lobes(self) -> int:
        """How many boards with a lobe there are."""
        return int(self.lobe.max()) + 1

    @property
    def size(self) -> int:
        """How many parameters the model has: light and lens, ln K_d of each, each lobe's three."""
        return GLOBAL + self.albedos + _LOBE * self.lobes


def unit_axis(parameters: Float64) -> Float64:
    """Returns the LED's axis (3,) of the parameters."""
    whole = np.append(parameters[AXIS], 1.0)
    return np.asarray(whole / np.linalg.norm(whole))


def starting_point(observed: Observed, position: Float64) -> Float64:
    """Returns parameters to begin with: a Lambertian LED that looks along z, a lens that darkens by cos⁴."""
    start = np.zeros(observed.size)
    start[:GLOBAL] = EXPECTED
    start[POSITION] = position
    for board in range(observed.lobes):
        start[lobe_of(observed, board)] = (0.0, np.log(0.1), 0.3)
    return with_albedos(start, observed)


def with_albedos(parameters: Float64, observed: Observed) -> Float64:
    """Returns the parameters with every K_d as light and lens have it, the median over its views."""
    fitted = parameters.copy()
    diffuse, _ = emitted(fitted, observed)
    ratio = np.log(np.maximum(observed.light, _LEAST) / np.maximum(diffuse, _LEAST))
    for albedo in range(observed.albedos):
        fitted[GLOBAL + albedo] += np.median(ratio[observed.albedo == albedo])
    return fitted


def bounds(observed: Observed) -> tuple[Float64, Float64]:
    """Returns the least and the greatest parameters that make sense: the LED does not shine inwards."""
    low, high = np.full(observed.size, -np.inf), np.full(observed.size, np.inf)
    low[EXPONENT], high[EXPONENT] = 0.0, 30.0
    low[COAT], high[COAT] = 0.0, 1.0
    for board in range(observed.lobes):
        low[lobe_of(observed, board)] = (-12.0, np.log(0.01), 0.0)
        high[lobe_of(observed, board)] = (8.0, np.log(0.7), 1.0)
    return low, high


def lobe_of(observed: Observed, board: int) -> slice:
    """Returns where a board's ln K_s, ln m and √q are."""
    first = GLOBAL + observed.albedos + _LOBE * board
    return slice(first, first + _LOBE)


def emitted(parameters: Float64, observed: Observed) -> tuple[Float64, Float64]:
    """Returns the diffuse and the specular irradiance (n,) each."""
    diffuse, specular, _ = with_jacobian(parameters, observed, jacobian=False)
    return diffuse, specular


def geometry_factor(parameters: Float64, observed: Observed) -> Float64:
    """Returns (n,) what K_d is multiplied by: cos θ_l · led · vignetting / d²."""
    one = parameters.copy()
    one[GLOBAL : GLOBAL + observed.albedos] = 0.0
    return emitted(one, observed)[0]


def with_jacobian(
    parameters: Float64, observed: Observed, jacobian: bool = True
) -> tuple[Float64, Float64, Float64]:
    """Returns diffuse and specular irradiance (n,) each, and the derivatives (n, p) of their sum."""
    n = len(observed.light)
    towards = parameters[POSITION] - observed.point
    d2 = np.einsum("ni,ni->n", towards, towards)
    d = np.sqrt(d2)
    to_light = towards / d[:, None]
    axis = np.append(parameters[AXIS], 1.0)
    along = -(towards @ axis)
    lit = along > _LEAST
    led = np.where(lit, along / (d * np.linalg.norm(axis)), _LEAST)
    r2 = np.einsum("ni,ni->n", observed.ray, observed.ray)
    v2, v4, v6 = parameters[VIGNETTING]
    vignetting = np.maximum(1 + r2 * (v2 + r2 * (v4 + r2 * v6)), 1e-2)
    base = vignetting * led ** parameters[EXPONENT] / d2
    cosine = np.einsum("ni,ni->n", to_light, observed.normal)
    albedo = np.exp(parameters[GLOBAL + observed.albedo])
    transmission, d_transmission = _transmission(cosine, observed)
    through = np.exp(parameters[COAT] * transmission)
    diffuse = base * albedo * np.maximum(cosine, 0.0) * through
    specular = np.zeros(n)
    lobe = _Lobe.of(parameters, observed, to_light)
    if lobe is not None:
        specular[lobe.places] = base[lobe.places] * lobe.value
    if not jacobian:
        return diffuse, specular, np.empty((0, 0))

    total = diffuse + specular
    matrix = np.zeros((n, len(parameters)))
    exponent = parameters[EXPONENT]
    over_d = to_light / d[:, None]
    d_log_led = np.where(lit[:, None], -axis / np.where(lit, along, 1.0)[:, None] - over_d, 0.0)
    matrix[:, POSITION] = total[:, None] * (exponent * d_log_led - 2 * over_d)
    d_cosine = observed.normal / d[:, None] - cosine[:, None] * over_d
    by_cosine = base * albedo * (cosine > 0) * through + diffuse * parameters[COAT] * d_transmission
    matrix[:, POSITION] += by_cosine[:, None] * d_cosine
    d_axis = -towards / np.where(lit, along, 1.0)[:, None] - axis / (axis @ axis)
    matrix[:, AXIS] = (total * exponent * lit)[:, None] * d_axis[:, :2]
    matrix[:, EXPONENT] = total * np.log(led)
    matrix[:, VIGNETTING] = (total / vignetting)[:, None] * np.stack([r2, r2**2, r2**3], axis=1)
    matrix[:, COAT] = diffuse * transmission
    matrix[np.arange(n), GLOBAL + observed.albedo] = diffuse
    if lobe is not None:
        lobe.differentiate(matrix, base, to_light, d, observed)
    return diffuse, specular, matrix


def _transmission(cosine: Float64, observed: Observed) -> tuple[Float64, Float64]:
    """Returns ln T(θ_l) T(θ_c) / T(0)² of boards (n,), 0 elsewhere, and its derivative by cos θ_l."""
    board = observed.lobe >= 0
    table, log_t, slope = _fresnel()
    distance = np.linalg.norm(observed.point, axis=1)
    view = -np.einsum("ni,ni->n", observed.point, observed.normal) / distance
    whole = np.interp(cosine, table, log_t) + np.interp(view, table, log_t)
    return np.where(board, whole, 0.0), np.where(board, np.interp(cosine, table, slope), 0.0)


@cache
def _fresnel() -> tuple[Float64, Float64, Float64]:
    """Cosines, ln T / T(0) of unpolarised light into the coat, and its derivative by the cosine."""
    cosine = np.linspace(0.02, 1, 4001)
    inside = np.sqrt(1 - (1 - cosine**2) / _INDEX**2)
    across = (cosine - _INDEX * inside) / (cosine + _INDEX * inside)
    along = (inside - _INDEX * cosine) / (inside + _INDEX * cosine)
    log_t = np.log(1 - (across**2 + along**2) / 2)
    log_t -= log_t[-1]
    return cosine, log_t, np.gradient(log_t, cosine)


@dataclass(frozen=True, slots=True, eq=False)
class _Lobe:
    """K_s / cos θ_c · lobe(α) of the places (k,) of boards, and its derivatives."""

    places: NDArray[np.intp]
    value: Float64
    by_alpha: Float64  # d ln(value) / d cos α
    by_width: Float64
    by_tail: Float64
    half: Float64
    half_length: Float64
    cos_alpha: Float64

    @classmethod
    def of(cls, parameters: Float64, observed: Observed, to_light: Float64) -> _Lobe | None:
        places = np.flatnonzero(observed.lobe >= 0)
        if not places.size:
            return None
        point, normal = observed.point[places], observed.normal[places]
        to_camera = -point / np.linalg.norm(point, axis=1)[:, None]
        half = to_light[places] + to_camera
        length = np.linalg.norm(half, axis=1)
        half /= length[:, None]
        cos_alpha = np.clip(np.einsum("ni,ni->n", half, normal), 0.05, 1.0)
        first = GLOBAL + observed.albedos + _LOBE * observed.lobe[places]
        strength, width, root = (parameters[first + index] for index in range(_LOBE))
        q, m2 = root**2, np.exp(2 * width)
        t = (1 / cos_alpha**2 - 1) / m2
        small = q * t < 1e-4
        safe = np.where(small, 1.0, q)
        exponent = np.where(small, -t + q * t**2 / 2, -np.log1p(q * t) / safe)
        by_q = np.where(
            small, t**2 / 2 - 2 * q * t**3 / 3, np.log1p(q * t) / safe**2 - t / (safe * (1 + q * t))
        )
        slope = 1 / (1 + q * t)
        cos_view = np.maximum(np.einsum("ni,ni->n", to_camera, normal), 0.05)
        value = np.exp(strength + exponent) / cos_view
        return cls(
            places,
            value,
            2 * slope / (m2 * cos_alpha**3),
            2 * t * slope,
            2 * root * by_q,
            half,
            length,
            cos_alpha,
        )

    def differentiate(
        self, matrix: Float64, base: Float64, to_light: Float64, d: Float64, observed: Observed
    ) -> None:
        """Adds what the lobe's own changes do to the derivatives."""
        specular = base[self.places] * self.value
        normal, light = observed.normal[self.places], to_light[self.places]
        across = (normal - self.cos_alpha[:, None] * self.half) / self.half_length[:, None]
        across -= np.einsum("ni,ni->n", across, light)[:, None] * light
        matrix[self.places, POSITION] += (specular * self.by_alpha / d[self.places])[:, None] * across
        first = GLOBAL + observed.albedos + _LOBE * observed.lobe[self.places]
        one = np.ones_like(specular)
        for index, factor in enumerate((one, self.by_width, self.by_tail)):
            matrix[self.places, first + index] = specular * factor


def shines_everywhere(parameters: Float64, observed: Observed) -> Bool:
    """Returns (n,) whether the LED's axis is less than 90° from each place and the board faces it."""
    towards = parameters[POSITION] - observed.point
    ahead = -(towards @ np.append(parameters[AXIS], 1.0)) > 0
    faces: Bool = ahead & (np.einsum("ni,ni->n", towards, observed.normal) > 0)
    return faces
