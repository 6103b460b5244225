"""`avmsf locate`: text, JSON, heat maps and clouds; and recordings without an impact on the object."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
import trimesh
from torch import Tensor

from avmsf.cli import main
from avmsf.errors import LocationError
from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import save
from avmsf.localization.locator import Locator
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from avmsf.modal.synthesis import synthesize
from factories.made_fields import BANK, positional
from factories.raising import raises
from factories.verbs import run_verb

Streams = pytest.CaptureFixture[str]
RATE, SAMPLES = 8000, 4000
STRUCK, SECOND = 68, 102


@dataclass(frozen=True)
class Place:
    folder: Path
    field: str
    points: Tensor
    gains: Tensor

    def wav(self, name: str, sound: Tensor, *, rate: int = RATE, peak: float = 0.5) -> str:
        path = self.folder / name
        soundfile.write(path, (peak * sound / sound.abs().max()).numpy(), rate, subtype="FLOAT")
        return str(path)

    def blow(self, row: int, *, before: float = 0.1, bank: ModalBank = BANK, rate: int = RATE) -> Tensor:
        """Return a blow in faint noise, with some quiet before it."""
        gains = self.gains[row][None].to(torch.complex128)
        sound = synthesize(
            gains,
            bank.frequency,
            bank.damping,
            samples=SAMPLES * rate // RATE,
            sample_rate=float(rate),
        )[0]
        whole = torch.cat([torch.zeros(round(before * rate), dtype=torch.float64), sound])
        noise = torch.randn(len(whole), generator=torch.Generator().manual_seed(row), dtype=torch.float64)
        return whole + 1e-4 * sound.abs().max() * noise


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    folder = tmp_path_factory.mktemp("place")
    zero = torch.zeros(len(BANK), dtype=torch.float64)
    field = SoundField(
        BANK, positional(), zero, Residual(torch.full((9,), 1e-3)), float(RATE), SAMPLES, Origin("plate")
    )
    save(field, folder / "plate.safetensors")
    locator = Locator.of(field)
    return Place(folder, str(folder / "plate.safetensors"), locator.points, locator.gains)


def located(words: list[str], capsys: Streams) -> tuple[dict, str]:
    assert run_verb("locate", *words, "--json") == 0
    out, err = capsys.readouterr()
    return json.loads(out), err


def test_a_blow_is_found_drawn_and_told(place: Place, tmp_path: Path, capsys: Streams) -> None:
    hit = place.wav("hit.wav", -place.blow(STRUCK))
    printed, err = located([place.field, hit, "--output", str(tmp_path / "maps")], capsys)
    (blow,) = printed["impacts"]
    assert blow["position"] == pytest.approx(place.points[STRUCK].tolist(), abs=1e-6)
    assert blow["recording"] == hit
    assert blow["explained_energy"] > 0.98
    assert blow["mismatch_ratio"] < 0.01
    assert blow["credible_region"]["probability"] == 0.9
    # The field's own contacts, left out, are badly foretold by the others: the region is as wide as that makes it.
    assert 0.0 < blow["credible_region"]["surface_fraction"] < 0.7
    assert f"{hit}: impact at (" in err
    assert f"{100 * blow['explained_energy']:.0f} % of the sound" in err
    assert (tmp_path / "maps" / "hit.png").read_bytes().startswith(b"\x89PNG")
    cloud = trimesh.load(tmp_path / "maps" / "hit.ply")
    likeliest = int(np.argmax(cloud.metadata["_ply_raw"]["vertex"]["data"]["probability"]))
    assert cloud.vertices[likeliest] == pytest.approx(blow["position"], abs=1e-6)


def test_a_surer_region_is_larger(place: Place, capsys: Streams) -> None:
    hit = place.wav("sure.wav", place.blow(STRUCK))
    shares = []
    for level in ("0.5", "0.999"):
        printed, _ = located([place.field, hit, "--probability", level], capsys)
        shares.append(
            (
                printed["impacts"][0]["credible_region"]["surface_fraction"],
                printed["impacts"][0]["credible_region"]["radius"],
            )
        )
    assert shares[0][0] < shares[1][0]
    assert shares[0][1] < shares[1][1]


def test_several_blows_are_told_apart(place: Place, capsys: Streams) -> None:
    first, second = place.blow(STRUCK, before=0.1), place.blow(SECOND, before=0.4)
    both = torch.cat([first, torch.zeros(len(second) - len(first), dtype=torch.float64)]) + second
    two = place.wav("two.wav", both)
    printed, _ = located([place.field, two, "--several"], capsys)
    assert [blow["seconds"] for blow in printed["impacts"]] == pytest.approx([0.1, 0.4], abs=0.002)
    for blow, row in zip(printed["impacts"], (STRUCK, SECOND), strict=True):
        assert blow["position"] == pytest.approx(place.points[row].tolist(), abs=0.01)
    alone, err = located([place.field, two], capsys)
    assert len(alone["impacts"]) == 1
    assert "at 0.100 s and at 0." in err


@pytest.mark.slow
def test_no_blows_files_are_anothers(place: Place, tmp_path: Path, capsys: Streams) -> None:
    first, second = place.blow(STRUCK, before=0.1), place.blow(SECOND, before=0.4)
    both = torch.cat([first, torch.zeros(len(second) - len(first), dtype=torch.float64)]) + second
    words = [place.field, place.wav("twin.wav", both), place.wav("twin-2.wav", first), "--several"]
    printed, _ = located([*words, "--output", str(tmp_path)], capsys)
    stems = ["twin", "twin-2", "twin-2-2"]
    assert [Path(blow["picture"]).stem for blow in printed["impacts"]] == stems
    assert {path.name for path in tmp_path.iterdir()} == {f"{stem}.{end}" for stem in stems for end in ("png", "ply")}


def test_a_known_force_counts(place: Place, capsys: Streams) -> None:
    hit = place.wav("forced.wav", place.blow(STRUCK))
    shares = []
    for words in ([], ["--force", "1"], ["--force", "1", "--several"], ["--force", "1000"]):
        printed, _ = located([place.field, hit, *words], capsys)
        shares.append(printed["impacts"][0]["credible_region"]["surface_fraction"])
    assert shares[1] == pytest.approx(shares[2], abs=0.05)
    assert len({round(share, 3) for share in shares}) > 1
    with raises(LocationError, name="force.expected", value=0.0):
        run_verb("locate", place.field, hit, "--force", "0")


def test_another_rate_and_clipping_are_said(place: Place, capsys: Streams) -> None:
    fast = place.wav("fast.wav", place.blow(STRUCK, rate=16000), rate=16000)
    printed, err = located([place.field, fast], capsys)
    assert printed["impacts"][0]["position"] == pytest.approx(place.points[STRUCK].tolist(), abs=0.01)
    assert "note: " in err
    assert "resampled from 16000 Hz to the field's 8000 Hz" in err
    loud = place.blow(STRUCK)
    loud = loud.clamp(-0.4 * loud.abs().max(), 0.4 * loud.abs().max())
    _, err = located([place.field, place.wav("loud.wav", loud, peak=1.0)], capsys)
    assert "clipped" in err


def test_recordings_without_a_blow_on_the_object_have_no_place(place: Place, tmp_path: Path, capsys: Streams) -> None:
    silent = str(place.folder / "silent.wav")
    soundfile.write(silent, np.zeros(SAMPLES), RATE)
    noise = torch.randn(SAMPLES, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    other = ModalBank(BANK.frequency * 1.27 + 40.0, BANK.damping)
    cases = {
        silent: "silence",
        place.wav("noise.wav", noise): " dB",
        place.wav("other.wav", place.blow(STRUCK, bank=other)): "a mismatch ratio of",
    }
    for path, reason in cases.items():
        assert run_verb("locate", place.field, path, "--json", "--output", str(tmp_path)) == 2
        out, err = capsys.readouterr()
        (values,) = json.loads(out)["impacts"]
        assert values["status"] == "not located"
        assert values["position"] is None
        assert reason in values["reason"]
        assert f"{path}: not located: " in err
    assert not list(tmp_path.iterdir())


def test_one_bad_recording_does_not_cost_the_others(place: Place, capsys: Streams) -> None:
    silent, unreadable = str(place.folder / "quiet.wav"), place.folder / "text.wav"
    missing = [str(place.folder / "missing.wav"), str(place.folder)]
    soundfile.write(silent, np.zeros(SAMPLES), RATE)
    unreadable.write_text("no sound")
    hit = place.wav("beside.wav", place.blow(STRUCK))
    assert main(["locate", place.field, silent, str(unreadable), *missing, hit, "--json"]) == 2
    out, err = capsys.readouterr()
    printed = json.loads(out)
    assert [blow["recording"] for blow in printed["impacts"]] == [silent, hit]
    assert [blow["status"] for blow in printed["impacts"]] == ["not located", "located"]
    assert [each["recording"] for each in printed["failures"]] == [str(unreadable), *missing]
    assert "text.wav" in err


def test_a_captures_settings_say_how_recordings_are_read(place: Place, tmp_path: Path, capsys: Streams) -> None:
    blow = place.blow(STRUCK)
    noise = torch.randn(len(blow), generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    path = place.folder / "stereo.wav"
    soundfile.write(path, torch.stack([0.1 * noise, blow / blow.abs().max()], dim=1).numpy(), RATE, subtype="FLOAT")
    assert run_verb("locate", place.field, str(path)) == 2
    assert "response_channel" in capsys.readouterr().out
    (tmp_path / "capture.toml").write_text("response_channel = 2\n")
    printed, _ = located([place.field, str(path), "--settings", str(tmp_path / "capture.toml")], capsys)
    assert printed["impacts"][0]["position"] == pytest.approx(place.points[STRUCK].tolist(), abs=0.01)


def test_several_blows_are_read_as_one_is(place: Place, tmp_path: Path, capsys: Streams) -> None:
    hit = place.wav("mono.wav", place.blow(STRUCK))
    (tmp_path / "capture.toml").write_text("response_channel = 2\n")
    for words in ([], ["--several"]):
        printed, _ = located([place.field, hit, "--settings", str(tmp_path / "capture.toml"), *words], capsys)
        assert printed["impacts"][0]["position"] == pytest.approx(place.points[STRUCK].tolist(), abs=0.01)


def test_what_cannot_be_done_is_said_in_one_line(place: Place, tmp_path: Path, capsys: Streams) -> None:
    hit = place.wav("again.wav", place.blow(STRUCK))
    (tmp_path / "file").write_text("")
    wrong = {
        (place.field,): ("recording",),
        (place.field, str(tmp_path / "nowhere.wav")): ("nowhere.wav", "a recording"),
        (place.field, str(tmp_path)): (str(tmp_path), "a folder"),
        (place.field, hit, "--probability", "1.5"): ("--probability", "1.5"),
        (place.field, hit, "--output", str(tmp_path / "file")): (str(tmp_path / "file"), "a file"),
        (place.field, hit, "--settings", str(tmp_path / "nowhere")): ("nowhere", "a capture.toml"),
        (hit, hit): ("again.wav", "a sound field"),
    }
    for words, parts in wrong.items():
        assert main(["locate", *words]) == 2
        err = capsys.readouterr().err
        assert all(part in err for part in parts), err
