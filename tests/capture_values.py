"""Small captures, rigs and data folders for the tests of folders, recordings and sources."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.recordings.captures_csv import COLUMNS
from drivers.recordings.format import capture_images
from surfclass.frames import Capture, ColourFrame, DepthFrame, JointState
from surfclass.types import Transform

WIDTH, HEIGHT = 8, 6
DEPTH_WIDTH, DEPTH_HEIGHT = 7, 5

_CAMERA = "fx = 10.0\nfy = 10.0\ncx = 3.5\ncy = 2.5\n"
DEPTH_ONLY_TOML = (
    'schema = 1\nname = "bench"\nvoxel_size_m = 0.01\n'
    f"[depth]\nsize = [{DEPTH_WIDTH}, {DEPTH_HEIGHT}]\n{_CAMERA}"
)
RIG_TOML = DEPTH_ONLY_TOML + (
    f"[rgb]\nsize = [{WIDTH}, {HEIGHT}]\n{_CAMERA}"
    "[transforms]\nrgb_T_depth = [[1, 0, 0, 0.02], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
)
CLASSES_TOML = 'names = ["rusted", "blasted"]\ncolours = ["#b7410e", "#9aa5ad"]\n'
PLATE_TOML = "disc_radius_m = 0.018\npositions_base_m = [[1, 0, 0.5], [1, 0.1, 0.5], [1, 0, 0.6]]\n"


def capture(seed: int = 0, name: str | None = None, role: str = "test", **changes: Any) -> Capture:
    """A capture with every optional part and odd but legal values; `changes` replace its fields."""
    rng = np.random.default_rng(seed)
    t_ns = 1_000_000_000 + seed * 100_000_000

    def image(
        height: int, width: int, *channels: int, kind: type = np.uint8, below: int = 256
    ) -> NDArray[Any]:
        return rng.integers(0, below, (height, width, *channels)).astype(kind)

    fields: dict[str, Any] = {
        "name": name or f"c{seed:03d}",
        "role": role,
        "depth": DepthFrame(
            t_ns + 7_000_001,
            40 + seed,
            1 / 3,
            image(DEPTH_HEIGHT, DEPTH_WIDTH, kind=np.uint16, below=65536),
            image(DEPTH_HEIGHT, DEPTH_WIDTH, kind=np.uint16, below=65536),
        ),
        "colour": ColourFrame(t_ns, 70 + seed, 0.008, image(HEIGHT, WIDTH, 3)),
        "dark": ColourFrame(t_ns + 90_000_000, 71 + seed, 0.008, image(HEIGHT, WIDTH, 3), 400, -1.5),
        "joints": JointState(t_ns, 1_500_000, rng.normal(size=6)),
        "base_T_depth": Transform("base", "depth", pose(rng)),
        "label": image(HEIGHT, WIDTH, below=3),
        "light_level": 0.1 + 0.2,
        "joint_motion_rad": 1e-5 / 3,
        "skew_ns": 7_000_001,
        "light_timing": "hardware",
    }
    return Capture(**{**fields, **changes})


def pose(rng: np.random.Generator) -> NDArray[np.float64]:
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    matrix[:3, 3] = rng.normal(size=3)
    return matrix


def assert_same(one: Capture, other: Capture) -> None:
    """Every field equal, bit for bit, pixels with their types."""
    plain = ("name", "role", "light_level", "light_timing", "joint_motion_rad", "skew_ns", "t_ns")
    assert [getattr(one, key) for key in plain] == [getattr(other, key) for key in plain]
    images, others = capture_images(one), capture_images(other)
    assert images.keys() == others.keys()
    for kind, pixels in images.items():
        assert pixels.dtype == others[kind].dtype, kind
        np.testing.assert_array_equal(pixels, others[kind], err_msg=kind)
    for kind in ("depth", "colour", "dark"):
        frame, twin = getattr(one, kind), getattr(other, kind)
        assert (frame is None) == (twin is None), kind
        if frame is not None:
            told = ("t_ns", "t_sd_ns", "sequence", "exposure_s", *(["gain_db"] if kind != "depth" else []))
            assert [getattr(frame, key) for key in told] == [getattr(twin, key) for key in told], kind
    assert (one.joints is None) == (other.joints is None)
    if one.joints is not None and other.joints is not None:
        assert (one.joints.t_ns, one.joints.t_sd_ns) == (other.joints.t_ns, other.joints.t_sd_ns)
        np.testing.assert_array_equal(one.joints.q, other.joints.q)
    assert (one.base_T_depth is None) == (other.base_T_depth is None)
    if one.base_T_depth is not None and other.base_T_depth is not None:
        np.testing.assert_array_equal(one.base_T_depth.matrix, other.base_T_depth.matrix)


def write_image(path: Path, image: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = image if image.ndim == 2 else image[:, :, ::-1]
    assert cv2.imwrite(str(path), stored)


def row_of(of: Capture) -> dict[str, str]:
    """The capture's row of captures.csv, with every digit."""
    row = {"name": of.name, "role": of.role, "t_ns": str(of.t_ns), "exposure_s": ""}
    if of.colour is not None and of.colour.exposure_s is not None:
        row["exposure_s"] = repr(of.colour.exposure_s)
    for axis in range(6):
        row[f"q{axis + 1}"] = "" if of.joints is None else repr(float(of.joints.q[axis]))
    for i in range(3):
        for j in range(4):
            row[f"p{i}{j}"] = "" if of.base_T_depth is None else repr(float(of.base_T_depth.matrix[i, j]))
    return row


def write_folder(folder: Path, captures: list[Capture], suffix: str = ".png") -> Path:
    """A data folder of the captures."""
    folder.mkdir(exist_ok=True)
    (folder / "rig.toml").write_text(RIG_TOML)
    (folder / "classes.toml").write_text(CLASSES_TOML)
    write_rows(folder, [row_of(one) for one in captures])
    for one in captures:
        for kind, pixels in capture_images(one).items():
            write_image(folder / kind / (one.name + (suffix if kind == "colour" else ".png")), pixels)
    return folder


def write_rows(folder: Path, rows: list[dict[str, str]], columns: tuple[str, ...] = COLUMNS) -> None:
    with (folder / "captures.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
