"""Where the tests find measured data, which is not part of the package."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared() -> Path:
    """Return the folder of measured data that AVMSF_SHARED names, or skip."""
    repository = Path(__file__).resolve().parents[1]
    folder = (repository / os.environ.get("AVMSF_SHARED", "../shared")).resolve() / "data"
    if not folder.is_dir():
        pytest.skip(f"no measured data at {folder}: set AVMSF_SHARED to the folder that holds data/")
    return folder
