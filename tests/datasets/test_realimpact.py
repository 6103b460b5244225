"""RealImpact: the closest microphone by geometry, its rows alone read, and files that are not what they should be."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from avmsf.datasets import RealImpact
from avmsf.datasets.realimpact import closest_rows
from avmsf.errors import DatasetError
from factories.dataset_folders import ROWS, write_realimpact
from factories.raising import raises

NAME = "43_IronMortar"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of one object; nobody changes it."""
    home = tmp_path_factory.mktemp("realimpact")
    write_realimpact(home, NAME)
    return home


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    """Return a copy that a test may change."""
    return Path(shutil.copytree(whole, tmp_path / "RealImpact"))


def row_of(sound: np.ndarray) -> float:
    """Return the row that the height of a sound's first sample tells."""
    return float((sound[0] / 0.01 - 1) * ROWS)


def test_every_blow_is_heard_by_the_closest_microphone(whole: Path) -> None:
    capture = RealImpact(whole).capture(NAME)
    home = whole / NAME / "preprocessed"
    listeners, vertices = np.load(home / "listenerXYZ.npy"), np.load(home / "vertexID.npy")
    corners = np.asarray(trimesh.load(home / "transformed.obj", process=False).vertices)
    # Every distance there is, the plain way.
    distance = np.array([np.linalg.norm(corners - listener, axis=1).min() for listener in listeners[:600]])
    best = int(distance.argmin())
    rows = [round(row_of(sound)) for sound in capture.impacts.sounds.numpy()]
    assert rows == [best + 600 * blow for blow in range(5)]
    assert np.partition(distance, 1)[1] > distance[best] + 1e-3
    assert capture.impacts.names == tuple(f"vertex_{vertices[row]}.wav" for row in rows)
    assert np.array_equal(capture.impacts.contacts.numpy(), np.load(home / "vertexXYZ.npy")[rows])


def test_sounds_are_taken_as_published(whole: Path) -> None:
    impacts = RealImpact(whole).capture(NAME).impacts
    published = np.load(whole / NAME / "preprocessed/deconvolved_0db.npy", mmap_mode="r")
    assert (impacts.sample_rate, impacts.forces) == (48_000.0, None)
    row = round(row_of(impacts.sounds[0].numpy()))
    assert np.array_equal(impacts.sounds[0].numpy(), published[row])


def test_one_position_for_all_impacts_goes_before_a_closer_one_for_some() -> None:
    vertices = np.repeat([0, 1], 3)
    surface = np.zeros((1, 3))
    listeners = np.array([[1.0, 0, 0], [0, 2, 0], [0, 0, 3], [0, 0, 3], [0, 2, 1e-4], [0.5, 0, 0]])
    assert closest_rows(vertices, listeners, surface) == ([1, 4], True)
    listeners[3:] += 0.01
    assert closest_rows(vertices, listeners, surface) == ([0, 5], False)


def test_the_mesh_is_surface_and_look(whole: Path) -> None:
    dataset = RealImpact(whole)
    surface, source = dataset.capture(NAME).surface, dataset.visual_source(NAME)
    assert surface is not None
    assert source is not None
    assert (source.folder / (source.settings.surface or "")).is_file()
    assert len(surface.faces) == 1280


def test_check_counts_blows_and_names_what_is_not_here(whole: Path) -> None:
    report = RealImpact(whole).check()
    assert (report.objects[0].recordings, report.objects[0].problems) == (5, ())
    assert report.missing[0].startswith("49 of 50 objects: unpack http://downloads.cs.stanford.edu/viscam/RealImpact")
    assert "100_Frisbee" in report.missing[0]
    assert "43_IronMortar" in report.remarks[0]


@pytest.mark.parametrize(
    "name",
    ["deconvolved_0db.npy", "vertexXYZ.npy", "transformed.obj"],
)
def test_a_missing_file_is_named(folder: Path, name: str) -> None:
    (folder / NAME / "preprocessed" / name).unlink()
    dataset = RealImpact(folder)
    assert any(name in problem for problem in dataset.check().objects[0].problems)
    assert dataset.check().objects[0].recordings == 0
    with raises(DatasetError, file=f"preprocessed/{name}", name=None):
        dataset.capture(NAME)


@pytest.mark.parametrize(
    ("file", "array", "name", "value"),
    [
        ("vertexID.npy", np.zeros(3000, dtype=np.int32), "shape", ("int32", 3000)),
        ("listenerXYZ.npy", np.zeros((2999, 3)), "shape", ("float64", 2999, 3)),
        ("vertexXYZ.npy", np.zeros((3000, 3), order="F"), "order", "F"),
        ("deconvolved_0db.npy", np.zeros((3000, 2)), "shape", ("float64", 3000, 2)),
    ],
)
def test_arrays_of_another_form_are_refused(
    folder: Path, file: str, array: np.ndarray, name: str, value: object
) -> None:
    np.save(folder / NAME / "preprocessed" / file, array)
    with raises(DatasetError, file=f"preprocessed/{file}", name=name, value=value):
        RealImpact(folder).capture(NAME)


def test_contacts_off_the_mesh_are_refused(folder: Path) -> None:
    contacts = np.load(folder / NAME / "preprocessed/vertexXYZ.npy")
    np.save(folder / NAME / "preprocessed/vertexXYZ.npy", np.ones_like(contacts))
    with raises(DatasetError, file="preprocessed/vertexXYZ.npy", name=None) as caught:
        RealImpact(folder).capture(NAME)
    corners = np.asarray(trimesh.load(folder / NAME / "preprocessed/transformed.obj", process=False).vertices)
    assert caught.value.value == pytest.approx(np.linalg.norm(corners - 1, axis=1).min(), rel=1e-5)


def test_sounds_cut_short_are_told_without_reading_them(folder: Path) -> None:
    path = folder / NAME / "preprocessed/deconvolved_0db.npy"
    with open(path, "r+b") as file:
        file.truncate(1_000_000)
    problem = RealImpact(folder).check().objects[0].problems[0]
    assert "deconvolved_0db.npy: expected a whole NumPy array, got 1000000 bytes" in problem
    with raises(DatasetError, file="deconvolved_0db.npy", name="size", value=1_000_000):
        RealImpact(folder).capture(NAME)


def test_samples_that_are_no_numbers_are_refused(folder: Path) -> None:
    path = folder / NAME / "preprocessed/deconvolved_0db.npy"
    np.lib.format.open_memmap(path, mode="r+")[:, 7] = np.nan
    with raises(DatasetError, file="deconvolved_0db.npy", name=None) as caught:
        RealImpact(folder).capture(NAME)
    assert caught.value.row is not None
