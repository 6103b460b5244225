"""Which dataset a folder holds, captures read as one, and what is said to who names the wrong folder."""

import json
from pathlib import Path

import pytest
import soundfile

from avmsf._utils.text import in_order
from avmsf.capture import read_capture
from avmsf.cli import main
from avmsf.datasets import CaptureCollection, Dataset, ObjectFolderRaw, RealImpact, open_dataset
from avmsf.datasets.numbering import ABLATION, NON_SYMMETRIC, REALIMPACT_NAMES, material_in, number_of, shared_objects
from avmsf.errors import DatasetError
from factories.capture_folder import fill
from factories.dataset_folders import write_raw, write_realimpact
from factories.raising import raises


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with one dataset of each kind; nobody changes it."""
    home = tmp_path_factory.mktemp("place")
    write_raw(home / "raw/of", {"2": ("0", "1")})
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


@pytest.mark.parametrize("path", ["raw/of", "impact/RI", "own/captures"])
def test_sounds_of_every_dataset_start_where_they_are_asked_to(place: Path, path: str) -> None:
    own, peak = (open_dataset(place / path, time_zero=each) for each in (None, "peak"))
    name = own.objects()[0]
    usual, sounds = (dataset.capture(name).impacts.sounds for dataset in (own, peak))
    assert bool((sounds[:, 0].abs() == sounds.abs().amax(1)).all())
    # By these settings the preset `paper` knows where sounds start.
    assert peak.capture(name).settings.time_zero == "peak"
    assert not bool((usual[:, 0].abs() == usual.abs().amax(1)).any())
    found = open_dataset(place / path, time_zero="onset").capture(name)
    assert found.impacts.digest() == own.capture(name).impacts.digest()


@pytest.mark.parametrize("path", ["raw/of", "impact/RI", "own/captures"])
def test_every_dataset_answers_alike(place: Path, path: str) -> None:
    dataset = open_dataset(place / path)
    for report in dataset.check().objects:
        impacts = dataset.capture(report.facts.identifier).impacts
        assert len(impacts) == report.recordings
        # Separate names, so that training and test recordings can be told apart.
        assert len(set(impacts.names)) == len(impacts)
    for ask in (dataset.facts, dataset.capture, dataset.visual_source):
        with raises(DatasetError, name="object", value="teapot"):
            ask("teapot")


WRONG: dict[str, object] = {
    "raw": (Path("raw/of"),),
    **dict.fromkeys(("raw/of/2", "raw/of/2/audio", "raw/of/2/audio/0"), Path("raw/of")),
    **dict.fromkeys(("impact/RI/22_Cup", "impact/RI/22_Cup/preprocessed"), Path("impact/RI")),
    "own": (Path("own/captures"),),
    "own/captures/notes": (),
    "own/captures/bowl/impacts.csv": "file",
    "own/capture": ("captures",),
}
"""The folder, or the folders, to name in place of a wrong one, or what is there."""


@pytest.mark.parametrize("path", WRONG)
def test_the_wrong_folder_is_told_from_the_right_one(place: Path, path: str) -> None:
    right = WRONG[path]
    if isinstance(right, tuple):
        right = tuple(str(place / each) if isinstance(each, Path) else each for each in right)
    with raises(DatasetError, file=path, value=str(place / right) if isinstance(right, Path) else right):
        open_dataset(place / path)


@pytest.mark.parametrize(
    ("files", "found"),
    [
        (["100_Frisbee.zip", "10_bowl.zip"], ("100_Frisbee.zip", "10_bowl.zip")),
        (["audio_data_1_10.tar.gz"], ("audio_data_1_10.tar.gz",)),
        (["43_IronMortar/preprocessed/"], "preprocessed/"),
        (["1/vision/a.mp4", "2/vision/b.mp4"], ("1/", "2/")),
        (["1/audio/0/"], "audio/"),
        (["readme.txt", "model.pth"], ("model.pth", "readme.txt")),
    ],
)
def test_what_is_there_instead_is_named(tmp_path: Path, files: list[str], found: object) -> None:
    for name in files:
        path = tmp_path / name
        (path if name.endswith("/") else path.parent).mkdir(parents=True, exist_ok=True)
        if not name.endswith("/"):
            path.touch()
    with raises(DatasetError, file=tmp_path, value=found):
        open_dataset(tmp_path)


def test_options_of_another_dataset_are_refused(place: Path) -> None:
    with raises(DatasetError, file="impact/RI", name="contacts", value=str(place)):
        open_dataset(place / "impact/RI", contacts=place)
    with raises(DatasetError, file="own/captures", name="contacts", value=str(place)):
        open_dataset(place / "own/captures", contacts=place)
    with raises(DatasetError, file=place, name="contacts"):
        open_dataset(place / "raw/of", contacts=place).check()


def test_a_collection_reads_what_read_capture_reads(place: Path) -> None:
    dataset = CaptureCollection(place / "own/captures")
    one, other = dataset.capture("bowl"), read_capture(place / "own/captures/bowl")
    assert one.impacts.names == other.impacts.names
    assert one.impacts.sounds.equal(other.impacts.sounds)
    assert dataset.check().remarks == ("folders without impacts.csv are ignored: notes",)
    assert dataset.visual_source("bowl") is None


@pytest.mark.parametrize("sight", ["surface.ply", "images/a.png", "walk.mp4", "transforms.json", "splats.ply", "a.jpg"])
def test_a_capture_with_something_to_see_has_a_look(tmp_path: Path, sight: str) -> None:
    fill(tmp_path / "cup", settings='name = "my cup"')
    (tmp_path / "cup/images").mkdir()
    dataset = CaptureCollection(tmp_path)
    assert dataset.visual_source("cup") is None
    if "/" not in sight:
        (tmp_path / "cup/images").rmdir()
    (tmp_path / "cup" / sight).touch()
    source = dataset.visual_source("cup")
    assert (source.folder, source.settings.name, dataset.facts("cup").name) == (tmp_path / "cup", "my cup", "my cup")


def test_a_collection_s_check_reads_no_sound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(tmp_path / "a")
    fill(tmp_path / "b")
    (tmp_path / "b/b.wav").unlink()
    fill(tmp_path / "c", settings='unit = "miles"')
    fill(tmp_path / "d", settings='surface = "shape.obj"')
    monkeypatch.setattr(soundfile.SoundFile, "read", None)
    a, b, c, d = CaptureCollection(tmp_path).check().objects
    assert (a.recordings, a.problems) == (3, ())
    assert (b.recordings, len(b.problems)) == (0, 1)
    assert "b.wav: expected a sound file, got none" in b.problems[0]
    assert "'miles'" in c.problems[0]
    assert len(d.problems) == 1
    assert d.problems[0].startswith("shape.obj")


def test_check_of_a_dataset_is_json_and_ends_with_2_where_nothing_can_be_read(place, tmp_path, capsys):
    assert main(["check", str(place / "impact/RI"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["objects"][0]["facts"]["identifier"] == "22_Cup"
    write_raw(tmp_path / "of", {"2": ("0", "1")}, contacts=False)
    assert main(["check", str(tmp_path / "of")]) == 2
    streams = capsys.readouterr()
    assert "contact coordinates" in streams.out
    assert str(tmp_path / "of") in streams.err


# Numbers that no folder of ObjectFolder Real has; of 98 and 99 one is missing as well.
FOLDERS = set(range(1, 104)) - {72, 82, 98}


MATERIALS = {
    "ceramic": ("3_CeramicKoiBowl", "61_PlanterCeramic"),
    "wood": ("33_WoodWineGlass",),
    "glass": ("94_GlassGoblet",),
    None: ("0_WineGlass", "93_GreenGoblet", "91_MetalSpoon", "97_PlasticScoop", "62_Pot_Hexagonal", "10_bowl"),
}


def test_a_material_is_inferred_where_the_name_leaves_no_doubt() -> None:
    for material, names in MATERIALS.items():
        assert [material_in(name) for name in names] == [material] * len(names)


def test_the_paper_s_subsets_are_folders_that_exist() -> None:
    assert (len(set(ABLATION)), len(set(NON_SYMMETRIC))) == (10, 16)
    assert {int(name) for name in (*ABLATION, *NON_SYMMETRIC)} <= FOLDERS
    assert set(shared_objects()) <= FOLDERS


def test_names_are_in_natural_order() -> None:
    names = ("9", "10", "100_x", "a9", "a10", "b")
    assert in_order(reversed(names)) == names
    assert in_order(REALIMPACT_NAMES) == REALIMPACT_NAMES
    assert len(shared_objects()) == len({number_of(name) for name in REALIMPACT_NAMES}) == 50
