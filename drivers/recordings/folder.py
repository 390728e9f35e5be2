"""Reads a data folder: rig, classes, captures.csv and images; every fault names its file."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.recordings.board import Board, parse_board
from drivers.recordings.captures_csv import Row, read_captures_csv
from drivers.recordings.images import check_pixels, decode_image
from drivers.recordings.plate import Plate, parse_plate
from surfclass.errors import ConfigurationError, InputError
from surfclass.frames import Capture, ColourFrame, DepthFrame, JointState
from surfclass.rig import DepthRig, Rig, SurfaceClasses, parse_classes, parse_depth_rig

# Channels and bits that each kind of image may have.
_PIXELS = {
    "depth": (1, (16,)),
    "ir": (1, (8, 16)),
    "colour": (3, (8, 16)),
    "dark": (3, (8, 16)),
    "label": (1, (8,)),
}
_NEED_LABEL = ("train", "test")
_NEED_CLASSES = {"train", "test", "map"}  # sets for calibration alone have no use for a list of classes


@dataclass(frozen=True, slots=True, eq=False)
class FolderSet:
    """A data folder whose texts are checked and whose image files exist; they are read one capture at a time.

    Attributes:
        path: The folder.
        rig_text: `rig.toml` as it stands.
        depth_rig: What it says; a `Rig` unless it leaves out the colour camera or where that is.
        classes_text: `classes.toml` as it stands, or None.
        classes: What it says, or None.
        plate_text: `plate.toml` as it stands, or None.
        plate: What it says, or None.
        board_text: `board.toml` as it stands, or None.
        board: What it says, or None.
        rows: `captures.csv`.
        files: For each row its image files, by kind: "depth", "colour", "dark", "ir", "label".
    """

    path: Path
    rig_text: str
    depth_rig: DepthRig
    classes_text: str | None
    classes: SurfaceClasses | None
    plate_text: str | None
    plate: Plate | None
    board_text: str | None
    board: Board | None
    rows: tuple[Row, ...]
    files: tuple[dict[str, Path], ...]

    @property
    def rig(self) -> Rig:
        """The whole sensor package.

        Raises:
            MissingCalibrationError: Where it leaves out the colour camera or where that is.
        """
        return self.depth_rig.whole()

    def __len__(self) -> int:
        return len(self.rows)

    def only(self, roles: Collection[str]) -> FolderSet:
        """Returns the captures of these roles; no other's images are read."""
        kept = [i for i, row in enumerate(self.rows) if row.role in roles]
        rows, files = tuple(self.rows[i] for i in kept), tuple(self.files[i] for i in kept)
        return replace(self, rows=rows, files=files)

    def captures(self) -> Iterator[tuple[Capture, dict[str, bytes]]]:
        """Yields each capture with the bytes of its image files by kind, in the order of the rows.

        Raises:
            InputError: Naming the file and what is allowed, for a damaged image, a wrong pixel type
                or size, and a label above the number of classes.
        """
        depth, rgb = self.depth_rig.depth, self.depth_rig.rgb
        in_depth = depth.shape, "rig.toml says"
        in_colour = None if rgb is None else (rgb.shape, "rig.toml says")
        for sequence, (row, files) in enumerate(zip(self.rows, self.files, strict=True)):
            encoded = {kind: _read_bytes(path) for kind, path in files.items()}
            images = {kind: self._image(kind, path, encoded[kind]) for kind, path in files.items()}
            for kind, image in images.items():
                if kind not in ("depth", "ir") and in_colour is None:  # still one camera, whichever it is
                    in_colour = image.shape[:2], f"rig.toml has no [rgb], and {files[kind]} is"
                _check_size(image, in_depth if kind in ("depth", "ir") else in_colour, files[kind])
            yield _capture(sequence, row, images), encoded

    def _image(self, kind: str, path: Path, data: bytes) -> NDArray[Any]:
        image = decode_image(data, str(path))
        check_pixels(image, *_PIXELS[kind], str(path))
        if kind == "label" and self.classes is not None:
            _check_label(image, len(self.classes.names), path)
        return image


