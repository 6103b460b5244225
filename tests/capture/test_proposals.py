"""Settings are proposed where the recordings show that they help, and what is written is read back the same."""

import errno
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
import trimesh

from avmsf.capture import CaptureSettings, check, read_capture
from avmsf.capture.proposals import Proposal, propose_settings, write_settings
from avmsf.capture.settings import METRES
from avmsf.errors import CaptureError
from factories.capture_folder import RATE, fill, ring
from factories.raising import raises

SECONDS = 1.0
TIME = np.arange(round(SECONDS * RATE)) / RATE


def found(folder: Path) -> dict[str, object]:
    return {each.key: each.value for each in propose_settings(folder)}


def folder_of(path: Path, sounds: list[np.ndarray]) -> Path:
    return fill(path, sounds={f"{number:02}.wav": sound for number, sound in enumerate(sounds)})


def rumbling(
    level: float, frequency: float, *, before: float = 0.4, own: float = 0.0, noise: float = 1e-4
) -> list[np.ndarray]:
    """Return impacts in rumble of a random phase; `own` is a low mode of the object, at the rumble's frequency."""
    generator, sounds = np.random.default_rng(3), []
    for seed in range(6):
        wave = np.sin(2 * np.pi * (frequency * TIME + generator.uniform()))
        mode = np.where(before <= TIME, np.sin(2 * np.pi * frequency * (TIME - before)), 0)
        sounds.append(ring(SECONDS, before=before, noise=noise, seed=seed) + level * wave + own * mode)
    return sounds


@pytest.mark.parametrize(
    ("level", "frequency", "others", "proposed"),
    [
        (0.03, 6.0, {}, 20.0),
        (0.03, 30.0, {}, 40.0),
        (0.4, 8.0, {"before": 0.3}, 20.0),
        (0.03, 6.0, {"before": 0.05}, None),
        (0.03, 12.0, {"own": 0.3}, None),
        (1e-5, 6.0, {}, None),
        # Peaks are about .5, so that 2e-4 root mean square is 68 dB under them, and hides no decay.
        (3e-4, 6.0, {"noise": 1e-6}, None),
        (0.03, 90.0, {}, None),
    ],
    ids=["rumble", "octave", "sway", "nothing before", "the object's", "below the noise", "soft", "above"],
)
def test_a_highpass_is_proposed_for_rumble_before_the_impact(tmp_path, level, frequency, others, proposed):
    assert found(folder_of(tmp_path, rumbling(level, frequency, **others))).get("highpass") == proposed


def test_the_bowl_s_rumble_is_found(shared: Path, tmp_path: Path) -> None:
    rows = []
    for number, path in enumerate(sorted((shared / "bowl_clips").glob("*.wav"))):
        shutil.copy(path, tmp_path)
        rows.append(f"{path.name},{number},0,0")
    (tmp_path / "impacts.csv").write_text("\n".join(["file,x,y,z", *rows, ""]))
    assert found(tmp_path) == {"highpass": 20.0}


def hammer(newtons: float, *, pushes: int = 1) -> np.ndarray:
    force = 1e-4 * np.random.default_rng(0).standard_normal(4000)
    for push in range(pushes):
        force[400 + 900 * push : 409 + 900 * push] += newtons * np.sin(np.pi * np.arange(1, 10) / 10)
    return force


@pytest.mark.parametrize(
    ("second", "third", "proposed"),
    [
        ("hammer", None, {"force_channel": 2}),
        ("hammer", "noisier", {"force_channel": 2, "response_channel": 1}),
        ("pushes", None, {}),
        ("other", None, {}),
        ("noise", None, {"response_channel": 1}),
    ],
)
def test_channels_are_told_by_what_they_hold(tmp_path: Path, second: str, third: str | None, proposed) -> None:
    sounds = []
    for seed in range(3):
        sound = ring(0.5, before=0.05, seed=seed, noise=1e-4)
        noise = np.random.default_rng(seed).standard_normal(4000)
        kinds = {
            "hammer": hammer(5.0 + seed),
            "pushes": hammer(5.0, pushes=4),
            "other": ring(0.5, before=0.05, seed=seed + 10, noise=1e-4),
            "noise": 1e-4 * noise,
            "noisier": ring(0.5, before=0.05, seed=seed + 10, noise=1e-3),
        }
        sounds.append(np.stack([sound, kinds[second], *([kinds[third]] if third else [])], axis=1))
    folder = folder_of(tmp_path, sounds)
    assert found(folder) == proposed
    if proposed:
        write_settings(folder, propose_settings(folder))
        assert len(read_capture(folder).impacts) == 3


