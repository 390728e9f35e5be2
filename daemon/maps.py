"""Drawing results: a map as picture or PLY, captures beside what each route makes of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from daemon import pictures
from daemon.offline import console, load_map, load_model
from drivers.files import check_output, read_file
from drivers.recordings import Recording
from surfclass.errors import InputError
from surfclass.map_file import MapFile
from surfclass.pipeline import Pipeline, per_pixel
from surfclass.rig import SurfaceClasses, parse_classes
from surfclass.schema import validate

# Okabe and Ito's colours, which remain distinct for colour-blind readers.
_PALETTE = ("#d55e00", "#999999", "#009e73", "#e69f00", "#56b4e9", "#cc79a7", "#0072b2", "#f0e442")


def show(path: Path, png: Path | None, ply: Path | None, classes_path: Path | None) -> None:
    """Draws a map, or writes it as PLY, or both; without either, says what is in it."""
    check_output(png, ply)
    found = load_map(path)
    classes = _classes(found, classes_path)
    layers = found.layers
    label = layers.label()
    counts = np.bincount(label, minlength=len(classes.names) + 1)
    console.print(f"{path}: {len(layers.index):,} voxels of {found.voxel_size_m * 1000:g} mm")
    for name, count in zip((*classes.names, "unknown"), (*counts[1:], counts[0]), strict=True):
        if count or name != "unknown":
            console.print(f"  {name:<12} {count:>8,}")
    if png is not None:
        pictures.draw_map(png, layers, found.voxel_size_m, classes.names, classes.rgb)
        console.print(f"{png}: picture")
    if ply is not None:
        write_ply(ply, found, classes.rgb)
        console.print(f"{ply}: points, coloured by class")


def write_ply(path: Path, found: MapFile, class_rgb: NDArray[np.uint8]) -> None:
    """Writes the voxels' centres, in `base`, as a binary PLY coloured by class, unknown ones dark.

    Raises:
        InputError: If the file cannot be written.
    """
    import open3d  # late: two seconds and 200 MB

    cloud = open3d.geometry.PointCloud()
    centres = (found.layers.index.astype(np.float64) + 0.5) * found.voxel_size_m
    cloud.points = open3d.utility.Vector3dVector(centres)
    cloud.colors = open3d.utility.Vector3dVector(pictures.coloured(found.layers.label(), class_rgb) / 255.0)
    part = path.with_name(f".{path.stem}.part.ply")
    try:
        if not open3d.io.write_point_cloud(part, cloud):
            raise InputError(f"{path}: the PLY could not be written")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _classes(found: MapFile, path: Path | None) -> SurfaceClasses:
    """The classes with their colours: from a file, from the map, or from a palette."""
    if path is None:
        palette = tuple(_PALETTE[k % len(_PALETTE)] for k in range(len(found.classes)))
        return validate(SurfaceClasses, {"names": found.classes, "colours": found.colours or palette}, "map")
    classes = parse_classes(read_file(path, "classes"), str(path))
    if classes.names != found.classes:
        raise InputError(
            f"{path}: has the classes {', '.join(classes.names)}, the map {', '.join(found.classes)}"
        )
    return classes


def show_captures(recording_path: Path, png: Path, names: list[str], model_path: Path | None) -> None:
    """Draws captures in rows: colour, depth, truth and, with a model, what each route makes of them."""
    check_output(png)
    recording = Recording.open(recording_path)
    rows: list[tuple[str, list[tuple[str, pictures.RGB]]]] = []
    pipeline = None
    if model_path is not None:
        pipeline = Pipeline(recording.rig, load_model(model_path))
    for capture in recording.captures():
        if capture.colour is None or (capture.name not in names if names else len(rows) >= 4):
            continue
        image = capture.colour.rgb
        row: list[tuple[str, pictures.RGB]] = [
            ("colour", (image // 256 if image.dtype == np.uint16 else image).astype(np.uint8)),
            ("depth", depth_picture(capture.depth.depth_mm)),
        ]
        palette = None if recording.classes is None else recording.classes.rgb
        if palette is not None:
            label = np.zeros(image.shape[:2], np.uint8) if capture.label is None else capture.label
            row.append(("truth", pictures.coloured(label, palette)))
        if pipeline is not None:
            row += route_pictures(pipeline, capture)
        rows.append((capture.name, row))
    absent = sorted(set(names) - {name for name, _ in rows})
    if absent or not rows:
        named = f" named {', '.join(absent)}" if absent else ""
        raise InputError(f"{recording_path}: no capture with a colour image{named}")
    pictures.draw_views(png, rows)
    console.print(f"{png}: {len(rows)} captures")


def route_pictures(pipeline: Pipeline, capture: Any) -> list[tuple[str, pictures.RGB]]:
    """Returns what the routes make of a capture, and how far texture is trusted, as pictures."""
    feature = pipeline.rig.features.colour
    classified = pipeline.classify(capture, (feature,))
    colour, texture = classified.colour[feature], classified.texture
    palette = pipeline.model.classes.rgb
    shape = classified.view.has_point.shape
    weight = (classified.weight * 255).astype(np.uint8)
    return [
        (feature, pictures.coloured(colour.label(), palette)),
        (
            pipeline.model.texture.feature,
            pictures.coloured(per_pixel(texture.label(), texture.cell_px, shape), palette),
        ),
        ("texture's weight", np.repeat(weight[..., None], 3, axis=2)),
    ]


def depth_picture(depth_mm: NDArray[np.uint16]) -> pictures.RGB:
    """Returns depth as colours from near (blue) to far (red); no return is black."""
    seen = depth_mm > 0
    if not seen.any():
        return np.zeros((*depth_mm.shape, 3), np.uint8)
    low, high = np.percentile(depth_mm[seen], (1, 99))
    scaled = np.clip((depth_mm - low) / max(high - low, 1) * 255, 0, 255).astype(np.uint8)
    drawn: pictures.RGB = cv2.applyColorMap(scaled, cv2.COLORMAP_TURBO)[..., ::-1].astype(np.uint8)
    drawn[~seen] = 0
    return drawn
