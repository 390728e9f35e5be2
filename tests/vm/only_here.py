"""pytest plug-in of the virtual machine: keeps the contract's rows that can run nowhere else."""

from __future__ import annotations

import pytest

RIG = ("v4l2", "socketcan", "iidc")


def belongs(item: pytest.Item) -> bool:
    """Whether `item` is about a backend of the rig, or is no contract test at all."""
    if "bench" not in getattr(item, "fixturenames", ()):
        return True
    params = item.callspec.params if isinstance(item, pytest.Function) else {}
    name = getattr(params.get("bench"), "name", "")  # a test that no backend can run has no bench
    return any(word in name for word in RIG)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    elsewhere = [item for item in items if not belongs(item)]
    items[:] = [item for item in items if belongs(item)]
    config.hook.pytest_deselected(items=elsewhere)
