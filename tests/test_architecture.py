"""The house stays as it is drawn: layers, names, late imports, and what the README promises."""

import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("surfclass", "drivers", "calibration", "daemon")


def modules():
    return [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]


def test_imports_point_one_way():
    result = subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert result.returncode == 0, result.stdout


def test_no_other_distribution_owns_our_names():
    owners = importlib.metadata.packages_distributions()
    for package in PACKAGES:
        assert set(owners[package]) == {"surfclass"}


@pytest.mark.parametrize(
    ("module", "banned"),
    [
        ("surfclass.pipeline", {"sklearn", "open3d", "matplotlib", "pinocchio", "zenoh", "scipy", "mcap"}),
        ("daemon.cli", {"numpy", "cv2", "sklearn", "open3d", "matplotlib", "pinocchio", "zenoh", "pydantic"}),
    ],
)
def test_heavy_libraries_are_imported_late(module, banned):
    """What --help and a console that only wants the values do not have to wait for."""
    code = f"import sys, {module}; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    ).stdout.split()
    assert banned.isdisjoint(name.partition(".")[0] for name in loaded)


def test_every_module_says_what_it_is_for():
    for path in modules():
        if not path.name.endswith("_pb2.py"):
            assert path.read_text().startswith('"""'), path


def test_modules_can_be_held_in_the_head():
    lengths = {path: len(path.read_text().splitlines()) for path in modules() if "_pb2" not in path.name}
    assert max(lengths.values()) <= 400, max(lengths, key=lengths.get)
    assert sorted(lengths.values())[len(lengths) // 2] <= 170


def test_no_module_has_a_name_that_says_nothing():
    empty = {"utils", "util", "common", "helpers", "manager", "core", "misc"}
    assert not {path.stem for path in modules()} & empty


def test_the_readme_names_files_that_exist():
    readme = (ROOT / "README.md").read_text()
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", readme)
    assert len(links) > 8
    for link in links:
        assert (ROOT / link).exists(), link


def headings(page):
    """The anchors of a page, as GitHub makes them of its headings."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_links_between_pages_resolve():
    links = 0
    for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
            if re.match(r"[a-z]+:", link):
                continue
            links += 1
            file, _, anchor = link.partition("#")
            target = page.parent / file if file else page
            assert target.exists(), f"{page.relative_to(ROOT)}: {link}"
            assert not anchor or anchor in headings(target), f"{page.relative_to(ROOT)}: {link}"
    assert links > 40


def test_the_index_of_the_pages_is_complete():
    index = (ROOT / "docs/README.md").read_text()
    assert [page.name for page in (ROOT / "docs").glob("[!R]*.md") if f"]({page.name})" not in index] == []


def test_the_tests_that_the_method_names_are_there():
    named = re.findall(r"`(test_\w+\.py)::(test_\w+)`", (ROOT / "docs/method.md").read_text())
    assert len(named) > 60
    for file, test in named:
        assert f"\ndef {test}(" in (ROOT / "tests" / file).read_text(), f"{file}::{test}"


def test_the_tour_keeps_its_order():
    readme = (ROOT / "README.md").read_text()
    tour = re.findall(r"^\d\. \[`([^`]+)`\]", readme, re.MULTILINE)
    assert tour == [
        "surfclass/types.py",
        "drivers/interfaces.py",
        "drivers/sensor_package.py",
        "surfclass/pipeline.py",
        "daemon/service.py",
    ]


def test_the_decisions_are_all_listed():
    pages = {path.name for path in (ROOT / "docs/decisions").glob("0*.md")}
    listed = set(re.findall(r"\((0[^)]+)\)", (ROOT / "docs/decisions/README.md").read_text()))
    assert pages == listed


# Vendor libraries and their one door; emulators may know the library whose other end they are.
DOORS = {
    "gi": {"drivers/aravis/library.py"},
    "can": {"drivers/canbus/bus.py"},
    "cantools": {"drivers/canbus/layout.py"},
    "canopen": {"drivers/canbus/objects.py", "drivers/emulators/can_nodes.py"},
    "serial": {"drivers/serial_port.py"},
    "linuxpy": {"drivers/v4l2/node.py"},
}


@pytest.mark.parametrize("library", DOORS)
def test_a_vendor_library_has_one_door(library):
    wanted = re.compile(rf"^\s*(?:import|from) {library}\b|import_module\(\"{library}[\".]", re.MULTILINE)
    found = {str(path.relative_to(ROOT)) for path in modules() if wanted.search(path.read_text())}
    assert found <= DOORS[library]
    assert found, "the door has moved"
