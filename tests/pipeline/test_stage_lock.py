"""Two runs on one cache: the second says who is there, and neither takes the other's stages for its own."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import trimesh

from avmsf.capture import CaptureSettings, read_capture
from avmsf.cli import main
from avmsf.errors import FolderInUseError
from avmsf.pipeline.config import CACHE, PipelineConfig
from avmsf.pipeline.reconstruct import reconstruct
from avmsf.pipeline.scene import ProgressListener
from avmsf.pipeline.stages import StageFolder
from factories.plate_capture import fill_plate

Streams = pytest.CaptureFixture[str]


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Let another thread make stages in a folder."""
    begun, done = threading.Event(), threading.Event()

    def hold() -> None:
        with StageFolder(folder).lock("avmsf reconstruct mug"):
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


@pytest.mark.parametrize("verb", ["splat", "features"])
def test_a_command_is_refused_while_another_one_makes_stages(verb: str, tmp_path: Path, capsys: Streams) -> None:
    trimesh.creation.icosphere(subdivisions=1, radius=0.05).export(tmp_path / "surface.ply")
    with held(tmp_path / CACHE):
        assert main([verb, str(tmp_path)]) == 2
    assert "avmsf reconstruct mug" in capsys.readouterr().err
    assert not (tmp_path / CACHE / "views").exists()


def test_a_folder_that_shows_nothing_is_left_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    assert main(["splat", str(tmp_path)]) == 2
    assert [each.name for each in tmp_path.iterdir()] == ["notes.txt"]


def test_only_the_cache_that_is_written_is_locked(tmp_path: Path) -> None:
    with held(tmp_path / "one" / "cache"), StageFolder(tmp_path / "other" / "cache").lock("me", wait=0.0):
        assert (tmp_path / "other" / "cache").is_dir()


def test_reconstruct_is_refused_before_it_reads_what_another_one_writes(tmp_path: Path) -> None:
    capture = read_capture(fill_plate(tmp_path / "plate"))
    with held(tmp_path / "cache"), pytest.raises(FolderInUseError) as refused:
        reconstruct(
            tmp_path / "plate",
            capture,
            capture.impacts,
            PipelineConfig("smooth", modes=4),
            cache=tmp_path / "cache",
            settings=CaptureSettings(),
            listener=ProgressListener(),
        )
    assert refused.value.holder["command"] == "avmsf reconstruct mug"
    assert sorted(each.name for each in (tmp_path / "cache").iterdir()) == ["stages.lock"]
