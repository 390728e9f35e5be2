"""Cameras that misbehave as their options say, for the tests of isolation: they live in child processes."""

import contextlib
import ctypes
import os
import signal
import stat
import sys
import time
from pathlib import Path

import numpy as np

from drivers import errors
from surfclass.errors import ConfigurationError, InputError
from surfclass.frames import ColourFrame, DepthFrame

ERRORS = {
    "ConfigurationError": ConfigurationError,
    "InputError": InputError,
    "ValueError": ValueError,
    "OSError": OSError,
}


class Double:
    """Does what it is told of `deeds`: by the name of the call, one deed or a list of one for each time."""

    def __init__(self, name, clock, options):
        self.name, self.clock, self.options = name, clock, options
        self.frames = 0
        self.called = {}

    def open(self):
        self.does("open")

    def close(self):
        self.does("close")
        if "closed_path" in self.options:
            Path(self.options["closed_path"]).write_text("closed")

    def check(self):
        self.does("check")

    def about(self):
        self.does("about")
        if self.options.get("about") == "endless":
            return {"library": "x" * 100_000}
        return self.options.get("about", {"library": "none", "status": os.environ.get("DOUBLE", "plain")})

    def grab(self, not_before_ns, timeout_s, with_ir=False):
        self.does("grab")
        self.frames += 1
        t_ns = max(not_before_ns, self.clock.now_ns())
        self.clock.sleep((t_ns - self.clock.now_ns()) / 1e9)
        shapes = self.options.get("shapes", [[6, 8]])
        shape = shapes[(self.frames - 1) % len(shapes)]
        image = picture(shape, self.options.get("pixels", "uint16"), self.frames)
        if self.options.get("kind", "depth") == "colour":
            return ColourFrame(t_ns, self.frames, 0.004, image, 17, 6.5)
        ir = picture(shape, self.options.get("ir", "uint16"), self.frames + 1) if with_ir else None
        return DepthFrame(t_ns, self.frames, None, image, ir, 23)

    def does(self, call):
        count = self.called[call] = self.called.get(call, 0) + 1
        deeds = self.options.get("deeds", {}).get(call)
        deed = deeds if isinstance(deeds, str) or deeds is None else (deeds[count - 1 : count] or [None])[0]
        if deed is None:
            return
        what, _, how = deed.partition(" ")
        match what:
            case "hang":
                time.sleep(60)
            case "hang-in-a-library":  # with Python's lock held: no other thread runs, no handler either
                ctypes.PyDLL(None).sleep(60)
            case "wait":
                time.sleep(float(how))
            case "die":
                print("libdouble: something is wrong with the bus", file=sys.stderr)
                os.kill(os.getpid(), getattr(signal, how))
                time.sleep(60)
            case "exit":
                os._exit(int(how))
            case "sys.exit":
                sys.exit(int(how))
            case "raise":
                kind, _, text = how.partition(" ")
                driver_error = getattr(errors, kind, None)
                raise driver_error(self.name, text) if driver_error else ERRORS[kind](text)
            case "print":
                times, _, text = how.partition(" ")
                os.write(1, text.encode() * int(times))
            case "talk-nonsense":
                talk(how.encode())
            case "talk-at-length":
                talk(b"x" * int(how))
            case "start-a-child":
                if not os.fork():
                    time.sleep(60)
            case _:
                raise AssertionError(deed)


class ExposingDouble(Double):
    """One whose exposure can be changed; the options `range_s` and `took` are what it says of it."""

    def exposure_range_s(self):
        return self.options.get("range_s", [0.001, 0.1])

    def set_exposure(self, exposure_s):
        self.does("set_exposure")
        return self.options.get("took", exposure_s)


def talk(packet):
    """Sends a packet on the socket to the parent."""
    for descriptor in range(3, 64):
        with contextlib.suppress(OSError):
            if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                os.write(descriptor, packet)


def picture(shape, pixels, seed):
    """What a double's frame number `seed` shows."""
    top = np.iinfo(pixels).max
    if np.prod(shape) > 10_000_000:
        return np.full(shape, seed, pixels)
    return np.random.default_rng(seed).integers(0, top, shape, pixels, endpoint=True)


def camera(*, name, clock, options, shared):
    """The factory."""
    assert shared == {}
    return Double(name, clock, options)


def exposing(*, name, clock, options, shared):
    """The factory of one whose exposure can be changed."""
    return ExposingDouble(name, clock, options)


def needs_a_library(*, name, clock, options, shared):
    import no_such_library  # noqa: F401
