"""Fixtures that every test can use."""

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--hardware",
        metavar="FILE",
        help="run the contract of drivers on the devices of this configuration, instead of all benches",
    )


# GigE Vision has one port on a computer, so what emulates such a camera takes turns: in one process.
_ONE_CAMERA = {"test_contract.py", "test_aravis_camera.py", "test_gige_camera.py", "test_real_drivers.py"}


@pytest.hookimpl(tryfirst=True)  # before the distribution reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keeps each file's tests in one process (`--dist loadgroup`), and all that need the one camera too."""
    for item in items:
        group = "one camera" if item.path.name in _ONE_CAMERA else item.path.name
        item.add_marker(pytest.mark.xdist_group(group))


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference data beside the project; a test that needs it skips where it is missing."""
    if not SHARED.is_dir():
        pytest.skip(f"reference data is not beside the project ({SHARED.name}/ is missing)")
    return SHARED


@pytest.fixture(scope="session")
def commissioned(tmp_path_factory):
    """The simulated cell through `import`, `train` and `replay`, once for all tests of the command line.

    Trained by naive Bayes, which takes a tenth of the time; the kitchen is trained by default.
    """
    from cli_site import Cell, surfclass, write_cell  # the simulator; most tests do without

    made = Cell(tmp_path_factory.mktemp("cell"))
    write_cell(made.folder)
    surfclass("import", made.folder, made.recording, cwd=made.root)
    surfclass("train", made.recording, "--out", made.model, "--classifier", "naive-bayes", cwd=made.root)
    surfclass("replay", made.recording, "--model", made.model, "--map", made.map, cwd=made.root)
    return made
