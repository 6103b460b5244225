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
from raising import raises, warns

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
    with raises(DatasetError, file="split.json", name="test", value=("92", "12")):
        ObjectFolderCompact(folder).split("92")


def test_recordings_that_the_split_names_must_be_there(folder: Path) -> None:
    (folder / "audio/92/3.wav").unlink()
    dataset = ObjectFolderCompact(folder)
    with raises(DatasetError, file="split.json", name="92", value=["audio/92/3.wav"]):
        dataset.capture("92")
    assert any("audio/92/3.wav" in each and "split.json" in each for each in dataset.check().objects[1].problems)
    shutil.rmtree(folder / "audio/92")
    assert "objects 92 of split.json" in dataset.check().missing[0]


@pytest.mark.parametrize(
    ("array", "found"),
    [
        (np.zeros(3, dtype=np.float32), "float32 (3,)"),
        (np.zeros((1, 3)), "float64 (1, 3)"),
        (np.array([0, np.nan, 0]), "NaN"),
    ],
)
def test_a_contact_of_another_form_is_named_and_left_out(folder: Path, array: np.ndarray, found: str) -> None:
    np.save(folder / "contacts/92/3.npy", array)
    with warns(CaptureWarning, name="ObjectFolder Real (compact), object 92") as caught:
        assert len(ObjectFolderCompact(folder).capture("92").impacts) == 2
    (remark,) = caught[0].message.value
    assert remark.startswith("contacts/92/3.npy")
    assert found in remark


def test_files_cut_short_are_told_by_their_headers(folder: Path) -> None:
    for name in ("contacts/92/3.npy", "global_gt_points/92.npy"):
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[:-8])
    (folder / "contacts/92/0.npy").write_bytes(b"<html>not found</html>")
    report = ObjectFolderCompact(folder).check().objects[1]
    assert report.recordings == 1
    names = ("contacts/92/0.npy", "contacts/92/3.npy", "global_gt_points/92.npy")
    assert all(problem.startswith(name) for problem, name in zip(report.problems, names, strict=True))
    assert "expected 152 bytes, got 144" in report.problems[1]


def test_half_a_copy_is_told_by_its_missing_parts(folder: Path) -> None:
    shutil.rmtree(folder / "contacts")
    (folder / "scale.json").unlink()
    dataset = open_dataset(folder)
    missing = dataset.check().missing
    assert [part.split(":")[0] for part in missing] == ["contacts", "scale.json"]
    with raises(DatasetError, name="ObjectFolder Real (compact), object 92", value=0) as caught:
        dataset.capture("92")
    assert "contacts/92/0.npy" in str(caught.value)
    (folder / "audio.tar.gz").touch()
    shutil.rmtree(folder / "audio")
    with raises(DatasetError, file=folder, value=("global_gt_points", "split.json")) as caught:
        open_dataset(folder)
    assert "audio (unpack audio.tar.gz), contacts, scale.json" in str(caught.value)


@pytest.mark.parametrize(
    ("name", "text", "key", "value"),
    [
        ("scale.json", "{", None, None),
        ("scale.json", "[1]", None, "list"),
        ("scale.json", '{"92": 0}', "92", 0),
        ("split.json", '{"train": []}', "val", "NoneType"),
    ],
)
def test_json_of_another_form_is_refused(
    folder: Path, name: str, text: str, key: str | None, value: str | int | None
) -> None:
    (folder / name).write_text(text)
    dataset = ObjectFolderCompact(folder)
    with raises(DatasetError, file=name, name=key, value=value):
        dataset.size("92") if name == "scale.json" else dataset.split("92")


def test_a_place_struck_twice_is_warned_of(folder: Path) -> None:
    shutil.copy(folder / "contacts/92/0.npy", folder / "contacts/92/12.npy")
    with warns(CaptureWarning, name="ObjectFolder Real (compact), object 92") as caught:
        ObjectFolderCompact(folder).capture("92")
    (remark,) = caught[0].message.value
    assert remark.endswith(": 0.wav, 12.wav")


def test_contacts_off_the_points_are_warned_of(folder: Path) -> None:
    for contact in NAMES:
        path = folder / "contacts/92" / f"{contact}.npy"
        np.save(path, 1 + np.load(path))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ObjectFolderCompact(folder).capture("92")
    assert isinstance(caught[0].message, CaptureWarning)
    assert len(caught[0].message.value) == 1


def test_contacts_in_another_unit_than_the_points_are_refused(folder: Path) -> None:
    for contact in NAMES:
        path = folder / "contacts/92" / f"{contact}.npy"
        np.save(path, 1000 * np.load(path))
    with raises(DatasetError, name="ObjectFolder Real (compact), object 92", value=1e-3):
        ObjectFolderCompact(folder).capture("92")
