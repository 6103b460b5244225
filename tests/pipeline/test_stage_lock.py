"""Two runs on one cache: the second says who is there, and neither takes the other's stages for its own."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import trimesh

from avmsf.capture import read_capture
from avmsf.cli import main
from avmsf.errors import FolderInUseError
from avmsf.pipeline.config import CACHE, PipelineConfig
from avmsf.pipeline.fit import fit_in_stages
from avmsf.pipeline.stages import StageFolder
from factories.plate_capture import fill_plate

Streams = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def _at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for no other writer."""
    monkeypatch.setitem(StageFolder.lock.__kwdefaults__, "wait", 0.0)


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Let another thread make stages in a folder."""
    begun, done = threading.Event(), threading.Event()

    def hold() -> None:
        with StageFolder(folder).lock("avmsf fit mug"):
            begun.set()
            done.wait()

    thread = threading.Thread(target=hold)
    thread.start()
    begun.wait()
    try:
        yield
    finally:
        done.set()
        thread.join()


@pytest.mark.parametrize("stage", ["gaussians", "features"])
def test_a_command_is_refused_while_another_one_makes_stages(stage: str, tmp_path: Path, capsys: Streams) -> None:
    trimesh.creation.icosphere(subdivisions=1, radius=0.05).export(tmp_path / "surface.ply")
    with held(tmp_path / CACHE):
        assert main(["fit", str(tmp_path), "--until", stage]) == 2
    assert "avmsf fit mug" in capsys.readouterr().err
    assert not (tmp_path / CACHE / "views").exists()


def test_a_folder_that_shows_nothing_is_left_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    assert main(["fit", str(tmp_path), "--until", "gaussians"]) == 2
    assert [each.name for each in tmp_path.iterdir()] == ["notes.txt"]


def test_only_the_cache_that_is_written_is_locked(tmp_path: Path) -> None:
    with held(tmp_path / "one" / "cache"), StageFolder(tmp_path / "other" / "cache").lock("me", wait=0.0):
        assert (tmp_path / "other" / "cache").is_dir()


def test_a_fit_is_refused_before_it_reads_what_another_one_writes(tmp_path: Path) -> None:
    capture = read_capture(fill_plate(tmp_path / "plate"))
    with held(tmp_path / "cache"), pytest.raises(FolderInUseError) as refused:
        fit_in_stages(capture, PipelineConfig("smooth", modes=4), StageFolder(tmp_path / "cache"))
    assert refused.value.value["command"] == "avmsf fit mug"
    assert sorted(each.name for each in (tmp_path / "cache").iterdir()) == ["stages.lock"]
