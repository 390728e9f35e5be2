"""pytest plug-in of the virtual machine: keeps the contract's rows that can run nowhere else."""

from __future__ import annotations

from types import ModuleType

import pytest

# The benches that have such rows, and what these are called; the others' imports would take their time.
BENCHES = ("bench_v4l2", "bench_can", "bench_iidc")
ROWS = ("v4l2", "socketcan", "iidc")


def belongs(item: pytest.Item) -> bool:
    """Whether `item` is about a backend of the rig, or is no contract test at all."""
    if "bench" not in getattr(item, "fixturenames", ()):
        return True
    params = item.callspec.params if isinstance(item, pytest.Function) and hasattr(item, "callspec") else {}
    name = getattr(params.get("bench"), "name", "")  # a test that no backend can run has no bench
    return any(word in name for word in ROWS)


def pytest_plugin_registered(plugin: object) -> None:
    if isinstance(plugin, ModuleType) and hasattr(plugin, "BENCHES") and plugin.__name__ != __name__:
        plugin.BENCHES = tuple(name for name in BENCHES if name in plugin.BENCHES)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    elsewhere = [item for item in items if not belongs(item)]
    items[:] = [item for item in items if belongs(item)]
    config.hook.pytest_deselected(items=elsewhere)
