"""The compact copy of ObjectFolder Real: no forces, a split that must not leak, and copies that are not whole."""

import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from avmsf.capture import CaptureWarning
from avmsf.capture.datasets import ObjectFolderCompact, open_dataset
from avmsf.errors import DatasetError
from dataset_folders import FRAMES, ONSET, RATE, place, transfer, write_compact, write_mesh

NAMES = ("0", "3", "12")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of two objects; nobody changes it."""
    return write_compact(tmp_path_factory.mktemp("compact") / "DATA_real", {"92": NAMES, "51": ("0", "1")})


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    """Return a copy that a test may change."""
    return Path(shutil.copytree(whole, tmp_path / "DATA_real"))


def test_recordings_read_back_from_their_onset_on(whole: Path) -> None:
    capture = ObjectFolderCompact(whole).capture("92")
    impacts = capture.impacts
    assert impacts.names == ("0.wav", "3.wav", "12.wav")
    assert impacts.forces is None
    assert (impacts.sample_rate, impacts.duration) == (RATE, 3.0)
    assert np.array_equal(impacts.contacts.numpy(), np.stack([place("92", name) for name in NAMES]))
    for sound, name in zip(impacts.sounds.numpy(), NAMES, strict=True):
        truth = 8 * transfer(int(name))
        # Without a force the sound itself tells when it began: within the first rise of its modes, a few samples.
        shifts = [np.abs(sound[:2000] - truth[shift : shift + 2000]).max() for shift in range(12)]
        assert min(shifts) < 1e-3
        assert ONSET + int(np.argmin(shifts)) + len(sound) <= FRAMES


def test_the_copy_s_points_are_the_surface_until_there_is_a_mesh(folder: Path) -> None:
    dataset = ObjectFolderCompact(folder)
    surface = dataset.capture("92").surface
    assert surface is not None
    assert (tuple(surface.vertices.shape), len(surface.faces)) == ((1024, 3), 0)
    assert torch.equal(
        surface.vertices, torch.from_numpy(np.load(folder / "global_gt_points/92.npy").astype(np.float32))
    )
    assert dataset.look("92") is None
    write_mesh(folder.parent / "mesh_16k" / "92.obj")
    assert dataset.look("92") is not None
    meshed = dataset.capture("92").surface
    assert meshed is not None
    assert len(meshed.faces) == 1280


def test_the_split_s_parts_are_disjoint_and_cover_the_object(whole: Path) -> None:
    dataset = ObjectFolderCompact(whole)
    split = dataset.split("92")
    assert split == {"train": ("0.wav", "3.wav"), "val": (), "test": ("12.wav",)}
    assert sorted(name for names in split.values() for name in names) == sorted(dataset.capture("92").impacts.names)
    assert dataset.size("92") == 0.29946


def test_a_split_that_leaks_is_refused(folder: Path) -> None:
    split = json.loads((folder / "split.json").read_text())
    split["train"].append([92, 12])
    (folder / "split.json").write_text(json.dumps(split))
    with pytest.raises(DatasetError, match="contact 12 of object 92 is in both train and test"):
        ObjectFolderCompact(folder).split("92")


def test_recordings_that_the_split_names_must_be_there(folder: Path) -> None:
    (folder / "audio/92/3.wav").unlink()
    dataset = ObjectFolderCompact(folder)
    with pytest.raises(
        DatasetError, match=r"split.json names 1 recordings that are not there: audio/92/3.wav is missing"
    ):
        dataset.capture("92")
    assert "audio/92/3.wav is missing, and split.json names it" in dataset.check().objects[1].problems
    shutil.rmtree(folder / "audio/92")
    assert "recordings of objects 92, which split.json names" in dataset.check().missing[0]


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros(3, dtype=np.float32), r"contacts/92/3.npy holds float32 \(3,\), expected float64 \(3,\)"),
        (np.zeros((1, 3)), r"holds float64 \(1, 3\), expected float64 \(3,\)"),
        (np.array([0, np.nan, 0]), "holds numbers that are not finite"),
    ],
)
def test_a_contact_of_another_form_is_named_and_left_out(folder: Path, array: np.ndarray, message: str) -> None:
    np.save(folder / "contacts/92/3.npy", array)
    with pytest.warns(CaptureWarning, match=message):
        assert len(ObjectFolderCompact(folder).capture("92").impacts) == 2


def test_files_cut_short_are_told_by_their_headers(folder: Path) -> None:
    for name in ("contacts/92/3.npy", "global_gt_points/92.npy"):
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[:-8])
    (folder / "contacts/92/0.npy").write_bytes(b"<html>not found</html>")
    report = ObjectFolderCompact(folder).check().objects[1]
    assert report.recordings == 1
    assert "contacts/92/0.npy is no NumPy array" in report.problems[0]
    assert "contacts/92/3.npy is cut short, 144 of 152 bytes" in report.problems[1]
    assert "global_gt_points/92.npy is cut short" in report.problems[2]


def test_half_a_copy_is_told_by_its_missing_parts(folder: Path) -> None:
    shutil.rmtree(folder / "contacts")
    (folder / "scale.json").unlink()
    dataset = open_dataset(folder)
    missing = dataset.check().missing
    assert [part.split(":")[0] for part in missing] == ["contacts", "scale.json"]
    with pytest.raises(DatasetError, match=r"found 0 that can be used: contacts/92/0.npy is missing"):
        dataset.capture("92")
    (folder / "audio.tar.gz").touch()
    shutil.rmtree(folder / "audio")
    with pytest.raises(
        DatasetError, match=r"part of the compact copy .*: audio \(unpack audio.tar.gz\), contacts, scale"
    ):
        open_dataset(folder)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("scale.json", "{", "scale.json: not a JSON file that can be read"),
        ("scale.json", "[1]", "expected a JSON object, found a list"),
        ("scale.json", '{"92": 0}', "92 is 0; expected the object's size, above 0"),
        ("split.json", '{"train": []}', "val holds no list of"),
    ],
)
def test_json_of_another_form_is_refused(folder: Path, name: str, text: str, message: str) -> None:
    (folder / name).write_text(text)
    dataset = ObjectFolderCompact(folder)
    with pytest.raises(DatasetError, match=message):
        dataset.size("92") if name == "scale.json" else dataset.split("92")


def test_a_place_struck_twice_is_warned_of(folder: Path) -> None:
    shutil.copy(folder / "contacts/92/0.npy", folder / "contacts/92/12.npy")
    with pytest.warns(CaptureWarning, match=r"struck in one and the same place: 0.wav, 12.wav$"):
        ObjectFolderCompact(folder).capture("92")


def test_contacts_off_the_points_are_warned_of(folder: Path) -> None:
    for contact in NAMES:
        path = folder / "contacts/92" / f"{contact}.npy"
        np.save(path, 1 + np.load(path))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ObjectFolderCompact(folder).capture("92")
    assert "the contacts lie up to" in str(caught[0].message)


def test_contacts_in_another_unit_than_the_points_are_refused(folder: Path) -> None:
    for contact in NAMES:
        path = folder / "contacts/92" / f"{contact}.npy"
        np.save(path, 1000 * np.load(path))
    with pytest.raises(DatasetError, match=r"divided by 1000 .* is their unit mm"):
        ObjectFolderCompact(folder).capture("92")
