"""ObjectFolder Real and RealImpact as published: whatever force and gain, the same object sounds the same."""

import json
import os
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
import trimesh

from avmsf.capture import Capture
from avmsf.datasets import ObjectFolderRaw, RealImpact
from avmsf.datasets.objectfolder import read_contacts, read_gain_db, read_newtons
from avmsf.datasets.realimpact import closest_rows
from avmsf.errors import CaptureWarning, DatasetError
from factories.dataset_folders import (
    AUDIO_CONTACTS,
    RATE,
    ROWS,
    place,
    records,
    transfer,
    write_contacts,
    write_mesh,
    write_raw,
    write_realimpact,
    write_strike,
)
from factories.raising import raises


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a raw tree of two objects with contacts and a mesh; nobody changes it."""
    home = write_raw(tmp_path_factory.mktemp("raw") / "of", {"10": ("0", "1"), "2": AUDIO_CONTACTS})
    write_mesh(home / "mesh_16k" / "2" / "model.obj")
    # As some systems leave next to each file.
    (home / "mesh_16k" / "2" / "._model.obj").write_bytes(b"no mesh")
    return home


def read_silently(dataset: ObjectFolderRaw, identifier: str) -> tuple[Capture, str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CaptureWarning)
        capture = dataset.capture(identifier)
    return capture, " ".join(str(each.message) for each in caught)


def test_force_gain_and_pad_are_divided_out(folder: Path) -> None:
    capture, remarks = read_silently(ObjectFolderRaw(folder), "2")
    impacts = capture.impacts
    assert remarks == ""
    assert (impacts.sample_rate, impacts.duration) == (RATE, 3.0)
    assert impacts.names == ("0.wav", "1.wav", "2.wav", "10.wav")
    assert impacts.forces.tolist() == [2, 3, 4, 5]
    truth = np.stack([transfer(int(name)) for name in AUDIO_CONTACTS])
    # The force rises through a tenth of its peak on its first sample, so sample zero is the blow's; what is left is the
    # rounding to 16 bits, at most half a step over the factor that was divided out.
    factors = np.array([2 * 10 ** (-2 / 20), 3 * 10 ** (-8 / 20), 4 * 10 ** (6 / 20), 5 * 10 ** (-8 / 20)])
    error = np.abs(impacts.sounds.numpy() - truth[:, : 3 * RATE]).max(axis=1)
    assert (error * factors < 1.01 * (0.5 + 1) / 32767).all()
    assert np.allclose(impacts.contacts, [place("2", name) for name in AUDIO_CONTACTS], rtol=0, atol=0)


def test_the_mesh_is_surface_and_look(folder: Path) -> None:
    dataset = ObjectFolderRaw(folder)
    source = dataset.visual_source("2")
    assert (source.folder / (source.settings.surface or "")).name == "model.obj"
    surface = dataset.capture("2").surface
    assert torch.allclose(surface.vertices.norm(dim=1), torch.tensor(0.1), atol=1e-6)
    assert dataset.visual_source("10") is None
    assert dataset.capture("10").surface is None


def test_the_deprecated_contact_is_passed_over(tmp_path: Path) -> None:
    write_raw(tmp_path, {"24": ("12", "13")})
    write_strike(tmp_path / "24" / "audio" / "13_deprecated", seed=99)
    dataset = ObjectFolderRaw(tmp_path)
    assert dataset.capture("24").impacts.names == ("12.wav", "13.wav")
    assert dataset.check().objects[0].problems == ()


def test_a_missing_note_of_the_gain_is_named_and_the_usual_gain_taken(tmp_path: Path) -> None:
    for contact in ("34", "35", "36"):
        write_strike(tmp_path / "92" / "audio" / contact, gain=24.0, seed=35)
    (tmp_path / "92" / "audio" / "35" / "metadata.yaml").unlink()
    dataset = ObjectFolderRaw(tmp_path, contacts=write_contacts(tmp_path, {"92": ("34", "35", "36")}))
    capture, remarks = read_silently(dataset, "92")
    assert "metadata.yaml is missing for contact 35" in remarks
    assert "assumed to be 4 dB" in remarks
    assert torch.equal(capture.impacts.sounds[0], capture.impacts.sounds[1])
    (report,) = dataset.check().objects
    assert (report.recordings, len(report.problems)) == (3, 1)


@pytest.mark.parametrize("lines", [True, False])
def test_contacts_of_a_list_are_read_in_both_forms(folder: Path, tmp_path: Path, lines: bool) -> None:
    path = write_contacts(tmp_path, {"2": AUDIO_CONTACTS}, lines=lines)
    assert read_contacts([path]) == {("2", contact): tuple(place("2", contact)) for contact in AUDIO_CONTACTS}
    for given in (path, tmp_path):
        reports = ObjectFolderRaw(folder, contacts=given).check().objects
        assert reports[0].recordings == 4
        assert "contact coordinates in objectfolder_real_train.json" in reports[1].problems[0]


def test_both_ways_to_write_the_notes(shared: Path, tmp_path: Path) -> None:
    (tmp_path / "block.yaml").write_bytes(b"gain:\r\n- 12\r\n- 18\r\npad:\r\n- 1\r\n- 0\r\n")
    (tmp_path / "flow.yaml").write_bytes(b"gain: [12, 18]\r\npad: [1, 0]\r\n")
    (tmp_path / "pad.yaml").write_bytes(b"gain: [12, 18]\r\npad: [1, 1]\r\n")
    assert [read_gain_db(tmp_path / f"{name}.yaml") for name in ("block", "flow", "pad")] == [18.0, 18.0, -2.0]
    assert read_gain_db(shared / "bowl_clips" / "metadata.yaml") == -2.0
    for text in (b"- striking_force_newtons: 41.5\r\n", b"[{striking_force_newtons: 4.15e1}]"):
        (tmp_path / "force.yaml").write_bytes(text)
        assert read_newtons(tmp_path / "force.yaml") == 41.5


def test_what_cannot_be_used_is_left_out_and_named(tmp_path: Path) -> None:
    write_raw(tmp_path, {"7": ("0", "1", "2", "3", "4", "5", "6", "7", "8", "9")})
    audio = tmp_path / "7" / "audio"
    (audio / "1" / "Force.wav").unlink()
    (audio / "2" / "striking_force.yaml").unlink()
    (audio / "3" / "striking_force.yaml").write_text("- striking_force_newtons: 0\n")
    write_contacts(tmp_path, {"7": ("0", "1", "2", "3", "5", "6", "7", "8", "9")})
    (audio / "5" / "metadata.yaml").write_text("gain: [12]\n")
    samples = soundfile.read(audio / "6" / "mic.wav", dtype="int16")[0]
    soundfile.write(audio / "6" / "mic.wav", samples, 44_100, subtype="PCM_16")
    soundfile.write(audio / "7" / "mic.wav", samples[:200_000], RATE, subtype="PCM_16")
    dataset = ObjectFolderRaw(tmp_path)
    (report,) = dataset.check().objects
    assert report.recordings == 3
    expected = (
        ("7/audio/1/Force.wav", "got none"),
        ("7/audio/2/striking_force.yaml", "got none"),
        ("7/audio/3/striking_force.yaml", "got 0"),
        ("7/audio/4: expected contact coordinates in objectfolder_real_train.json", "got none"),
        ("7/audio/5/metadata.yaml", "got 'gain: [12]'"),
        ("7/audio/6/mic.wav", "got 44100"),
        ("7/audio/7/mic.wav", "got 200000"),
    )
    for (file, found), problem in zip(expected, report.problems, strict=True):
        assert file in problem
        assert found in problem
    # A silent force is found on reading.
    soundfile.write(audio / "8" / "Force.wav", np.zeros(288_000, dtype=np.int16), RATE, subtype="PCM_16")
    capture, remarks = read_silently(dataset, "7")
    assert capture.impacts.names == ("0.wav", "9.wav")
    assert expected[0][0] in remarks


def test_without_contacts_check_says_where_to_get_them(tmp_path: Path) -> None:
    dataset = ObjectFolderRaw(write_raw(tmp_path / "of", {"7": ("0", "1")}, contacts=False))
    report = dataset.check()
    assert report.objects[0].recordings == 0
    assert report.missing[0].startswith("contact coordinates, which the audio archives do not hold: put SonicGauss")
    with raises(DatasetError, name="ObjectFolder Real, object 7", value=0):
        dataset.capture("7")


def test_check_reads_no_sound(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soundfile.SoundFile, "read", None)
    dataset = ObjectFolderRaw(folder)
    report = dataset.check()
    assert dataset.objects() == ("2", "10")
    assert [each.recordings for each in report.objects] == [4, 2]
    # What of the published set is not here.
    assert [part.split(":")[0] for part in report.missing][:2] == ["objects 11 to 20", "objects 21 to 30"]


FIRST, SECOND = records("3", ("5", "6"))
BLOCK = "gain:\n- 12\n- 18\n- 3\npad: [1, 1]"


@pytest.mark.parametrize(
    ("file", "text", "row", "name", "value"),
    [
        ("list.json", json.dumps({"location": "x/5.wav", "contact": [0, 0, 0]}), 1, "location", "x/5.wav"),
        ("list.json", json.dumps({"location": "3_5_3sec.wav", "contact": [0, 0]}), 1, "contact", [0, 0]),
        ("list.json", json.dumps({"location": "3_5_3sec.wav", "contact": [0, 0, "1"]}), 1, "contact", [0, 0, "1"]),
        ("list.json", "\n[[1, 2]]", 0, "location", None),
        *(("list.json", text, None, None, None) for text in ("[" * 100_000, '{"a": ' + "[" * 100_000)),
        ("list.json", json.dumps([FIRST, SECOND | {"location": FIRST["location"]}]), 1, "5", tuple(SECOND["contact"])),
        ("metadata.yaml", "gain: [12]\npad: [1, 1]", None, "gain", "gain: [12]\npad: [1, 1]"),
        ("metadata.yaml", BLOCK, None, "gain", BLOCK),
        ("metadata.yaml", "gain: [12, 18]", None, "pad", "gain: [12, 18]"),
        ("metadata.yaml", "gain: [12, 18]\npad: [0.5, 1]", None, "pad", (0.5, 1.0)),
    ],
)
def test_lists_and_notes_that_cannot_be_meant_are_refused(tmp_path, file, text, row, name, value):
    (tmp_path / file).write_text(f"{text}\n" if file == "metadata.yaml" else text)
    with raises(DatasetError, file=file, row=row, name=name, value=value):
        read_contacts([tmp_path / file]) if file == "list.json" else read_gain_db(tmp_path / file)


NAME = "43_IronMortar"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of one object; nobody changes it."""
    home = tmp_path_factory.mktemp("realimpact")
    write_realimpact(home, NAME)
    return home


