"""Image pairs of any two cameras: a folder of left01.jpg, right01.jpg, … without a rig."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.recordings.images import decode_image
from surfclass.errors import InputError

_NAME = re.compile(r"(?i)(left|right|rgb|ir)[_-]?(\w+)\.(?:jpe?g|png)")
_PARTNERS = {"left": ("left", "right"), "right": ("left", "right"), "ir": ("ir", "rgb"), "rgb": ("ir", "rgb")}


@dataclass(frozen=True, slots=True)
class ImagePairs:
    """A folder of image pairs; a view may lack one of its two images.

    Attributes:
        path: The folder.
        cameras: Names of the two cameras; the first one is the reference.
        files: By the view's name, the file of each camera that has one.
    """

    path: Path
    cameras: tuple[str, str]
    files: dict[str, dict[str, Path]]

    @classmethod
    def open(cls, path: Path) -> ImagePairs:
        """Returns the pairs in a folder.

        Raises:
            InputError: If there are none, or they are of more than two cameras.
        """
        found: dict[str, dict[str, Path]] = {}
        for file in sorted(path.iterdir()) if path.is_dir() else []:
            match = _NAME.fullmatch(file.name)
            if match and file.is_file():
                found.setdefault(match[2], {})[match[1].lower()] = file
        kinds = {camera for files in found.values() for camera in files}
        partners = {_PARTNERS[camera] for camera in kinds}
        if len(partners) != 1:
            seen = ", ".join(sorted(kinds)) or "none"
            raise InputError(
                f"{path}: image pairs are named left01.jpg and right01.jpg, or ir01.png and rgb01.png "
                f"(any number, .png or .jpg); found: {seen}"
            )
        return cls(path, partners.pop(), found)

    def images(self) -> Iterator[tuple[str, dict[str, NDArray[Any]]]]:
        """Yields each view's name and its images by camera: (h, w) or (h, w, 3) RGB.

        Raises:
            InputError: For a damaged image, or one of another size than the camera's first.
        """
        sizes: dict[str, tuple[tuple[int, ...], Path]] = {}
        for name, files in self.files.items():
            images = {}
            for camera, file in files.items():
                image = decode_image(file.read_bytes(), str(file))
                shape, first = sizes.setdefault(camera, (image.shape[:2], file))
                if image.shape[:2] != shape:
                    raise InputError(
                        f"{file}: {image.shape[1]} × {image.shape[0]} pixels, "
                        f"{first.name} has {shape[1]} × {shape[0]}"
                    )
                images[camera] = np.asarray(image)
            yield name, images

    def digests(self) -> dict[str, str]:
        """Returns the sha256 of every file, by name."""
        every = [file for files in self.files.values() for file in files.values()]
        return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted(every)}


def holds_pairs(path: Path) -> bool:
    """Whether this is a folder of image pairs rather than a data folder."""
    return (
        path.is_dir()
        and not (path / "rig.toml").exists()
        and any(_NAME.fullmatch(file.name) for file in path.iterdir())
    )
