"""Where the tests find measured data, which is not part of the package."""

import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Keep the garbage collector from looking through all that imports bring, now and after each test."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()


@pytest.fixture(scope="session")
def shared() -> Path:
    """Return the folder of measured data that AVMSF_SHARED names, or skip."""
    repository = Path(__file__).resolve().parents[1]
    folder = (repository / os.environ.get("AVMSF_SHARED", "../shared")).resolve() / "data"
    if not folder.is_dir():
        pytest.skip(f"no measured data at {folder}: set AVMSF_SHARED to the folder that holds data/")
    return folder


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Keep tetrahedra of earlier runs from the tests."""
    os.environ["AVMSF_CACHE"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(autouse=True)
def _seed_of_torch() -> None:
    """Give each test the same random numbers, whichever tests ran before it in its process."""
    if (torch := sys.modules.get("torch")) is not None:
        torch.manual_seed(0)
