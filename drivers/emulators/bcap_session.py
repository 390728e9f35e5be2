"""One b-CAP session with the emulated controller: which calls there are, their arguments, its handles."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from drivers.bcap.packet import Function, Packet
from drivers.bcap.result import Result, describe, signed, unsigned
from drivers.bcap.variant import Type, Variant, bstr, i4, r8_array
from drivers.emulators.bcap_machine import Call, Machine

_GET_ROBOT_NAMES = 13
_ANGLES = "@CURRENT_ANGLE"
_FIRST_HANDLE = 2
_MAX_OBJECTS = 1000
_LEAST_WDT_MS = 80


class CallError(Exception):
    """A call that is answered with an HRESULT and nothing else."""

    def __init__(self, result: Result) -> None:
        super().__init__(describe(result))
        self.result = result


@dataclass(frozen=True, slots=True)
class _Object:
    kind: Literal["controller", "robot", "variable"]
    parent: int


class Session:
    """What one connection has asked for: its options and handles.

    Attributes:
        started: Between Service_Start and Service_Stop.
        wdt_s: How often S_EXECUTING says that a call goes on; None: never.
        invoke_timeout_s: How long a call may take.
        objects: What its handles stand for.
    """

    def __init__(self, machine: Machine) -> None:
        self.started = False
        self.wdt_s: float | None = None
        self.invoke_timeout_s = 180.0
        self.objects: dict[int, _Object] = {}
        self._machine = machine
        self._next = _FIRST_HANDLE
        self._functions: dict[int, Callable[..., Variant | None]] = {
            Function.SERVICE_START: self._start,
            Function.SERVICE_STOP: self._stop,
            Function.CONTROLLER_CONNECT: self._connect,
            Function.CONTROLLER_DISCONNECT: self._release_controller,
            Function.CONTROLLER_GET_ROBOT: self._get_robot,
            _GET_ROBOT_NAMES: self._robot_names,
            Function.CONTROLLER_EXECUTE: self._execute_controller,
            Function.ROBOT_GET_VARIABLE: self._get_variable,
            Function.ROBOT_EXECUTE: self._execute_robot,
            Function.ROBOT_RELEASE: self._release_robot,
            Function.VARIABLE_GET_VALUE: self._get_value,
            Function.VARIABLE_RELEASE: self._release_variable,
        }

    def reads_joints(self, request: Packet) -> bool:
        """Whether a call is one whose duration and results faults change."""
        return request.code in (Function.ROBOT_EXECUTE, Function.VARIABLE_GET_VALUE)

    def answer(self, request: Packet) -> tuple[int, tuple[Variant, ...]]:
        """Executes a call; returns its HRESULT and its result."""
        texts = [arg.value for arg in request.args if isinstance(arg.value, str)]
        self._machine.calls.append(Call(request.code, texts[0] if texts else ""))
        function = self._functions.get(request.code)
        try:
            if function is None:
                raise CallError(Result.E_NOTIMPL)
            if not self.started and request.code != Function.SERVICE_START:
                raise CallError(Result.E_NOT_CONNECTED)
            if self.reads_joints(request):
                if self._machine.takes_busy():
                    raise CallError(Result.E_ROBOTISBUSY)
                if self._machine.faults.result:
                    return signed(self._machine.faults.result), ()
            value = function(*_bound(function, request.args))
        except CallError as error:
            return signed(error.result), ()
        return Result.S_OK, () if value is None else (value,)

    def _start(self, options: Variant | None = None) -> None:
        wdt_s: float | None = None
        for option in (_text(options) if options is not None else "").split(","):
            key, _, value = option.partition("=")
            if key.strip().upper() in ("WDT", "INVOKETIMEOUT"):
                if not value.strip().isdigit() or int(value) < _LEAST_WDT_MS:
                    raise CallError(Result.E_INVALIDARG)
                if key.strip().upper() == "WDT":
                    wdt_s = int(value) / 1e3
                else:
                    self.invoke_timeout_s = int(value) / 1e3
        self.started, self.wdt_s = True, wdt_s

    def _stop(self) -> None:
        self.started = False
        self.objects.clear()

    def _connect(self, name: Variant, provider: Variant, machine: Variant, option: Variant) -> Variant:
        for text in (name, provider, machine, option):
            _text(text)
        return self._new("controller", 0)

    def _get_robot(self, controller: Variant, name: Variant, option: Variant) -> Variant:
        handle = self._handle(controller, "controller")
        _text(option)
        if _text(name) != "Arm":
            raise CallError(Result.E_INVALIDARG)
        return self._new("robot", handle)

    def _robot_names(self, controller: Variant, option: Variant) -> Variant:
        self._handle(controller, "controller")
        _text(option)
        return Variant(Type.BSTR, ("Arm",))

    def _execute_controller(self, controller: Variant, command: Variant, value: Variant) -> Variant:
        self._handle(controller, "controller")
        if _text(command) != "GetErrorDescription":
            raise CallError(Result.E_INVALIDCOMMAND)
        if not isinstance(value.value, int):
            raise CallError(Result.E_INVALIDARGTYPE)
        return bstr(f"The emulated controller's words for {describe(unsigned(value.value))}")

    def _get_variable(self, robot: Variant, name: Variant, option: Variant) -> Variant:
        handle = self._handle(robot, "robot")
        _text(option)
        if _text(name).upper() != _ANGLES:
            raise CallError(Result.E_INVALIDARG)
        return self._new("variable", handle)

    def _execute_robot(self, robot: Variant, command: Variant, parameter: Variant | None = None) -> Variant:
        self._handle(robot, "robot")
        name, t_ns = _text(command), self._machine.now_ns()
        if name == "CurJnt":
            return r8_array(self._machine.degrees(t_ns))
        if name == "HighCurJntEx" and self._machine.model == "RC8":
            return r8_array((self._machine.stamp_ms(t_ns), *self._machine.degrees(t_ns)))
        raise CallError(Result.E_INVALIDCOMMAND)

    def _get_value(self, variable: Variant) -> Variant:
        self._handle(variable, "variable")
        return r8_array(self._machine.degrees(self._machine.now_ns()))

    def _release_controller(self, handle: Variant) -> None:
        self._release(handle, "controller")

    def _release_robot(self, handle: Variant) -> None:
        self._release(handle, "robot")

    def _release_variable(self, handle: Variant) -> None:
        self._release(handle, "variable")

    def _new(self, kind: Literal["controller", "robot", "variable"], parent: int) -> Variant:
        if len(self.objects) >= _MAX_OBJECTS:
            raise CallError(Result.E_MAX_OBJECT)
        handle, self._next = self._next, self._next + 1
        self.objects[handle] = _Object(kind, parent)
        return i4(handle)

    def _handle(self, value: Variant, kind: str) -> int:
        if value.type not in (Type.I4, Type.UI4) or not isinstance(value.value, int):
            raise CallError(Result.E_INVALIDARGTYPE)
        found = self.objects.get(value.value)
        if found is None or found.kind != kind:
            raise CallError(Result.E_HANDLE)
        return value.value

    def _release(self, value: Variant, kind: str) -> None:
        """Ends an object, and all that was made of it."""
        gone = [self._handle(value, kind)]
        while gone:
            handle = gone.pop()
            del self.objects[handle]
            gone += [child for child, found in self.objects.items() if found.parent == handle]


def _text(value: Variant) -> str:
    if value.type is not Type.BSTR or not isinstance(value.value, str):
        raise CallError(Result.E_INVALIDARGTYPE)
    return value.value


def _bound(function: Callable[..., Variant | None], args: tuple[Variant, ...]) -> tuple[Variant, ...]:
    """Returns the arguments if there are as many as the function has."""
    try:
        return inspect.signature(function).bind(*args).args
    except TypeError:
        raise CallError(Result.E_INVALIDARG) from None
