"""A camera whose driver lives in a process of its own: a library that crashes or hangs is a lost device."""

from __future__ import annotations

import json
import logging
import math
import re
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Generic, Self, TypeVar, cast

from drivers.errors import DeviceLostError, DeviceTimeoutError
from drivers.isolation.child_process import ChildEndedError, ChildProcess
from drivers.isolation.wire import MESSAGE_LIMIT_BYTES, WireError, raised
from surfclass.errors import ConfigurationError, InputError
from surfclass.frames import ColourFrame, DepthFrame

Frame = TypeVar("Frame", bound=ColourFrame | DepthFrame, covariant=True)

_SLACK_S = 1.0  # what a process may take beyond a call's own time on a computer that is busy
_CHECK_S = 0.3
_ABOUT_S = 2.0
_CLOSE_S = 2.0
_log = logging.getLogger("surfclass.isolation")


class IsolatedCamera(Generic[Frame]):
    """A `ColourCamera` (of ColourFrame) or `DepthCamera` (of DepthFrame) in a child process.

    Each open() starts a fresh process with a socket and a memory of its own, so nothing from before
    can come out. A process that ends, hangs or talks nonsense is a DeviceLostError and is killed; it
    is also one where the driver raises what no driver may, and then the traceback is in the log.

    Args:
        factory: `"module:function"`, called in the child as a backend's factory is:
            `function(name=, clock=SystemClock(), options=, shared={})`.
        name: How messages call the device.
        options: The factory's own, such as TOML can hold; let the caller validate them before, for
            here they are looked at only when the device is opened.
        environment: Variables of the child beyond this process's, for libraries that read them.
        open_timeout_s: For loading the libraries and opening the device.

    Raises:
        ConfigurationError: If the factory is not of that form, or JSON cannot hold the options.
    """

    def __init__(
        self,
        factory: str,
        *,
        name: str,
        options: Mapping[str, Any],
        environment: Mapping[str, str] | None = None,
        open_timeout_s: float = 10.0,
    ) -> None:
        if not re.fullmatch(r"\w+(\.\w+)*:\w+", factory):
            raise ConfigurationError(f"{name}: factory {factory!r}, allowed is module:function")
        if not 0 < open_timeout_s < math.inf:
            raise ConfigurationError(
                f"{name}: open_timeout_s {open_timeout_s}, allowed is above 0 and finite"
            )
        try:
            size = len(json.dumps(dict(options), allow_nan=False))
        except (TypeError, ValueError) as error:
            raise ConfigurationError(f"{name}: options that JSON cannot hold: {error}") from None
        if size > MESSAGE_LIMIT_BYTES // 2:
            raise ConfigurationError(f"{name}: options of {size} bytes, allowed: {MESSAGE_LIMIT_BYTES // 2}")
        self._factory, self._name, self._options = factory, name, dict(options)
        self._environment, self._open_timeout_s = dict(environment or {}), open_timeout_s
        self._child: ChildProcess | None = None
        self._open = False
        self._lost = ""  # how the process that was open ended

    @property
    def name(self) -> str:
        """How messages call it."""
        return self._name

    @property
    def is_open(self) -> bool:
        """Between a successful open() and close(), as of any device: also when its process was lost."""
        return self._open

    @property
    def pid(self) -> int | None:
        """The process id of the child while there is one."""
        child = self._child  # another thread may ask, for a status
        return None if child is None else child.pid

    def open(self) -> None:
        """Starts a process and opens the device in it; ends one that was there before.

        Raises:
            DriverError: As the driver does; DeviceLostError also where the process cannot be started,
                ends, or has not opened the device after `open_timeout_s`.
            ConfigurationError: As the driver does.
        """
        self.close()
        try:
            self._child = ChildProcess(self._name, self._environment)
        except (OSError, RuntimeError) as error:  # no more processes, memory or threads allowed
            raise DeviceLostError(self._name, f"its process cannot be started: {error}") from error
        try:
            self._ask(
                {"call": "open", "factory": self._factory, "options": self._options}, self._open_timeout_s
            )
        except BaseException:
            self._end()
            self._lost = ""
            raise
        self._open = True

    def close(self) -> None:
        """Closes the device and ends its process, within about 2 s whatever state it is in."""
        child, self._open, self._lost = self._child, False, ""
        if child is None:
            return
        until_ns = time.monotonic_ns() + round(_CLOSE_S * 1e9)
        try:
            child.ask({"call": "close"}, until_ns)
            child.wait((until_ns - time.monotonic_ns()) / 1e9)
        except TimeoutError:
            _log.warning("%s: not closed after %g s; its process is killed", self._name, _CLOSE_S)
        except ChildEndedError as error:
            _log.warning("%s: %s in close()%s", self._name, error, child.last_words())
        finally:
            self._end()

    def check(self) -> None:
        """Asks the driver; takes 0.3 s at most.

        Raises:
            DeviceTimeoutError: If the process has not answered in 0.3 s; the computer may be busy.
            DeviceLostError: If it is gone, or has not answered for more than a second.
            DeviceFaultError: As the driver says.
        """
        self._ask({"call": "check"}, _CHECK_S, patience_s=_SLACK_S)

    def about(self) -> Mapping[str, str]:
        """Returns what the driver tells about the device.

        Raises:
            DeviceTimeoutError, DeviceLostError, DeviceFaultError: As the driver does.
        """
        told = self._ask({"call": "about"}, _ABOUT_S).get("about")
        if not isinstance(told, dict) or not all(isinstance(value, str) for value in told.values()):
            raise self._lose("its process said what is no fact about a device")
        return told

    def grab(self, not_before_ns: int, timeout_s: float, with_ir: bool = False) -> Frame:
        """Returns the first frame whose exposure began at or after `not_before_ns`.

        Its images are this process's own: the one copy out of the shared memory.

        Raises:
            InputError: If the timeout is not above 0 and finite.
            DeviceTimeoutError: As the driver does.
            DeviceLostError: As the driver does, and if its process ended or hangs.
            DeviceFaultError: As the driver does, and if a frame has more than
                `frame_memory.FRAME_LIMIT_BYTES`.
        """
        if not 0 < timeout_s < math.inf:
            raise InputError(f"timeout {timeout_s} s, allowed is above 0 and finite")
        ahead_s = max(0.0, (not_before_ns - time.monotonic_ns()) / 1e9)
        question = {
            "call": "grab",
            "not_before_ns": not_before_ns,
            "timeout_s": timeout_s,
            "with_ir": with_ir,
        }
        child = self._living()
        answer = self._ask(question, ahead_s + timeout_s + _SLACK_S)
        try:
            return cast(Frame, child.memory.read(answer))
        except WireError as error:
            raise self._lose(f"its process sent {error}") from None

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _living(self) -> ChildProcess:
        if self._child is None:
            raise DeviceLostError(self._name, self._lost or "it is not open")
        return self._child

    def _ask(self, question: Mapping[str, Any], timeout_s: float, patience_s: float = 0.0) -> dict[str, Any]:
        """Returns the answer, or raises what the driver raised.

        Args:
            question: The message; its "call" is named in errors.
            timeout_s: For the answer.
            patience_s: Where the answer is missing: a process that has answered nothing for so long
                hangs, and is lost; until then the device has only timed out.
        """
        child, call = self._living(), question["call"]
        try:
            answer = child.ask(question, time.monotonic_ns() + round(timeout_s * 1e9))
        except TimeoutError:
            if child.silent_s() < patience_s:
                raise DeviceTimeoutError(
                    self._name, f"its process has not answered {call}() in {timeout_s:g} s"
                ) from None
            raise self._lose(f"its process hung in {call}() and was killed{child.last_words()}") from None
        except ChildEndedError as error:
            raise self._lose(f"{error} in {call}(){child.last_words()}") from None
        if "error" in answer:
            try:
                error_told = raised(answer, self._name)
            except WireError as error:
                raise self._lose(f"its process sent {error}") from None
            raise error_told
        if "defect" in answer:
            _log.error("%s: a defect in its driver:\n%s", self._name, answer.get("traceback"))
            raise self._lose(f"a defect in its driver's {call}(): {answer['defect']} (see the log)")
        return answer

    def _lose(self, how: str) -> DeviceLostError:
        """Ends the process and returns the error; later calls raise the same until it is opened again."""
        self._end()
        self._lost = how
        return DeviceLostError(self._name, how)

    def _end(self) -> None:
        child, self._child = self._child, None
        if child is not None:
            child.close()
