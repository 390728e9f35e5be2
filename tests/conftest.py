"""Fixtures that every test can use."""

from pathlib import Path
from typing import Any

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


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Keeps each file's tests in one process, and all that need the one camera in one, too."""
    from xdist.scheduler import LoadFileScheduling

    class OneCamera(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            return "one camera" if Path(file).name in _ONE_CAMERA else file

    return OneCamera(config, log)


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