def read_folder(directory: str | Path) -> FolderSet:
    """Checks a data folder's texts and that every image file is there, and returns it.

    Raises:
        ConfigurationError: For `rig.toml`, `classes.toml` and `plate.toml`, naming every fault.
        InputError: For `captures.csv`, naming line and column, and for a missing file.
    """
    folder = Path(directory)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    rows = read_captures_csv(folder / "captures.csv")
    files = tuple(_find_files(folder, row) for row in rows)
    roles = {row.role for row in rows}
    rig_path = folder / "rig.toml"
    rig_text = _read_text(rig_path, "every data folder has one")
    needs_classes = "label" in {kind for found in files for kind in found} or roles & _NEED_CLASSES
    classes_text = plate_text = board_text = None
    if needs_classes or (folder / "classes.toml").exists():
        classes_text = _read_text(folder / "classes.toml", "train, test, map and labelled captures need it")
    if "hand_eye" in roles or (folder / "plate.toml").exists():
        plate_text = _read_text(folder / "plate.toml", "hand_eye captures need it")
    if (folder / "board.toml").exists():
        board_text = _read_text(folder / "board.toml", "board captures look at it")
    return FolderSet(
        path=folder,
        rig_text=rig_text,
        depth_rig=parse_depth_rig(rig_text, str(rig_path)),
        classes_text=classes_text,
        classes=None if classes_text is None else parse_classes(classes_text, str(folder / "classes.toml")),
        plate_text=plate_text,
        plate=None if plate_text is None else parse_plate(plate_text, str(folder / "plate.toml")),
        board_text=board_text,
        board=None if board_text is None else parse_board(board_text, str(folder / "board.toml")),
        rows=rows,
        files=files,
    )


def _find_files(folder: Path, row: Row) -> dict[str, Path]:
    files = {}
    for kind in _PIXELS:
        suffixes = (".png", ".jpg") if kind in ("colour", "dark") else (".png",)
        found = [path for suffix in suffixes if (path := folder / kind / (row.name + suffix)).is_file()]
        if len(found) > 1:
            raise InputError(f"{row.where}: both {found[0]} and {found[1]} are there; allowed is one")
        needed = (
            kind == "depth"
            or (kind == "colour" and row.role != "hand_eye")
            or (kind == "label" and row.role in _NEED_LABEL)
        )
        if needed and not found:
            raise InputError(
                f"{folder / kind / row.name}{'|'.join(suffixes)}: missing; {row.where} lists the {row.role} "
                f"capture {row.name}, which needs it"
            )
        if found:
            files[kind] = found[0]
    return files


def _capture(sequence: int, row: Row, images: dict[str, NDArray[Any]]) -> Capture:
    frames = {
        kind: ColourFrame(row.t_ns, sequence, row.exposure_s, images[kind])
        for kind in ("colour", "dark")
        if kind in images
    }
    return Capture(
        name=row.name,
        role=row.role,
        depth=DepthFrame(row.t_ns, sequence, None, images["depth"], images.get("ir")),
        colour=frames.get("colour"),
        dark=frames.get("dark"),
        joints=None if row.q is None else JointState(row.t_ns, 0, row.q),
        base_T_depth=row.base_T_depth,
        label=images.get("label"),
    )


def _check_size(image: NDArray[Any], stated: tuple[tuple[int, ...], str] | None, path: Path) -> None:
    if stated is not None and image.shape[:2] != stated[0]:
        (height, width), says = stated
        raise InputError(f"{path}: {image.shape[1]} × {image.shape[0]} pixels, {says} {width} × {height}")


def _check_label(label: NDArray[Any], count: int, path: Path) -> None:
    highest = int(label.max())
    if highest > count:
        row, column = np.argwhere(label == highest)[0]
        raise InputError(
            f"{path}: label {highest} at row {row}, column {column}; classes.toml has {count} classes, "
            f"allowed are 0 to {count}"
        )


def _read_text(path: Path, reason: str) -> str:
    if not path.exists():
        raise ConfigurationError(f"{path}: missing; {reason}")
    try:
        return _read_bytes(path).decode()
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path}: not UTF-8 text: {error}") from None


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
