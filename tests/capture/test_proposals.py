"""Settings are proposed where the recordings show that they help, and what is written is read back the same."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
import trimesh

from avmsf.capture import CaptureSettings, check, read_capture
from avmsf.capture.proposals import Proposal, propose_settings, settings_text, write_settings
from avmsf.capture.settings import METRES
from avmsf.errors import CaptureError
from factories.capture_folder import RATE, fill, ring

SECONDS = 1.0
TIME = np.arange(round(SECONDS * RATE)) / RATE


def found(folder: Path) -> dict[str, object]:
    return {each.key: each.value for each in propose_settings(folder)}


def folder_of(path: Path, sounds: list[np.ndarray], forces=None, contacts=None) -> Path:
    names = [f"{number:02}.wav" for number in range(len(sounds))]
    places = range(len(sounds)) if contacts is None else contacts
    rows = [f"{name},{0.1 * place},0,0" for name, place in zip(names, places, strict=True)]
    header = "file,x,y,z"
    if forces is not None:
        rows, header = (
            [f"{row},{force:.6g}" for row, force in zip(rows, forces, strict=True)],
            f"{header},force_newtons",
        )
    return fill(path, rows=rows, header=header, replace=dict(zip(names, sounds, strict=True)))


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
    ("level", "frequency", "before", "own", "proposed"),
    [
        (0.03, 6.0, 0.4, 0.0, 20.0),
        (0.03, 30.0, 0.4, 0.0, 40.0),
        (0.03, 6.0, 0.05, 0.0, None),
        (0.03, 12.0, 0.4, 0.3, None),
        (1e-5, 6.0, 0.4, 0.0, None),
        (0.03, 90.0, 0.4, 0.0, None),
    ],
    ids=["rumble", "octave", "nothing before", "the object's", "below the noise", "above"],
)
def test_a_highpass_is_proposed_for_rumble_before_the_impact(
    tmp_path: Path, level: float, frequency: float, before: float, own: float, proposed: float | None
) -> None:
    folder = folder_of(tmp_path, rumbling(level, frequency, before=before, own=own))
    assert found(folder).get("highpass") == proposed


def test_rumble_60_db_under_the_peak_hides_no_decay(tmp_path: Path) -> None:
    # Peaks are about .5, so that 2e-4 root mean square is 68 dB under them.
    assert found(folder_of(tmp_path, rumbling(3e-4, 6.0, noise=1e-6))) == {}


def test_the_bowl_s_rumble_is_found(shared: Path, tmp_path: Path) -> None:
    rows = []
    for number, path in enumerate(sorted((shared / "bowl_clips").glob("*.wav"))):
        shutil.copy(path, tmp_path)
        rows.append(f"{path.name},{number},0,0")
    (tmp_path / "impacts.csv").write_text("\n".join(["file,x,y,z", *rows, ""]))
    assert found(tmp_path) == {"highpass": 20.0}


@pytest.mark.parametrize("name", ["aircraft_response", "ruler10", "tree43"])
def test_impulse_responses_of_one_time_zero_need_no_alignment(shared: Path, name: str) -> None:
    assert found(shared / name) == {"align": False}


def test_recordings_trimmed_at_different_places_do(shared: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(shared / "aircraft_response", tmp_path / "trimmed")
    generator = np.random.default_rng(0)
    for path in sorted(folder.glob("impacts/*.wav")):
        sound, rate = soundfile.read(path)
        soundfile.write(path, sound[generator.integers(3) :], rate, subtype="FLOAT")
    assert found(folder) == {}


@pytest.mark.parametrize("repeated", [True, False])
@pytest.mark.parametrize("related", [True, False])
def test_forces_unrelated_to_the_loudness_are_not_divided_by(tmp_path: Path, related: bool, repeated: bool) -> None:
    generator = np.random.default_rng(1)
    count = 24
    forces = 10 ** generator.uniform(-0.7, 0.7, count)
    contacts = np.arange(count) // 4 if repeated else np.arange(count)
    # Contacts differ by 3 dB; repeated impacts differ by their force, or else by 1 dB.
    places = 10 ** (3 / 20 * generator.standard_normal(count))[contacts]
    gains = places * (forces if related else 10 ** (1 / 20 * generator.standard_normal(count))) / 30
    sounds = [gain * ring(0.3, before=0.05, seed=1, noise=1e-5) for gain in gains]
    folder = folder_of(tmp_path, sounds, forces, contacts)
    assert found(folder) == ({} if related else {"normalize": "none"})


def test_few_recordings_do_not_show_that_forces_are_unrelated(tmp_path: Path) -> None:
    sounds = [ring(0.3, before=0.05, seed=seed) for seed in range(5)]
    assert found(folder_of(tmp_path, sounds, [1, 2, 4, 8, 16])) == {}


def test_levels_that_scatter_do_not_show_it_either(tmp_path: Path) -> None:
    # The level goes with a fifth of the force, and differs by 6 dB among the contacts: two standard errors from a half.
    forces = 10 ** np.linspace(0, 0.6, 12)
    scatter = 10 ** (6 / 20 * np.array([1, -1, -1, 1, 1, -1, -1, 1, 1, -1, -1, 1]))
    sounds = [gain * ring(0.3, before=0.05, seed=1, noise=1e-5) for gain in forces**0.2 * scatter / 10]
    assert found(folder_of(tmp_path, sounds, forces)) == {}


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
    proposals = [
        Proposal("force_channel", 1, "Because\nof # it all. " * 30),
        Proposal("highpass", 20.0, "é"),
        Proposal("normalize", "none", "so"),
        Proposal("align", False, ""),
    ]
    path = write_settings(tmp_path, proposals)
    expected = replace(CaptureSettings(), force_channel=1, highpass=20.0, normalize="none", align=False)
    assert CaptureSettings.read(path) == expected
    assert path.read_text(encoding="utf-8") == settings_text(proposals)


def test_settings_that_a_user_wrote_are_kept(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, rumbling(0.03, 6.0))
    (folder / "capture.toml").write_text("seconds = 0.4  # mine\n")
    proposals = propose_settings(folder)
    assert [each.key for each in proposals] == ["highpass"]
    with pytest.raises(CaptureError):
        write_settings(folder, proposals)
    assert (folder / "capture.toml").read_text() == "seconds = 0.4  # mine\n"
    # A choice is not questioned, not even of the default.
    (folder / "capture.toml").write_text("highpass = 0.0\n")
    assert propose_settings(folder) == ()
    assert propose_settings(folder, CaptureSettings(highpass=5.0)) == ()


def test_what_cannot_be_read_is_passed_over(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, rumbling(0.03, 6.0))
    (folder / "05.wav").write_bytes(b"RIFF")
    (folder / "04.wav").unlink()
    assert found(folder) == {"highpass": 20.0}
    (folder / "impacts.csv").write_text("file\n")
    assert found(folder) == {}
    (folder / "impacts.csv").unlink()
    assert found(folder) == {}


def test_different_rates_are_refused_as_a_capture_and_nothing_is_proposed(tmp_path: Path) -> None:
    folder = fill(tmp_path)
    samples, _ = soundfile.read(folder / "b.wav")
    soundfile.write(folder / "b.wav", samples, 96000)
    assert propose_settings(folder) == ()
    assert not check(folder).readable


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
def test_both_units_are_found_from_the_contacts_and_the_surface(
    tmp_path: Path, contacts: str, surface: str, proposed: dict[str, object]
) -> None:
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
