"""Runs each contract test on every backend that has the device it is about."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import pytest
from bench import Backend, Bench

# Each names a module beside this file with a list BACKENDS.
BENCHES = (
    "bench_sim",
    "bench_isolated",
    "bench_openni2",
    "bench_aravis",
    "bench_v4l2",
    "bench_iidc",
    "bench_gardasoft",
    "bench_bcap",
    "bench_can",
)


def backends(hardware: str | None) -> list[Backend]:
    if hardware is not None:
        return importlib.import_module("bench_hardware").backends(Path(hardware).absolute())
    return [backend for name in BENCHES for backend in importlib.import_module(name).BACKENDS]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Parametrizes `bench` over the backends, for the kinds that `@pytest.mark.kinds` names.

    A test marked `@pytest.mark.trouble(name)` runs only where the bench can make that trouble.
    """
    if "bench" not in metafunc.fixturenames:
        return
    marker = metafunc.definition.get_closest_marker("kinds")
    assert marker is not None, f"{metafunc.definition.nodeid}: which kinds of device is it about?"
    troubles = {mark.args[0] for mark in metafunc.definition.iter_markers("trouble")}
    rows = [
        (backend, kind)
        for backend in backends(metafunc.config.getoption("--hardware"))
        for kind in marker.args
        if kind in backend.troubles and troubles <= backend.troubles[kind]
    ]
    if not rows:
        rows = [(Backend("no backend", _nowhere, missing="none here can fail in this way"), "")]
    if "kind" in metafunc.fixturenames:
        params = [backend.param(kind) for backend, kind in rows]
        metafunc.parametrize(("bench", "kind"), params, indirect=["bench"])
    else:
        metafunc.parametrize("bench", [backend.param() for backend, _ in rows], indirect=True)


def _nowhere(_: Path) -> NoReturn:
    raise AssertionError("the test is skipped")


@pytest.fixture
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    with request.param.make(tmp_path) as made:
        yield made
