"""Copies Python distributions of this environment, with all that they need, into another site-packages.

python packages.py list               prints names and versions: what an image is made of
python packages.py copy DIRECTORY
"""

from __future__ import annotations

import importlib.metadata
import shutil
import sys
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

# What the tests in the virtual machine import, but for the project itself.
ROOTS = (
    "canopen",
    "cantools",
    "hypothesis",
    "linuxpy",
    "numpy",
    "opencv-python-headless",
    "pydantic",
    "pyserial",
    "pytest",
    "pytest-timeout",
    "python-can",
)


def closure(names: tuple[str, ...]) -> dict[str, importlib.metadata.Distribution]:
    """Returns the distributions `names` and what they need here, by their canonical names."""
    found: dict[str, importlib.metadata.Distribution] = {}
    waiting = list(names)
    while waiting:
        name = canonicalize_name(waiting.pop())
        if name in found:
            continue
        found[name] = importlib.metadata.distribution(name)
        for line in found[name].requires or ():
            requirement = Requirement(line)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                waiting.append(requirement.name)
    return dict(sorted(found.items()))


def copy(distribution: importlib.metadata.Distribution, target: Path) -> None:
    """Copies its files with their times, so that compiled modules stay valid; scripts are left out."""
    for file in distribution.files or ():
        source = Path(str(file.locate()))
        if ".." in file.parts or not source.is_file():
            continue
        place = target / file
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(source, place)


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["list"]:
            print(*(f"{name} {each.version}" for name, each in closure(ROOTS).items()), sep="\n")
        case ["copy", target]:
            for each in closure(ROOTS).values():
                copy(each, Path(target))
        case _:
            sys.exit(__doc__)