def test_the_aircraft_s_hammer_is_found(shared: Path) -> None:
    proposed = found(shared / "aircraft")
    assert proposed.pop("force_channel") == 1
    assert proposed.pop("response_channel") in (2, 3, 4)
    assert proposed == {}


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    given = ("force_channel", 1, "Because\nof # it all. " * 30), ("highpass", 20.0, "é"), ("unit", "mm", "")
    proposals = [Proposal(*each) for each in given]
    path = write_settings(tmp_path, proposals)
    expected = replace(CaptureSettings(), force_channel=1, highpass=20.0, unit="mm")
    assert CaptureSettings.read(path) == expected
    assert "# é\nhighpass = 20.0\n" in path.read_text(encoding="utf-8")


def test_settings_that_a_user_wrote_are_kept(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, rumbling(0.03, 6.0))
    (folder / "capture.toml").write_text("seconds = 0.4  # mine\n")
    proposals = propose_settings(folder)
    assert [each.key for each in proposals] == ["highpass"]
    with pytest.raises(CaptureError, match=proposals[0].line):
        write_settings(folder, proposals)
    assert (folder / "capture.toml").read_text() == "seconds = 0.4  # mine\n"
    # A choice is not questioned, not even of the default.
    (folder / "capture.toml").write_text("highpass = 0.0\n")
    assert propose_settings(folder) == ()


def test_settings_that_cannot_be_written_whole_are_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with raises(CaptureError, file=tmp_path / "capture.toml"):
        write_settings(tmp_path, [Proposal("unit", "mm", "")])
    assert not any(tmp_path.iterdir())


def test_what_cannot_be_read_is_passed_over(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, rumbling(0.03, 6.0))
    (folder / "05.wav").write_bytes(b"RIFF")
    (folder / "04.wav").unlink()
    assert found(folder) == {"highpass": 20.0}
    (folder / "impacts.csv").write_text("file\n")
    assert found(folder) == {}
    (folder / "impacts.csv").write_text("\n".join(["file,x,y,z", "00.wav,0,0,0", "01.wav,1,0,0"]))
    samples, _ = soundfile.read(folder / "00.wav")
    soundfile.write(folder / "01.wav", samples, 96000)
    assert found(folder) == {}
    (folder / "surface.obj").write_text("v 0 0 0\n")
    assert found(folder) == {}
    (folder / "impacts.csv").unlink()
    assert found(folder) == {}


@pytest.mark.parametrize(
    ("contacts", "surface", "proposed"),
    [
        ("m", "m", {}),
        ("mm", "m", {"unit": "mm", "surface_unit": "m"}),
        ("m", "mm", {"surface_unit": "mm"}),
        ("mm", "mm", {"unit": "mm"}),
        ("mm", "cm", {"unit": "mm", "surface_unit": "cm"}),
        ("in", "mm", {"unit": "in", "surface_unit": "mm"}),
    ],
)
def test_both_units_are_found_from_the_contacts_and_the_surface(tmp_path, contacts, surface, proposed):
    box = trimesh.creation.box((0.24, 0.16, 0.12))
    places = trimesh.sample.sample_surface(box, 12, seed=0)[0] / METRES[contacts]
    names = [f"{number:02}.wav" for number in range(len(places))]
    rows = [f"{name},{x:.6g},{y:.6g},{z:.6g}" for name, (x, y, z) in zip(names, places, strict=True)]
    sounds = {name: ring(0.3, before=0.05, seed=row) for row, name in enumerate(names)}
    folder = fill(tmp_path, rows=rows, replace=sounds)
    box.apply_scale(1 / METRES[surface]).export(folder / "surface.obj")
    proposals = propose_settings(folder)
    assert {each.key: each.value for each in proposals} == proposed
    if proposed:
        problems = "\n".join(check(folder).problems)
        assert all(f'{key} = "{unit}"' in problems for key, unit in proposed.items())
        write_settings(folder, proposals)
    assert check(folder).readable
    assert propose_settings(folder) == ()
