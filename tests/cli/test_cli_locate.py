"""`avmsf locate`: text, JSON, heat maps and clouds; recordings without an impact on the object; true contacts."""

import math
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch
from torch import Tensor

from avmsf.cli import main
from avmsf.cli.contacts import Contacts, rows_of
from avmsf.errors import AvmsfError
from avmsf.field.sound_field import Origin
from avmsf.field.store import save
from avmsf.localization.contact_map import ContactPosterior
from avmsf.localization.locator import Locator
from avmsf.modal.modes import ModalBank, synthesize
from factories.made_fields import BANK, positional, sounding
from factories.raising import raises
from factories.verbs import Streams, results_of, run_verb

RATE, SAMPLES = 8000, 4000
STRUCK, SECOND_PLACE = 68, 102


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

    def impact(self, row: int, *, before: float = 0.1, bank: ModalBank = BANK, rate: int = RATE) -> Tensor:
        """Return an impact in faint noise, with some quiet before it."""
        gains = self.gains[row][None].to(torch.complex128)
        samples = SAMPLES * rate // RATE
        sound = synthesize(gains, bank.frequency, bank.damping, samples=samples, sample_rate=float(rate))[0]
        whole = torch.cat([torch.zeros(round(before * rate), dtype=torch.float64), sound])
        noise = torch.randn(len(whole), generator=torch.Generator().manual_seed(row), dtype=torch.float64)
        return whole + 1e-4 * sound.abs().max() * noise

    def two(self, name: str) -> str:
        first, second = self.impact(STRUCK), self.impact(SECOND_PLACE, before=0.4)
        return self.wav(name, torch.cat([first, torch.zeros(len(second) - len(first), dtype=torch.float64)]) + second)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    folder, origin = tmp_path_factory.mktemp("place"), Origin("plate", trained_on=("fitted.wav",))
    field = sounding(positional(), noise=1e-3, samples=SAMPLES, origin=origin)
    save(field, folder / "plate.safetensors")
    locator = Locator.of(field)
    return Place(folder, str(folder / "plate.safetensors"), locator.points, locator.gains)


@pytest.fixture
def hit(place: Place) -> str:
    return place.wav("hit.wav", -place.impact(STRUCK))


def located(place: Place, capsys: Streams, *words: str, code: int = 0) -> tuple[dict[str, Any], str]:
    return results_of(capsys, "locate", place.field, *words, code=code)


def test_an_impact_is_found_drawn_and_told(place: Place, hit: str, tmp_path: Path, capsys: Streams) -> None:
    printed, _ = located(place, capsys, hit, "--output", str(tmp_path / "maps"))
    (impact,) = printed["impacts"]
    assert impact["position"] == pytest.approx(place.points[STRUCK].tolist(), abs=1e-6)
    assert impact["recording"] == hit
    assert impact["explained_energy"] > 0.98
    assert impact["mismatch_ratio"] < 0.01
    # The field's own contacts, left out, are badly predicted by the others: the region is as wide as that makes it.
    assert 0.0 < impact["credible_region"]["surface_fraction"] < 0.7
    assert (tmp_path / "maps" / "hit.png").read_bytes().startswith(b"\x89PNG")
    others = (located(place, capsys, hit, "--probability", level)[0]["impacts"][0] for level in ("0.5", "0.999"))
    low, middle, high = (each["credible_region"] for each in (next(others), impact, next(others)))
    assert low["surface_fraction"] < middle["surface_fraction"] < high["surface_fraction"]
    assert low["radius"] < high["radius"]


@pytest.mark.slow
def test_several_impacts_are_told_apart_and_no_picture_is_anothers(place, tmp_path, capsys):
    words = [place.two("twin.wav"), place.wav("twin-2.wav", place.impact(STRUCK)), "--several"]
    found = located(place, capsys, *words, "--output", str(tmp_path))[0]["impacts"]
    assert [impact["seconds"] for impact in found] == pytest.approx([0.1, 0.4, 0.1], abs=0.002)
    for impact, row in zip(found, (STRUCK, SECOND_PLACE, STRUCK), strict=True):
        assert impact["position"] == pytest.approx(place.points[row].tolist(), abs=0.01)
    assert [Path(impact["picture"]).stem for impact in found] == ["twin", "twin-2", "twin-2-2"]
    assert len(list(tmp_path.iterdir())) == 3


