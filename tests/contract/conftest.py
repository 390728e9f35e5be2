"""Runs each contract test on every backend that has the device it is about."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from pathlib import Path

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


def backends() -> list[Backend]:
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
        for backend in backends()
        for kind in marker.args
        if kind in backend.troubles and troubles <= backend.troubles[kind]
    ]
    if "kind" in metafunc.fixturenames:
        params = [backend.param(kind) for backend, kind in rows]
        metafunc.parametrize(("bench", "kind"), params, indirect=["bench"])
    else:
        metafunc.parametrize("bench", [backend.param() for backend, _ in rows], indirect=True)


@pytest.fixture
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    with request.param.make(tmp_path) as made:
        yield made
