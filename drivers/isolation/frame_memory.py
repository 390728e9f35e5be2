"""The memory in which a device's own process hands frames to the daemon: written once, copied out once."""

from __future__ import annotations

import fcntl
import itertools
import math
import mmap
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.isolation.wire import WireError
from surfclass.errors import InputError
from surfclass.frames import ColourFrame, DepthFrame

FRAME_LIMIT_BYTES = 64 * 2**20  # all images of one frame; a 20-megapixel colour image fits
_ALIGNMENT = 64
_PIXELS = ("uint8", "uint16")


class FrameMemory:
    """Room for the images of one frame, shared by two processes.

    One frame is enough: the daemon asks for a frame, and copies it out before it asks for the next.
    The room is as large as any frame may be, and what no frame has touched yet takes no memory. The
    size is sealed, so that a process gone wild cannot take pages away from under the other's feet.

    Args:
        descriptor: Of the memory; it stays the caller's.
        writable: Whether this process writes frames, or reads them.
    """

    def __init__(self, descriptor: int, *, writable: bool) -> None:
        protection = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
        self._map = mmap.mmap(descriptor, FRAME_LIMIT_BYTES, prot=protection)

    @staticmethod
    def descriptor(name: str) -> int:
        """Returns a new memory; the caller closes it."""
        descriptor = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            os.ftruncate(descriptor, FRAME_LIMIT_BYTES)
            seals = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL
            fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, seals)
        except OSError:
            os.close(descriptor)
            raise
        return descriptor

    def close(self) -> None:
        """Gives the memory back; frames that were read are copies and stay."""
        self._map.close()

    def write(self, frame: ColourFrame | DepthFrame) -> dict[str, Any]:
        """Puts the frame's images into the memory and returns what is to be said about it.

        Raises:
            InputError: If the images together have more than `FRAME_LIMIT_BYTES`.
        """
        about: dict[str, Any] = {
            "t_ns": int(frame.t_ns),
            "t_sd_ns": int(frame.t_sd_ns),
            "sequence": int(frame.sequence),
            "exposure_s": None if frame.exposure_s is None else float(frame.exposure_s),
        }
        images: list[NDArray[Any]]
        if isinstance(frame, ColourFrame):
            images = [frame.rgb]
            about |= {"frame": "colour", "gain_db": None if frame.gain_db is None else float(frame.gain_db)}
        else:
            images = [frame.depth_mm] if frame.ir is None else [frame.depth_mm, frame.ir]
            about |= {"frame": "depth"}
        *places, end = itertools.accumulate((_aligned(image.nbytes) for image in images), initial=0)
        if end > FRAME_LIMIT_BYTES:
            shapes = " and ".join(" × ".join(map(str, image.shape)) for image in images)
            raise InputError(
                f"a frame of {shapes} pixels has {end / 2**20:.1f} MiB, "
                f"allowed are {FRAME_LIMIT_BYTES / 2**20:g} MiB"
            )
        for image, at in zip(images, places, strict=True):
            np.copyto(self._view(image.shape, image.dtype, at), image)
        about["images"] = [
            {"shape": image.shape, "pixels": image.dtype.name, "at": at}
            for image, at in zip(images, places, strict=True)
        ]
        return about

    def read(self, about: Mapping[str, Any]) -> ColourFrame | DepthFrame:
        """Returns the frame that `write` in the other process said `about`, in memory of its own.

        Raises:
            WireError: If what is said about it is no frame within the memory.
        """
        try:
            t_ns, t_sd_ns, sequence = (_integer(about[key]) for key in ("t_ns", "t_sd_ns", "sequence"))
            exposure_s = _number(about["exposure_s"])
            images = [self._image(place) for place in about["images"]]
            match about["frame"], images:
                case "colour", [rgb]:
                    return ColourFrame(t_ns, sequence, exposure_s, rgb, t_sd_ns, _number(about["gain_db"]))
                case "depth", [depth_mm, *ir] if len(ir) <= 1:
                    return DepthFrame(t_ns, sequence, exposure_s, depth_mm, ir[0] if ir else None, t_sd_ns)
        except (KeyError, TypeError, InputError) as error:
            raise WireError(f"no frame: {error!r:.200}") from None
        raise WireError(f"no frame: {len(images)} images of a {about['frame']!r:.40} frame")

    def _image(self, place: Mapping[str, Any]) -> NDArray[Any]:
        pixels, shape, at = place["pixels"], [_integer(n) for n in place["shape"]], _integer(place["at"])
        if pixels not in _PIXELS or min(shape, default=-1) < 0 or at < 0 or at % _ALIGNMENT:
            raise WireError(f"no image: {place!r:.200}")
        dtype = np.dtype(pixels)
        if at + math.prod(shape) * dtype.itemsize > FRAME_LIMIT_BYTES:
            raise WireError(f"an image that ends outside the memory: {place!r:.200}")
        return self._view(shape, dtype, at).copy()

    def _view(self, shape: Sequence[int], dtype: np.dtype[Any], at: int) -> NDArray[Any]:
        count = math.prod(shape)
        return np.frombuffer(self._map, dtype, count, at).reshape(shape) if count else np.empty(shape, dtype)


def _aligned(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT


def _integer(value: object) -> int:
    if type(value) is not int:
        raise WireError(f"{value!r:.40} where an integer belongs")
    return value


def _number(value: object) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise WireError(f"{value!r:.40} where a number belongs")
    return float(value)
