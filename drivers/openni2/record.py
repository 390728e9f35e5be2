"""Records a device's depth and IR into an `.oni` file, and reads it back to prove what is in it."""

from __future__ import annotations

import time
import zlib
from ctypes import byref, c_void_p
from pathlib import Path

from drivers.openni2.api import PixelFormat, Status
from drivers.openni2.errors import OpenNI2Error
from drivers.openni2.opening import Streams, open_streams
from drivers.openni2.pairs import Pair, Pairing
from drivers.openni2.playback import Playback
from drivers.openni2.runtime import Runtime

_WAIT_S = 0.1
_READ_S = 5.0
_ATTEMPTS = 3
_MARGIN = 2  # exposures that may pass before the recorder's thread begins

# Checksums of depth and of IR.
_Sums = tuple[int, int]


def record(
    runtime: Runtime,
    uri: str,
    serial: str | None,
    depth_format: PixelFormat,
    path: Path,
    exposures: int,
    timeout_s: float,
    pair_tolerance_us: int,
) -> int:
    """Records until `exposures` were seen, and checks the file against them.

    The file counts each stream's time from its first image, so that both must begin with the same
    exposure. The runtime's recorder begins when its thread gets to it, now and then between depth and
    IR; reading the file back shows it, and then the recording is made again.

    Args:
        runtime: With the driver plug-ins of the device, and OniFile.
        uri: As `open_streams`.
        serial: Likewise.
        depth_format: Likewise.
        path: The file; it appears when it is proved.
        exposures: At least so many.
        timeout_s: For each attempt.
        pair_tolerance_us: As `Pairing`.

    Returns:
        How many exposures are in the file.

    Raises:
        OpenNI2Error: If the device or the file cannot be opened, or the images stay away.
        SettingError: As `open_streams`.
        BrokenError: If the file is damaged.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        for _ in range(_ATTEMPTS):
            streams = open_streams(runtime, uri, serial, depth_format, with_ir=True)
            try:
                seen = _record(runtime, streams, part, exposures + _MARGIN, timeout_s, pair_tolerance_us)
            finally:
                streams.device.close()
            written = _read_back(runtime, part, pair_tolerance_us)
            depths = {depth for depth, _ in seen}
            paired = all(sums in seen for sums in written if sums[0] in depths)
            if paired and len(written) >= exposures:
                part.replace(path)
                return len(written)
        raise OpenNI2Error(str(path), Status.ERROR, f"{_ATTEMPTS} recordings were not as seen")
    finally:
        part.unlink(missing_ok=True)


def _record(
    runtime: Runtime, streams: Streams, path: Path, exposures: int, timeout_s: float, tolerance_us: int
) -> set[_Sums]:
    """Returns the sums of the exposures seen meanwhile."""
    recorder = c_void_p()
    runtime.api.must(f"recording {path}", "CreateRecorder", str(path).encode(), byref(recorder))
    try:
        for stream in streams.all:  # before frames come: the runtime's locks can block each other
            runtime.api.must("recording", "RecorderAttachStream", recorder, stream.handle, 0)
        pairing = streams.pairing(tolerance_us)
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        for stream in streams.all:
            stream.start()
        seen = {_sums(_next(streams, pairing, deadline_ns))}
        runtime.api.must("start of the recording", "RecorderStart", recorder)
        for _ in range(exposures):
            seen.add(_sums(_next(streams, pairing, deadline_ns)))
        return seen
    finally:
        # In this order: a frame on its way holds what the recorder waits for when it lets go of a stream.
        runtime.api.call("RecorderStop", recorder)
        for stream in streams.all:
            stream.stop()
        runtime.api.call("RecorderDestroy", byref(recorder))


def _next(streams: Streams, pairing: Pairing, deadline_ns: int) -> Pair:
    while time.monotonic_ns() < deadline_ns:
        stream = streams.device.wait(streams.all, _WAIT_S)
        pair = None if stream is None else pairing.add(stream.sensor, stream.fetch())
        if pair is not None:
            return pair
    raise OpenNI2Error("recording", Status.TIME_OUT, "the images stay away")


def _read_back(runtime: Runtime, path: Path, tolerance_us: int) -> list[_Sums]:
    streams = open_streams(runtime, str(path), None, None, with_ir=True)
    playback = Playback(streams, tolerance_us)
    written = []
    try:
        playback.start()
        while not playback.ended:
            pair = playback.next(_READ_S)
            if pair is None:
                raise OpenNI2Error(str(path), Status.TIME_OUT, "the player gives no image")
            written.append(_sums(pair))
        return written
    finally:
        playback.close()
        streams.device.close()


def _sums(pair: Pair) -> _Sums:
    return zlib.crc32(pair.depth.data), zlib.crc32(b"" if pair.ir is None else pair.ir.data)
