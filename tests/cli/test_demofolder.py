"""A demo's folder is replaced as a whole or stays as it was, and nobody else's files are touched."""

import json
import threading
from pathlib import Path

import pytest

from avmsf.cli.demo_folder import RECORD, record, replaced_whole
from avmsf.cli.options.checks import OutputError
from avmsf.errors import FolderInUseError
from factories.raising import raises


def fill(folder: Path, names: dict[str, str]) -> None:
    for name, text in names.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)


def finish(folder: Path, names: dict[str, str]) -> None:
    fill(folder, names)
    (folder / RECORD).write_text(json.dumps(record(folder) | {"made of": names}))


def content(folder: Path) -> dict[str, str]:
    return {each.relative_to(folder).as_posix(): each.read_text() for each in folder.rglob("*") if each.is_file()}


OLD, NEW = {"a.txt": "old", "sounds/b.txt": "old", "c.txt": "old"}, {"a.txt": "new", "sounds/d.txt": "new"}


@pytest.fixture
def demo(tmp_path: Path) -> Path:
    """Return a folder with an earlier demo."""
    folder = tmp_path / "demo"
    with replaced_whole(folder) as begun:
        finish(begun, OLD)
    return folder


def test_a_demo_takes_the_place_of_an_earlier_one(demo: Path) -> None:
    with replaced_whole(demo) as begun:
        before = content(demo)
        finish(begun, NEW)
        assert before.items() <= content(demo).items()
        # Nothing is written beside the folder.
        assert list(demo.parent.iterdir()) == [demo]
    assert {name for name in content(demo) if name != RECORD} == set(NEW)
    assert content(demo)["a.txt"] == "new"
    assert set(json.loads((demo / RECORD).read_text())["files"]) == {*NEW, RECORD}


@pytest.mark.parametrize("words", ["{}", "[1]", "not JSON", '{"format": "another", "files": ["demo.json"]}'])
def test_a_folder_with_a_record_of_another_kind_is_refused_and_left_alone(tmp_path: Path, words: str) -> None:
    fill(tmp_path, {RECORD: words, "thesis.txt": "years of work"})
    with raises(OutputError, file=tmp_path, value=[RECORD, "thesis.txt"]), replaced_whole(tmp_path):
        pytest.fail("the folder was given away")
    assert content(tmp_path) == {RECORD: words, "thesis.txt": "years of work"}


@pytest.mark.parametrize("name", ["mine.wav", "sounds/mine.wav", ".hidden"])
def test_a_demo_with_files_of_others_is_refused_and_left_alone(demo: Path, name: str) -> None:
    fill(demo, {name: "mine"})
    before = content(demo)
    with raises(OutputError, file=demo, value=[name]), replaced_whole(demo):
        pytest.fail("the folder was given away")
    assert content(demo) == before


def test_files_that_come_meanwhile_are_not_touched(demo: Path) -> None:
    before = content(demo)

    def go_on(begun: Path) -> None:
        finish(begun, NEW)
        fill(demo, {"mine.txt": "mine"})

    with raises(OutputError, file=demo, value=["mine.txt"]), replaced_whole(demo) as begun:
        go_on(begun)
    assert content(demo) == before | {"mine.txt": "mine"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError, OSError])
def test_whatever_ends_the_work_the_earlier_demo_stays(demo: Path, error: type[BaseException]) -> None:
    before = content(demo)

    def break_off(begun: Path) -> None:
        fill(begun, NEW)
        raise error

    with pytest.raises((error, OutputError)), replaced_whole(demo) as begun:
        break_off(begun)
    assert content(demo) == before


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
@pytest.mark.parametrize("moves", range(7))
def test_a_replacement_that_stops_half_way_is_undone(
    demo: Path, moves: int, error: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    before, rename, left = content(demo), Path.rename, [moves]

    def failing(source: Path, target: Path) -> Path:
        left[0] -= 1
        if left[0] == -1:
            raise error
        return rename(source, target)

    # Four entries of the old demo go out, three of the new one come in.
    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises((error, OutputError)), replaced_whole(demo) as begun:
        finish(begun, NEW)
    assert left[0] < 0
    assert content(demo) == before


def test_what_a_killed_run_left_is_in_nobodys_way(demo: Path) -> None:
    fill(demo, {".avmsf-demo-unfinished/half.txt": "half", ".avmsf-demo-replaced/old.txt": "old"})
    with replaced_whole(demo) as begun:
        assert list(begun.iterdir()) == []
        finish(begun, NEW)
    assert set(content(demo)) == {*NEW, RECORD}


def test_a_second_demo_is_refused_while_the_first_one_works(tmp_path: Path) -> None:
    folder, refused = tmp_path / "demo", []

    def intrude() -> None:
        try:
            with replaced_whole(folder):
                pass
        except FolderInUseError as error:
            refused.append(error)

    with replaced_whole(folder) as begun:
        fill(begun, NEW)
        second = threading.Thread(target=intrude)
        second.start()
        second.join()
        finish(begun, {})
    assert [each.holder["command"] for each in refused] == ["avmsf demo"]
    assert set(content(folder)) == {*NEW, RECORD}


def test_a_demo_that_was_killed_leaves_no_lock_behind(tmp_path: Path) -> None:
    fill(tmp_path, {".avmsf-demo.lock": "", ".avmsf-demo.lock.json": "{}"})
    with replaced_whole(tmp_path) as begun:
        finish(begun, NEW)
    assert set(content(tmp_path)) == {*NEW, RECORD}


def test_a_first_demo_that_fails_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), replaced_whole(tmp_path / "demo"):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "demo").write_text("mine")
    with raises(OutputError, file=tmp_path / "demo", value="file"), replaced_whole(tmp_path / "demo"):
        pytest.fail("the file was given away")
    assert (tmp_path / "demo").read_text() == "mine"
