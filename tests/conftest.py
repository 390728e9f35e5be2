"""Fixtures that every test can use."""

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference data beside the project; a test that needs it skips where it is missing."""
    if not SHARED.is_dir():
        pytest.skip(f"reference data is not beside the project ({SHARED.name}/ is missing)")
    return SHARED
