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
    assert (capture.impacts.sample_rate, capture.impacts.forces) == (48_000.0, None)
    published = np.load(home / "deconvolved_0db.npy", mmap_mode="r")
    assert np.array_equal(capture.impacts.sounds.numpy(), published[rows])
    source = RealImpact(whole).visual_source(NAME)
    assert (source.folder / (source.settings.surface or "")).is_file()
    assert len(capture.surface.faces) == 1280


def test_one_position_for_all_impacts_goes_before_a_closer_one_for_some() -> None:
    vertices = np.repeat([0, 1], 3)
    surface = np.zeros((1, 3))
    listeners = np.array([[1.0, 0, 0], [0, 2, 0], [0, 0, 3], [0, 0, 3], [0, 2, 1e-4], [0.5, 0, 0]])
    assert closest_rows(vertices, listeners, surface) == ([1, 4], True)
    listeners[3:] += 0.01
    assert closest_rows(vertices, listeners, surface) == ([0, 5], False)


def test_check_counts_blows_and_names_what_is_not_here(whole: Path) -> None:
    report = RealImpact(whole).check()
    assert (report.objects[0].recordings, report.objects[0].problems) == (5, ())
    assert report.missing[0].startswith("49 of 50 objects: unpack http://downloads.cs.stanford.edu/viscam/RealImpact")
    assert "100_Frisbee" in report.missing[0]
    assert "43_IronMortar" in report.remarks[0]


def spoil(path: Path, damage: object) -> None:
    """Delete a file, cut it to as many bytes, or write an array in its place."""
    if damage is None:
        path.unlink()
    elif isinstance(damage, int):
        with open(path, "r+b") as file:
            file.truncate(damage)
    elif isinstance(damage, float):
        np.lib.format.open_memmap(path, mode="r+")[:, 7] = damage
    else:
        np.save(path, damage)


@pytest.mark.parametrize(
    ("file", "damage", "name", "value"),
    [
        ("deconvolved_0db.npy", None, None, None),
        ("vertexXYZ.npy", None, None, None),
        ("transformed.obj", None, None, None),
        ("vertexID.npy", np.zeros(3000, dtype=np.int32), "shape", ("int32", 3000)),
        ("listenerXYZ.npy", np.zeros((2999, 3)), "shape", ("float64", 2999, 3)),
        ("vertexXYZ.npy", np.zeros((3000, 3), order="F"), "order", "F"),
        ("deconvolved_0db.npy", np.zeros((3000, 2)), "shape", ("float64", 3000, 2)),
        ("deconvolved_0db.npy", 1_000_000, "size", 1_000_000),
        ("deconvolved_0db.npy", np.nan, None, None),
        # A meter off the mesh along each axis.
        ("vertexXYZ.npy", np.ones((3000, 3)), None, None),
    ],
)
def test_files_that_are_not_what_they_should_be_are_refused(folder: Path, file, damage, name, value) -> None:
    spoil(folder / NAME / "preprocessed" / file, damage)
    with raises(DatasetError, file=f"preprocessed/{file}", name=name) as caught:
        RealImpact(folder).capture(NAME)
    assert value is None or caught.value.value == value
    if damage is None or isinstance(damage, int):
        report = RealImpact(folder).check().objects[0]
        assert report.recordings == 0
        assert any(file in problem for problem in report.problems)
