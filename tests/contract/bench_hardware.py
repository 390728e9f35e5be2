"""The real devices of a configuration, for `--hardware FILE`: nobody here can make them fail."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from bench import Backend, Bench

from daemon import wiring
from daemon.config import load_config


@contextmanager
def real(_: Path, file: Path) -> Iterator[Bench]:
    sensors = wiring.build_sensors(load_config(file))
    devices = sensors.devices

    def brightness(not_before_ns: int) -> float:
        with devices["colour"] as camera:
            return float(camera.grab(not_before_ns, 5.0).rgb.mean())

    yield Bench(
        sensors.clock,
        devices["colour"],
        devices["depth"],
        devices.get("light"),
        devices.get("arm"),
        brightness=brightness,
        slack_s=1.0,
    )
    sensors.package.close()


def backends(file: Path) -> list[Backend]:
    kinds = load_config(file).devices
    return [Backend(f"hardware of {file.name}", partial(real, file=file), dict.fromkeys(kinds, frozenset()))]
