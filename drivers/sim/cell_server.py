"""One simulated world for emulators in processes of their own: a server on a local socket, and its client.

A message is a JSON header of at most 64 KiB, then the arrays that it announces, as they lie in memory.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Client, Connection, Listener
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from drivers.sim.cell import WorldCell
from surfclass.errors import InputError
from surfclass.types import Float64

_log = logging.getLogger("surfclass.sim.cell")

_HEADER_BYTES = 65536
_ARRAY_BYTES = 64 * 2**20
_ANSWER_S = 60.0  # a frame of a scene whose textures are not made yet takes many seconds
_CALLS = ("joints", "set_light", "light_level", "raw", "rgb", "depth", "go_on")


class CellServer:
    """Serves one cell to any number of emulators; a client that vanishes leaves the light off.

    Args:
        cell: What is served; replaced by `show`.
        path: Of the local socket; must not exist, or be left over from a server that is gone.
        make: Returns the cell of a scene and a seed, for clients that want another scene put up.
    """

    def __init__(
        self, cell: WorldCell, path: Path, make: Callable[[str, int], WorldCell] | None = None
    ) -> None:
        self.cell = cell
        self._path, self._make = path, make
        self._listener: Listener | None = None
        self._stopping = threading.Event()

    def start(self) -> None:
        """Begins to listen.

        Raises:
            InputError: If the socket cannot be made.
        """
        self._path.unlink(missing_ok=True)
        try:
            self._listener = Listener(str(self._path), "AF_UNIX", backlog=16)
        except OSError as error:
            raise InputError(f"{self._path}: no socket can be made there ({error.strerror})") from None
        threading.Thread(target=self._accept, name="cell", daemon=True).start()

    def stop(self) -> None:
        """Ends; clients see it as the end of their connection."""
        self._stopping.set()
        if self._listener is not None:
            self._listener.close()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _accept(self) -> None:
        assert self._listener is not None
        while not self._stopping.is_set():
            try:
                connection = self._listener.accept()
            except OSError:
                return  # closed
            threading.Thread(target=self._serve, args=(connection,), name="cell client", daemon=True).start()

    def _serve(self, connection: Connection) -> None:
        lights = False
        with connection:
            while True:
                try:
                    request = json.loads(connection.recv_bytes(_HEADER_BYTES))
                    call, args = str(request["call"]), list(request["args"])
                except (EOFError, OSError):
                    break
                except (ValueError, LookupError, TypeError) as error:
                    _log.warning("a client that does not speak our language is hung up on: %s", error)
                    break
                lights = lights or call == "set_light"
                try:
                    self._answer(connection, call, args)
                except OSError:
                    break
        if lights and self.cell.light_is_on:
            _log.warning("the light's controller vanished: the light is off")
            self.cell.set_light(0.0, time.monotonic_ns())

    def _answer(self, connection: Connection, call: str, args: list[Any]) -> None:
        try:
            value = self._call(call, args)
        except Exception as error:  # noqa: BLE001 - told to the client, which raises it
            connection.send_bytes(json.dumps({"error": f"{type(error).__name__}: {error}"}).encode())
            return
        values = value if isinstance(value, tuple) else (value,)
        arrays = [item for item in values if isinstance(item, np.ndarray)]
        header = {
            "value": None if arrays else value,
            "arrays": [{"shape": array.shape, "dtype": array.dtype.str} for array in arrays],
        }
        connection.send_bytes(json.dumps(header).encode())
        for array in arrays:
            connection.send_bytes(np.ascontiguousarray(array).data.cast("B"))

    def _call(self, name: str, args: list[Any]) -> Any:
        if name == "sizes":
            return [self.cell.colour_size, self.cell.depth_size]
        if name == "program_done":
            return self.cell.world.program_done
        if name == "show" and self._make is not None:
            self.cell = self._make(*args)
            return None
        if name in _CALLS:
            return getattr(self.cell, name)(*args)
        raise InputError(f"the cell has no {name!r}, allowed: {', '.join(_CALLS)}")


class CellClient:
    """A `Cell` that lives in another process; used from several threads, one call at a time.

    Args:
        path: The server's socket.

    Raises:
        InputError: If no server answers there.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        try:
            self._connection = Client(str(path), "AF_UNIX")
        except OSError as error:
            raise InputError(f"{path}: no simulated cell answers there ({error.strerror})") from None
        self._colour_size, self._depth_size = (tuple(size) for size in self._ask("sizes")[0])

    def close(self) -> None:
        """Hangs up."""
        with suppress(OSError):
            self._connection.close()

    @property
    def colour_size(self) -> tuple[int, int]:
        """As `Cell.colour_size`."""
        width, height = self._colour_size
        return width, height

    @property
    def depth_size(self) -> tuple[int, int]:
        """As `Cell.depth_size`."""
        width, height = self._depth_size
        return width, height

    def joints(self, t_ns: int) -> Float64:
        """As `Cell.joints`."""
        return self._arrays("joints", t_ns)[0]

    def set_light(self, level: float, holds_from_ns: int) -> None:
        """As `Cell.set_light`."""
        self._ask("set_light", level, holds_from_ns)

    def light_level(self, begin_ns: int, end_ns: int) -> float:
        """As `Cell.light_level`."""
        return float(self._ask("light_level", begin_ns, end_ns)[0])

    def raw(self, begin_ns: int, end_ns: int, gain_db: float, key: int) -> NDArray[np.uint16]:
        """As `Cell.raw`."""
        return self._arrays("raw", begin_ns, end_ns, gain_db, key)[0]

    def rgb(self, begin_ns: int, end_ns: int, gain_db: float, key: int) -> NDArray[np.uint8]:
        """As `Cell.rgb`."""
        return self._arrays("rgb", begin_ns, end_ns, gain_db, key)[0]

    def depth(self, t_ns: int, key: int) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """As `Cell.depth`."""
        depth_mm, ir = self._arrays("depth", t_ns, key)
        return depth_mm, ir

    def show(self, scene: str, seed: int) -> None:
        """Puts another scene in front of the arm."""
        self._ask("show", scene, seed)

    def go_on(self, captured: int) -> None:
        """As `WorldCell.go_on`."""
        self._ask("go_on", captured)

    @property
    def program_done(self) -> bool:
        """Whether the arm has visited every viewpoint of its programme."""
        return bool(self._ask("program_done")[0])

    def _arrays(self, call: str, *args: float) -> list[NDArray[Any]]:
        return self._ask(call, *args)[1]

    def _ask(self, call: str, *args: float | str) -> tuple[Any, list[NDArray[Any]]]:
        """Returns the value and the arrays of the answer.

        Raises:
            InputError: If the server is gone, silent, or refuses.
        """
        with self._lock:
            try:
                self._connection.send_bytes(json.dumps({"call": call, "args": args}).encode())
                header = json.loads(self._receive(_HEADER_BYTES))
                arrays = [
                    np.frombuffer(self._receive(_ARRAY_BYTES), np.dtype(told["dtype"])).reshape(told["shape"])
                    for told in header.get("arrays", [])
                ]
            except (EOFError, OSError) as error:
                raise InputError(f"{self._path}: the simulated cell is gone ({error})") from None
        if "error" in header:
            raise InputError(f"{self._path}: {call}: {header['error']}")
        return header["value"], arrays

    def _receive(self, limit: int) -> bytes:
        if not self._connection.poll(_ANSWER_S):
            raise TimeoutError(f"no answer within {_ANSWER_S:g} s")
        return self._connection.recv_bytes(limit)
