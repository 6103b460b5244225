"""`avmsf check`: settings that it proposes and writes, the alignment, and a mesh in another unit."""

from pathlib import Path

import numpy as np
import pytest
import soundfile

from avmsf.capture import CaptureSettings
from avmsf.cli import main
from factories.capture_folder import RATE, fill, ring
from factories.plate_capture import fill_plate
from factories.small_scene import write_surface_file
from factories.verbs import results_of

Streams = pytest.CaptureFixture[str]


@pytest.fixture
def rumbling(tmp_path: Path) -> Path:
    rumble = 0.03 * np.sin(2 * np.pi * 6 * np.arange(RATE) / RATE)
    sounds = {f"{name}.wav": ring(1.0, before=0.4, seed=seed) + rumble for seed, name in enumerate("abc")}
    return fill(tmp_path / "cup", replace=sounds)


def test_settings_are_written_once_and_hold_from_then_on(rumbling: Path, capsys: Streams) -> None:
    settings = rumbling / "capture.toml"
    before = results_of(capsys, "check", rumbling)[0]["proposals"]
    assert [(each["key"], each["value"]) for each in before] == [("highpass", 20.0)]
    assert not settings.exists()
    assert results_of(capsys, "check", rumbling, "--write-settings")[0]["proposals"] == before
    assert CaptureSettings.read(settings) == CaptureSettings(highpass=20.0)
    written = settings.read_text()
    # With them nothing more is proposed, so that nothing is written.
    assert main(["check", str(rumbling), "--write-settings"]) == 0
    assert settings.read_text() == written
    # What a user has written stays.
    settings.write_text("seconds = 0.5\n")
    assert main(["check", str(rumbling), "--write-settings"]) == 2
    assert settings.read_text() == "seconds = 0.5\n"


def test_other_settings_are_not_mixed_with_written_ones_nor_with_a_dataset(rumbling: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.toml"
    other.write_text("seconds = 0.5\n")
    assert main(["check", str(tmp_path)]) == 0
    for words in (["--settings", str(other)], ["--write-settings"]):
        assert main(["check", str(tmp_path), *words]) == 2
    assert main(["check", str(rumbling), "--settings", str(other), "--write-settings"]) == 2
    assert not (rumbling / "capture.toml").exists()


def fill_five(folder: Path, *, own_phases: int | None = None) -> Path:
    """Write recordings of five modes with the impact after .1 s and some samples; one may have phases of its own."""
    generator = np.random.default_rng(1)
    starts = 800 + np.array([0, 2, -1, 1, -2, 0, 1, -1])
    phases, sounds = np.array([0.2, 1.1, -0.6, 2.0, 0.9]), {}
    for number, start in enumerate(starts):
        time = (np.arange(6000) - start) / 8000
        gains = generator.normal(size=5)
        used = phases + (generator.uniform(0.6, 1.4, 5) * [1, -1, 1, -1, 1] if number == own_phases else 0.0)
        angles = 2 * np.pi * np.array([410.0, 733.0, 1190.0, 1805.0, 2620.0]) * time[:, None] + used
        sound = 0.05 * np.where(time >= 0, (np.exp(-15 * np.maximum(time, 0)[:, None]) * np.sin(angles)) @ gains, 0)
        sounds[f"{number}.wav"] = sound + 1e-4 * generator.normal(size=6000)
    return fill(folder, sounds=sounds, rate=8000)


def test_check_and_modes_report_one_alignment(tmp_path: Path, capsys: Streams) -> None:
    found, other = (results_of(capsys, verb, fill_five(tmp_path))[0]["alignment"] for verb in ("check", "modes"))
    assert found == other
    assert found["coherence_after"] > 0.99 > found["coherence_before"]
    assert found["not_aligned"] == []


def test_what_is_wrong_with_the_alignment_or_the_decay_is_a_problem(tmp_path: Path, capsys: Streams) -> None:
    folder = fill_five(tmp_path / "phases", own_phases=3)
    report, err = results_of(capsys, "check", folder)
    assert report["alignment"]["not_aligned"] == ["3.wav"]
    assert "no problem found" not in err
    folder = fill_five(tmp_path / "faded")
    for path in folder.glob("*.wav"):
        sound, rate = soundfile.read(path)
        soundfile.write(path, sound * np.minimum(1.0, np.linspace(2.0, 0.0, len(sound))), rate, subtype="FLOAT")
    assert main(["check", str(folder)]) == 0
    out = capsys.readouterr().out
    assert "fade-out" in out
    assert "no problem found" not in out


STAGES = ("gaussians", "features", "surface")
COMMANDS = ("check", "modes", "fit -o OUT.safetensors", *(f"fit --until {stage}" for stage in STAGES))


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_names_the_unit_of_the_mesh_and_writes_nothing(command, tmp_path, capsys):
    # Contacts in meters, and a mesh in a unit that the settings do not name.
    folder = fill_plate(tmp_path / "plate", surface=False)
    write_surface_file(folder)
    lines = [line.split() for line in (folder / "surface.obj").read_text().splitlines()]
    for line in lines:
        if line[0] == "v":
            line[1:] = [f"{1000 * float(value):.9g}" for value in line[1:]]
    (folder / "surface.obj").write_text("\n".join([*map(" ".join, lines), ""]))
    before = sorted(folder.rglob("*"))
    verb, *words = command.replace("OUT", str(tmp_path / "out")).split()
    assert main([verb, str(folder), *words]) == 2
    said = capsys.readouterr()
    assert 'surface_unit = "mm"' in said.out + said.err
    assert sorted(folder.rglob("*")) == before
    assert [each.name for each in tmp_path.iterdir()] == ["plate"]
