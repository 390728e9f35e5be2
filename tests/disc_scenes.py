"""Reflector discs drawn with exact places: what detectors of them are held against."""

from dataclasses import dataclass, field, fields

import cv2
import numpy as np

from calibration.hand_eye.discs_find import look_for_discs
from calibration.rotations import motion
from surfclass.frames import DepthFrame
from surfclass.geometry import project, rays
from surfclass.rig import Camera

CAMERA = Camera(
    size=(640, 480), fx=585.0, fy=583.0, cx=321.3, cy=242.1, distortion=(-0.05, 0.04, 0.001, -0.0007, 0.0)
)
RADIUS_M = 0.025
PLACES_M = np.array(
    [
        [0.07, 0.08, 0], [0.25, 0.07, 0], [0.46, 0.09, 0],
        [0.08, 0.22, 0], [0.29, 0.24, 0], [0.47, 0.23, 0],
        [0.07, 0.40, 0], [0.23, 0.39, 0], [0.45, 0.41, 0],
    ]
) - [0.27, 0.24, 0]  # fmt: skip

_FULL = 1023
_EXPOSED = {}  # the exposures so far: many tests look at the same plate


def straightened(pixels):
    """The tangents x/z, y/z of pixels (n, 2), by fixed points of the lens' model."""
    k1, k2, p1, p2, k3 = CAMERA.distortion
    given = (pixels - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    found = given
    for _ in range(12):
        x, y = found.T
        r2 = x * x + y * y
        shift = np.column_stack(
            [2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
        )
        found = (given - shift) / (1 + r2 * (k1 + r2 * (k2 + r2 * k3)))[:, None]
    return found


@dataclass(eq=False)
class Plate:
    """A dark plate in front of a wall; discs shine."""

    tilt_deg: tuple[float, float, float] = (15, -10, 5)
    middle_m: tuple[float, float, float] = (0.0, 0.0, 0.85)
    places_m: np.ndarray = field(default_factory=PLACES_M.copy)
    brightness: float = 500.0
    speckle: float = 0.5
    blur_px: float = 0.6
    noise_counts: float = 2.0
    depth_noise: float = 0.10  # px of disparity
    seed: int = 0

    def __post_init__(self):
        six = np.concatenate([np.radians(self.tilt_deg), self.middle_m])
        self.camera_T_plate = motion(six, "depth", "plate")
        self.rng = np.random.default_rng(self.seed)

    @property
    def centres_m(self):
        return self.camera_T_plate @ self.places_m

    @property
    def pixels(self):
        return project(self.centres_m, CAMERA)

    def on_plate(self):
        """Each pixel's place on the plate, (2, h, w) m, and its depth (h, w) m."""
        x, y = rays(CAMERA).astype(float)
        ray = np.stack([x, y, np.ones_like(x)])
        rotation, shift = self.camera_T_plate.rotation, self.camera_T_plate.translation
        z = (rotation[:, 2] @ shift) / np.tensordot(rotation[:, 2], ray, axes=1)
        place = np.tensordot(rotation.T, ray * z - shift[:, None, None], axes=1)
        return place[:2], z

    def irradiance(self, oversampled=5):
        """(h, w) counts without noise; discs' edges by sub-pixel sampling."""
        share = np.zeros(CAMERA.shape)
        rotation, shift = self.camera_T_plate.rotation, self.camera_T_plate.translation
        steps = (np.arange(oversampled) + 0.5) / oversampled - 0.5
        for centre, pixel in zip(self.centres_m, self.pixels, strict=True):
            reach = int(1.4 * CAMERA.fx * RADIUS_M / centre[2] + 4)
            u, v = np.round(pixel).astype(int)
            columns = np.arange(max(0, u - reach), min(CAMERA.size[0], u + reach + 1))
            rows = np.arange(max(0, v - reach), min(CAMERA.size[1], v + reach + 1))
            if not (len(rows) and len(columns)):
                continue
            fine = np.meshgrid((columns[:, None] + steps).ravel(), (rows[:, None] + steps).ravel())
            tangent = straightened(np.stack(fine, axis=-1).reshape(-1, 2))
            ray = np.column_stack([tangent, np.ones(len(tangent))])
            z = (rotation[:, 2] @ shift) / (ray @ rotation[:, 2])
            inside = ((ray * z[:, None] - centre) ** 2).sum(axis=1) <= RADIUS_M**2
            blocks = inside.reshape(len(rows), oversampled, len(columns), oversampled)
            share[np.ix_(rows, columns)] += blocks.mean(axis=(1, 3))
        grain = cv2.GaussianBlur(self.rng.normal(size=CAMERA.shape), (0, 0), 1.0)
        grain = np.exp(self.speckle * grain / grain.std() - self.speckle**2 / 2)
        return cv2.GaussianBlur((share * self.brightness + 8) * grain, (0, 0), self.blur_px)

    def _exposed(self):
        counts = self.irradiance() + self.noise_counts * self.rng.normal(size=CAMERA.shape)
        place, z = self.on_plate()
        on = (np.abs(place[0]) < 0.29) & (np.abs(place[1]) < 0.26)
        depth = np.where(on, z, 1.6)
        noise = cv2.GaussianBlur(self.rng.normal(size=CAMERA.shape), (0, 0), 1.2)
        noise *= self.depth_noise / noise.std()
        return counts, 44.0 / (np.round((44.0 / depth + noise) * 8) / 8)

    def frame(self, edit=None):
        """One exposure; `edit` may change counts (float) and depth in m before they are rounded."""
        key = tuple(np.asarray(getattr(self, one.name)).tobytes() for one in fields(self))
        if key not in _EXPOSED:
            _EXPOSED[key] = self._exposed()
        counts, depth = (image.copy() for image in _EXPOSED[key])
        if edit is not None:
            counts, depth = edit(counts, depth)
        ir = np.clip(np.round(counts), 0, _FULL).astype(np.uint16)
        return DepthFrame(0, 0, None, np.round(depth * 1000).astype(np.uint16), ir)

    def mask(self, grow=1.0):
        """(h, w) pixels on a disc whose radius is `grow` times as large."""
        place, _ = self.on_plate()
        away = [np.hypot(place[0] - x, place[1] - y) for x, y, _ in self.places_m]
        return np.min(away, axis=0) < grow * RADIUS_M


def find_discs(frame, camera, radius_m):
    """The discs alone, without what was not taken for one."""
    return list(look_for_discs(frame, camera, radius_m).discs)
