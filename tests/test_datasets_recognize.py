"""Which dataset a folder holds, captures read as one, and what is said to who names the wrong folder."""

import re
import shutil
from pathlib import Path

import pytest
import soundfile

from avmsf.capture import read_capture
from avmsf.capture.datasets import (
    CaptureCollection,
    Dataset,
    ObjectFolderCompact,
    ObjectFolderRaw,
    RealImpact,
    open_dataset,
)
from avmsf.cli import dataset as verb
from avmsf.cli.options import dataset as options
from avmsf.errors import DatasetError
from capture_folder import fill
from dataset_folders import write_compact, write_contacts, write_mesh, write_raw, write_realimpact


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with one dataset of each kind; nobody changes it."""
    home = tmp_path_factory.mktemp("place")
    write_raw(home / "raw/of", {"2": ("0", "1")})
    write_compact(home / "compact/DATA", {"51": ("0", "1")})
    write_realimpact(home / "impact/RI", "22_Cup")
    fill(home / "own/captures/bowl")
    fill(home / "own/captures/10_plate")
    fill(home / "own/captures/2_cup")
    fill(home / "own/captures/.hidden")
    (home / "own/captures/notes").mkdir()
    (home / "own/captures/.avmsf").mkdir()
    return home


@pytest.mark.parametrize(
    ("path", "kind", "objects"),
    [
        ("raw/of", ObjectFolderRaw, ("2",)),
        ("compact/DATA", ObjectFolderCompact, ("51",)),
        ("impact/RI", RealImpact, ("22_Cup",)),
        ("own/captures", CaptureCollection, ("2_cup", "10_plate", "bowl")),
        ("own/captures/bowl", CaptureCollection, ("bowl",)),
    ],
)
def test_each_kind_is_recognized(place: Path, path: str, kind: type[Dataset], objects: tuple[str, ...]) -> None:
    dataset = open_dataset(place / path)
    assert isinstance(dataset, kind)
    assert dataset.objects() == objects
    assert [report.facts for report in dataset.check().objects] == [dataset.facts(name) for name in objects]


@pytest.mark.parametrize("path", ["raw/of", "compact/DATA", "impact/RI", "own/captures"])
def test_every_dataset_answers_alike(place: Path, path: str) -> None:
    dataset = open_dataset(place / path)
    for report in dataset.check().objects:
        impacts = dataset.capture(report.facts.identifier).impacts
        assert len(impacts) == report.recordings
        # Separate names, so that training and test recordings can be told apart.
        assert len(set(impacts.names)) == len(impacts)
    for ask in (dataset.facts, dataset.capture, dataset.look):
        with pytest.raises(DatasetError, match="has no object 'teapot' here"):
            ask("teapot")


def test_raw_goes_before_compact_where_both_are_in_one_folder(place: Path, tmp_path: Path) -> None:
    shutil.copytree(place / "compact/DATA", tmp_path, dirs_exist_ok=True)
    write_raw(tmp_path, {"2": ("0", "1")}, contacts=False)
    write_contacts(tmp_path, "2", ("0", "1"))
    assert isinstance(open_dataset(tmp_path), ObjectFolderRaw)


WRONG = {
    "raw": r"found it one level below: name .*raw/of \(ObjectFolder Real\)",
    "raw/of/2": r"found one object of ObjectFolder Real: name the folder above, .*raw/of$",
    "raw/of/2/audio": r"found the contacts of one object of ObjectFolder Real: name .* 2 levels above, .*raw/of$",
    "raw/of/2/audio/0": r"found one recording of ObjectFolder Real: name the folder 3 levels above, .*raw/of$",
    "compact/DATA/audio": r"found recordings of the compact copy: name the folder around audio/, .*compact/DATA$",
    "compact/DATA/audio/51": r"found recordings of the compact copy: name the folder around audio/, .*compact/DATA$",
    "impact/RI/22_Cup": r"found one object of RealImpact: name the folder above, .*impact/RI$",
    "impact/RI/22_Cup/preprocessed": r"name the folder 2 levels above, .*impact/RI$",
    "own": r"found it one level below: name .*own/captures \(captures\)",
    "own/captures/notes": "the folder is empty",
    "own/captures/bowl/impacts.csv": "is a file; expected a folder",
    "own/capture": r"there is no such folder \(did you mean .*own/captures\?\)",
}


@pytest.mark.parametrize("path", WRONG)
def test_the_wrong_folder_is_told_from_the_right_one(place: Path, path: str) -> None:
    with pytest.raises(DatasetError, match=WRONG[path]):
        open_dataset(place / path)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (
            ["100_Frisbee.zip", "10_bowl.zip"],
            "archives that are not unpacked, 100_Frisbee.zip, 10_bowl.zip: `unzip 100_",
        ),
        (["audio_data_1_10.tar.gz"], "`tar -xf audio_data_1_10.tar.gz`"),
        (["43_IronMortar/preprocessed/"], "found preprocessed/ without arrays in it"),
        (["1/vision/a.mp4", "2/vision/b.mp4"], "found folders 1, 2 without audio/ in them"),
        (["1/audio/0/"], "found folders of ObjectFolder Real's objects without recordings"),
        (
            ["contacts/", "split.json"],
            r"part of the compact copy \(contacts, split.json\): audio, global_gt_points, scale",
        ),
        (["readme.txt", "model.pth"], "found model.pth, readme.txt"),
    ],
)
def test_what_is_there_instead_is_named(tmp_path: Path, files: list[str], message: str) -> None:
    for name in files:
        path = tmp_path / name
        (path if name.endswith("/") else path.parent).mkdir(parents=True, exist_ok=True)
        if not name.endswith("/"):
            path.touch()
    with pytest.raises(DatasetError, match=message) as caught:
        open_dataset(tmp_path)
    assert "expected a capture folder or a folder of them" in str(caught.value)


def test_options_of_another_dataset_are_refused(place: Path) -> None:
    with pytest.raises(DatasetError, match="holds RealImpact, which has contacts of its own"):
        open_dataset(place / "impact/RI", contacts=place)
    with pytest.raises(DatasetError, match="holds captures, whose objects have names of their own"):
        open_dataset(place / "own/captures", table=place)
    with pytest.raises(DatasetError, match=r"expected contacts: a folder with OBJECT/CONTACT.npy"):
        open_dataset(place / "raw/of", contacts=place).check()


def test_a_collection_reads_what_read_capture_reads(place: Path) -> None:
    dataset = CaptureCollection(place / "own/captures")
    one, other = dataset.capture("bowl"), read_capture(place / "own/captures/bowl")
    assert one.impacts.names == other.impacts.names
    assert one.impacts.sounds.equal(other.impacts.sounds)
    assert dataset.check().remarks == ("passed over, for there is no impacts.csv in them: notes",)
    assert dataset.look("bowl") is None
    with pytest.raises(DatasetError, match=re.escape("did you mean 10_plate")):
        dataset.capture("plate")


@pytest.mark.parametrize("sight", ["surface.ply", "images/a.png", "walk.mp4", "transforms.json", "splats.ply", "a.jpg"])
def test_a_capture_with_something_to_see_has_a_look(tmp_path: Path, sight: str) -> None:
    fill(tmp_path / "cup", settings='name = "my cup"')
    (tmp_path / "cup/images").mkdir()
    dataset = CaptureCollection(tmp_path)
    assert dataset.look("cup") is None
    if "/" not in sight:
        (tmp_path / "cup/images").rmdir()
    (tmp_path / "cup" / sight).touch()
    look = dataset.look("cup")
    assert look is not None
    assert (look.folder, look.settings.name, dataset.facts("cup").name) == (tmp_path / "cup", "my cup", "my cup")


def test_a_collection_s_check_reads_no_sound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(tmp_path / "a")
    fill(tmp_path / "b")
    (tmp_path / "b/b.wav").unlink()
    fill(tmp_path / "c", settings='unit = "miles"')
    fill(tmp_path / "d", settings='surface = "shape.obj"')
    monkeypatch.setattr(soundfile.SoundFile, "read", None)
    a, b, c, d = CaptureCollection(tmp_path).check().objects
    assert (a.recordings, a.problems) == (3, ())
    assert (b.recordings, b.problems) == (0, ("b.wav is missing",))
    assert "unit is 'miles'" in c.problems[0]
    assert d.problems == ("shape.obj, which capture.toml names as the surface, is missing",)


def test_the_verb_prints_what_is_there(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_mesh(place / "raw/mesh_16k/2.obj")
    assert verb.run(options.parse(["check", str(place / "raw/of")])) == 0
    out = capsys.readouterr().out
    assert "1 of 1 objects can be read, with 2 recordings" in out
    assert "missing: objects 11 to 20" in out
    assert verb.run(options.parse(["check", str(place / "impact/RI"), "--json"])) == 0
    streams = capsys.readouterr()
    assert '"identifier": "22_Cup"' in streams.out
    assert "missing: 49 of 50 objects" in streams.err


def test_the_verb_ends_with_2_where_nothing_can_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_raw(tmp_path / "of", {"2": ("0", "1")}, contacts=False)
    assert verb.run(options.parse(["check", str(tmp_path / "of")])) == 2
    streams = capsys.readouterr()
    assert "missing: contact coordinates" in streams.out
    assert "no object of" in streams.err
