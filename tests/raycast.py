"""Analytic scenes for geometry tests: planes and spheres seen by a camera, ray by ray, in float64."""

from dataclasses import dataclass

import cv2
import numpy as np

from surfclass.rig import Camera, Rig, parse_rig

# IR to colour camera of the reference package: rotation vector in radians, translation in MILLIMETRES.
ROTATION_VECTOR = (-0.03674, -0.02362, 0.00861)
TRANSLATION_MM = (3.48739, 77.41613, 1.42057)


def real_extrinsics():
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array(ROTATION_VECTOR))[0]
    pose[:3, 3] = np.array(TRANSLATION_MM) * 1e-3
    return pose


def make_rig(
    rgb_size=(1280, 960), rgb_f=1624.734654, depth_size=(640, 480), depth_f=585.0, pose=None, extra="", **keys
) -> Rig:
    """A rig in the reference package's proportions; `keys` may give rgb_distortion and depth_distortion."""

    def camera(size, f, distortion):
        return (
            f"{{size = {list(size)}, fx = {f}, fy = {f}, cx = {(size[0] - 1) / 2}, cy = {(size[1] - 1) / 2}, "
            f"distortion = {list(distortion)}}}"
        )

    none = (0.0,) * 5
    pose = real_extrinsics() if pose is None else pose
    return parse_rig(
        f"""
        schema = 1
        name = "test"
        voxel_size_m = 0.01
        rgb = {camera(rgb_size, rgb_f, keys.get("rgb_distortion", none))}
        depth = {camera(depth_size, depth_f, keys.get("depth_distortion", none))}
        transforms = {{rgb_T_depth = {pose.tolist()}}}
        {extra}
        """,
        "test rig",
    )


@dataclass(frozen=True)
class Plane:
    """`normal · p = offset`, seen where `inside(p)` (all of it by default); normal (3,), offset in m."""

    normal: tuple[float, float, float]
    offset: float
    low: tuple[float, float] = (-np.inf, -np.inf)
    high: tuple[float, float] = (np.inf, np.inf)  # of x and y, in the frame of the plane

    def hit(self, origin, ray):
        """Distance along each ray (…, 3), inf where it misses."""
        along = ray @ np.array(self.normal)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (self.offset - origin @ np.array(self.normal)) / along
        p = origin + t[..., None] * ray
        inside = (t > 0) & (p[..., 0] >= self.low[0]) & (p[..., 0] <= self.high[0])
        inside &= (p[..., 1] >= self.low[1]) & (p[..., 1] <= self.high[1])
        return np.where(inside, t, np.inf)


def tilted(angle_deg, distance_m, about="y") -> Plane:
    """A plane through the optical axis at `distance_m`, turned about an image axis."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    normal = (s, 0.0, -c) if about == "y" else (0.0, s, -c)
    return Plane(normal, -c * distance_m)


def pixel_rays(camera: Camera):
    """(h, w, 3) rays with z = 1, by OpenCV's own undistortion of each pixel."""
    h, w = camera.shape
    grid = np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1).reshape(-1, 1, 2).astype(float)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    xy = cv2.undistortPoints(grid, camera.matrix, np.array(camera.distortion), criteria=criteria)
    return np.concatenate([xy.reshape(h, w, 2), np.ones((h, w, 1))], axis=-1)


def cast(surfaces, camera: Camera, frame_T_camera=None):
    """Returns depth along the axis in m (h, w), inf where nothing is hit, and the surface's index, −1.

    The surfaces are given in a frame in which the camera's pose is `frame_T_camera` (4 × 4).
    """
    pose = np.eye(4) if frame_T_camera is None else frame_T_camera
    ray = pixel_rays(camera) @ pose[:3, :3].T
    hits = np.stack([surface.hit(pose[:3, 3], ray) for surface in surfaces])
    nearest = hits.argmin(axis=0)
    depth = hits.min(axis=0)
    return depth, np.where(np.isfinite(depth), nearest, -1)


def as_mm(depth_m, quantised=True):
    """The depth image that an ideal camera delivers; float mm where it is not `quantised`."""
    mm = np.where(np.isfinite(depth_m), depth_m, 0) * 1e3
    return np.rint(mm).astype(np.uint16) if quantised else mm.astype(np.float32)


def kinect(depth_m, seed=0, sd_px=0.11, bits=8.0):
    """Kinect-like reading: disparity noise, in part correlated between neighbours, and 1/8 px steps.

    At 1 m one step is 2.85 mm and the whole noise about 2.9 mm, as real frames show.
    """
    rng = np.random.default_rng(seed)
    focal_baseline = 585 * 0.075
    seen = np.isfinite(depth_m)
    disparity = focal_baseline / np.where(seen, depth_m, 1)
    white = rng.normal(0, 1, depth_m.shape)
    smooth = cv2.GaussianBlur(rng.normal(0, 1, depth_m.shape), (0, 0), 1.0)
    noise = (white + smooth / smooth.std()) * sd_px / np.sqrt(2)
    disparity = np.rint((disparity + noise) * bits) / bits
    return np.where(seen, np.rint(1e3 * focal_baseline / np.maximum(disparity, 1)), 0).astype(np.uint16)