@pytest.fixture
def copied(whole: Path, tmp_path: Path) -> Path:
    """Return a copy that a test may change."""
    return Path(shutil.copytree(whole, tmp_path / "RealImpact"))


def test_every_blow_is_heard_by_the_closest_microphone(whole: Path) -> None:
    capture = RealImpact(whole).capture(NAME)
    home = whole / NAME / "preprocessed"
    listeners, vertices = np.load(home / "listenerXYZ.npy"), np.load(home / "vertexID.npy")
    corners = np.asarray(trimesh.load(home / "transformed.obj", process=False).vertices)
    # Every distance there is, the plain way.
    distance = np.array([np.linalg.norm(corners - listener, axis=1).min() for listener in listeners[:600]])
    best = int(distance.argmin())
    # The height of a sound's first sample tells its row.
    rows = [round((float(sound[0]) / 0.01 - 1) * ROWS) for sound in capture.impacts.sounds.numpy()]
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
def test_files_that_are_not_what_they_should_be_are_refused(copied: Path, file, damage, name, value) -> None:
    path = copied / NAME / "preprocessed" / file
    if damage is None:
        path.unlink()
    elif isinstance(damage, int):
        os.truncate(path, damage)
    elif isinstance(damage, float):
        np.lib.format.open_memmap(path, mode="r+")[:, 7] = damage
    else:
        np.save(path, damage)
    with raises(DatasetError, file=f"preprocessed/{file}", name=name) as caught:
        RealImpact(copied).capture(NAME)
    assert value is None or caught.value.value == value
    if damage is None or isinstance(damage, int):
        report = RealImpact(copied).check().objects[0]
        assert report.recordings == 0
        assert any(file in problem for problem in report.problems)