def test_recordings_without_an_impact_on_the_object_have_no_place(place, tmp_path, capsys):
    silent = str(place.folder / "silent.wav")
    soundfile.write(silent, np.zeros(SAMPLES), RATE)
    noise = torch.randn(SAMPLES, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    other = place.wav("other.wav", place.impact(STRUCK, bank=ModalBank(BANK.frequency * 1.27 + 40.0, BANK.damping)))
    cases = {silent: "silence", place.wav("noise.wav", noise): " dB", other: "a mismatch ratio of"}
    printed, _ = located(place, capsys, *cases, "--output", str(tmp_path), code=2)
    for values, reason in zip(printed["impacts"], cases.values(), strict=True):
        assert (values["status"], values["position"]) == ("not located", None)
        assert reason in values["reason"]
    assert not list(tmp_path.iterdir())


def test_one_bad_recording_does_not_cost_the_others(place: Place, hit: str, capsys: Streams) -> None:
    unreadable, missing = place.folder / "text.wav", [str(place.folder / "missing.wav"), str(place.folder)]
    unreadable.write_text("no sound")
    printed, _ = located(place, capsys, str(unreadable), *missing, hit, code=2)
    assert [(impact["recording"], impact["status"]) for impact in printed["impacts"]] == [(hit, "located")]
    assert [each["recording"] for each in printed["failures"]] == [str(unreadable), *missing]


@pytest.mark.parametrize("several", [(), ("--several",)])
def test_a_captures_settings_say_how_recordings_are_read(several, place, hit, tmp_path, capsys):
    impact = place.impact(STRUCK)
    noise = torch.randn(len(impact), generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    path = str(place.folder / "stereo.wav")
    soundfile.write(path, torch.stack([0.1 * noise, impact / impact.abs().max()], dim=1).numpy(), RATE, subtype="FLOAT")
    assert "response_channel" in located(place, capsys, path, *several, code=2)[1]
    (tmp_path / "capture.toml").write_text("response_channel = 2\n")
    for recording in (path, hit):
        printed, _ = located(place, capsys, recording, "--settings", str(tmp_path / "capture.toml"), *several)
        assert printed["impacts"][0]["position"] == pytest.approx(place.points[STRUCK].tolist(), abs=0.01)


def test_the_error_is_the_distance_from_the_true_contact(place: Place, hit: str, capsys: Streams) -> None:
    points = place.points.double()
    true = [f"{value:.9g}" for value in points[SECOND_PLACE].tolist()]
    results, _ = located(place, capsys, hit, "--true-contact", *true)
    assert results["summary"] is None
    (impact,) = results["impacts"]
    distance = float((points[STRUCK] - points[SECOND_PLACE]).norm())
    relative = distance / float((points.amax(0) - points.amin(0)).norm())
    assert impact["true_contact"] == pytest.approx(points[SECOND_PLACE].tolist(), abs=1e-6)
    errors = {"error": distance, "rmed_posterior": relative, "rmed": relative, "in_region": False, "training": False}
    assert {name: impact[name] for name in errors} == pytest.approx(errors, abs=1e-6)


def test_a_table_gives_each_recording_its_contact_and_the_summary_is_over_those_not_trained_on(
    place, hit, tmp_path, capsys, monkeypatch
):
    points, names = place.points.double(), ("fitted.wav", "a/hit.wav", "b/hit.wav", "other.flac")
    sound = soundfile.read(hit)[0]
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        soundfile.write(tmp_path / name, sound, RATE)
    # The first is a recording of the field's capture, and comes last; a row may have an absolute path, one has none.
    (tmp_path / "capture.toml").write_text('name = "plate"')
    fitted = positional().contacts[0].double()
    rows = ("b/hit.wav", points[SECOND_PLACE]), (tmp_path / "a" / "hit.wav", points[STRUCK]), ("fitted.wav", fitted)
    table = tmp_path / "impacts.csv"
    lines = [",".join([str(name), *(f"{1000 * value:.9g}" for value in where.tolist())]) for name, where in rows]
    table.write_text("\n".join(["file,x,y,z", *lines]))
    paths = [str(tmp_path / name) for name in names]
    results, _ = located(place, capsys, *paths, "--true-contact-table", str(table), "--unit", "mm")
    first, second, third, fourth = results["impacts"]
    distance = float((points[STRUCK] - points[SECOND_PLACE]).norm())
    assert (first["error"], second["error"]) == pytest.approx((0.0, distance), abs=1e-6)
    assert (first["in_region"], second["in_region"]) == (True, False)
    assert [each.get("training") for each in (first, second, third, fourth)] == [False, False, None, True]
    relative = 0.5 * distance / float((points.amax(0) - points.amin(0)).norm())
    wanted = {"impacts": 2, "training": 1, "median_error": 0.5 * distance, "in_region": 0.5}
    wanted |= {"rmed": relative, "rmed_posterior": relative}
    assert results["summary"] == pytest.approx(wanted, abs=1e-6)
    # The package's attribute of this name is the function.
    locate = import_module("avmsf.localization.locate")
    find, calls = locate.locate, list[Any]()

    def interrupted(*given: Any, **named: Any) -> ContactPosterior:
        calls.append(given)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return find(*given, **named)

    with monkeypatch.context() as patched:
        patched.setattr(locate, "locate", interrupted)
        assert main(["locate", place.field, *paths, "--true-contact-table", str(table), "--unit", "mm"]) == 130
    assert "2 located impacts of known contacts: median distance" in capsys.readouterr().out
    # A recording of the same name, at the same contact, is another one where it is of another capture.
    (tmp_path / "capture.toml").write_text('name = "other plate"')
    results, _ = located(place, capsys, paths[0], "--true-contact", *map(str, fitted.tolist()))
    assert results["impacts"][0]["training"] is False
    # Settings that cannot be read keep no recording from being located; the folder's name is another too.
    (tmp_path / "capture.toml").write_text("name = ")
    results, _ = located(place, capsys, paths[0], "--true-contact", *map(str, fitted.tolist()))
    assert results["impacts"][0]["training"] is False


@pytest.mark.parametrize(
    ("names", "recording", "rows"),
    [
        (("hit.wav",), "a/hit.wav", [0]),
        (("hit.wav", "a/hit.wav"), "a/hit.wav", [1]),
        (("a/hit.wav", "x/a/hit.wav", "y/a/hit.wav"), "/x/a/hit.wav", [1]),
        (("a/hit.wav", "b/hit.wav"), "c/hit.wav", [0, 1]),
        (("other.wav", "a/hit.flac"), "a/hit.wav", []),
    ],
)
def test_a_recording_has_the_row_with_most_of_its_path(names: tuple[str, ...], recording: str, rows: list[int]) -> None:
    contacts = Contacts(torch.zeros(len(names), 3, dtype=torch.float64), names)
    assert rows_of(contacts, Path(recording)) == rows


WRONG: dict[str, dict[str, Any]] = {
    "nowhere.wav": {"file": "nowhere.wav"},
    "FOLDER": {"value": "a folder"},
    "HIT --probability 1.5": {"name": "--probability", "value": 1.5},
    "HIT --output FOLDER/file": {"value": "file"},
    "HIT --settings FOLDER/nowhere": {"file": "nowhere"},
    "HIT --force 0": {"name": "force.expected", "value": 0.0},
    "HIT --true-contact 120 40 0": {"name": "--true-contact", "row": 0},
    f"HIT --true-contact {math.nan} 0 0": {"name": "--true-contact", "row": 0},
    "HIT --true-contact 0 0 0 --true-contact-table FOLDER/file": {"name": "--true-contact"},
    "HIT --true-contact-table FOLDER/far.csv": {"file": "far.csv", "row": 2},
}


@pytest.mark.parametrize("words", WRONG)
def test_what_cannot_be_done_is_refused(words: str, place: Place, hit: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("file,x,y,z\na.wav,0,0,0\n")
    (tmp_path / "far.csv").write_text("file,x,y,z\nhit.wav,120,40,0\n")
    with raises(AvmsfError, **WRONG[words]):
        run_verb("locate", place.field, *words.replace("HIT", hit).replace("FOLDER", str(tmp_path)).split())
