"""The verdict on a field in a file names the command that lists more contacts."""

import json
import math
from pathlib import Path

import pytest
import torch

from avmsf.cli import main
from avmsf.cli.output import display
from avmsf.cli.report import field_lines, outlier_words, quality_words
from avmsf.errors import FieldFileError
from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import save
from avmsf.modal.residual_noise import Residual
from factories.made_fields import BANK, positional

FOUND = {"positions": 9, "error": 0.3, "nearest_mean": 0.7, "next_contact": [0.02, -0.01, 0.08], "next_distance": 0.041}


def field_with(report: dict[str, object]) -> SoundField:
    zero = torch.zeros(len(BANK), dtype=torch.float64)
    return SoundField(BANK, positional(), zero, Residual(torch.full((9,), 1e-3)), 8000.0, 400, Origin(report=report))


def test_an_edited_field_and_one_of_few_places_get_no_words() -> None:
    assert quality_words(field_with({}), Path("f")) == []
    assert quality_words(field_with({"quality": FOUND, "edits": [{"edit": "x"}]}), Path("f")) == []


def test_the_body_is_named_with_the_ratio_of_stiffness_to_density_and_what_it_explains() -> None:
    # Frequencies of one shape scale with the square root of the ratio: half of aluminum's is a quarter of it.
    body = {"body": "solid", "wall_thickness": None, "frequency_factor": 0.5}
    credibility = {"credible": True, "with_body": 2.5, "without_body": 0.75}
    field = field_with({"gain_model": "mixture", "bodies": [body], "credibility": credibility})
    (line,) = [each for each in field_lines(field, Path("f"), settings=False) if each.split()[0] == "body"]
    assert "6.5 MJ/kg" in line
    assert "1.8 per mode" in line


def body_report(*, wall: float | None, ratio: float, searched: bool) -> dict[str, object]:
    """A report whose most probable body has this wall, meters, and this ratio over aluminum."""
    body = {"body": "shape", "wall_thickness": wall, "frequency_factor": math.sqrt(ratio), "support": "free"}
    credibility = {"credible": True, "with_body": 2.5, "without_body": 0.75}
    thickness = {"median": 0.0013, "low": 0.0009, "high": 0.0018} if searched else None
    return {"bodies": [body], "credibility": credibility, "thickness": thickness}


def test_a_body_stiffer_than_every_material_warns_and_a_plausible_one_does_not() -> None:
    # Ceramic has 1.03 times aluminum's ratio. Beyond it 5 % of frequency are allowed for, and of a wall that was
    # searched for the 20 % of thickness that its interval has: a jug's of 1.15 has the truth within its interval.
    for wall, searched, warned, silent in (
        (0.0013, True, (3.67, 2.41), (1.15, 1.03)),
        (0.0035, False, (1.2,), (1.1, 0.1)),
        (None, False, (1.2,), (1.1, 0.1)),
    ):
        for ratio in (*warned, *silent):
            field = field_with(body_report(wall=wall, ratio=ratio, searched=searched))
            assert field.body is not None
            assert bool(field.body.warning) is (ratio in warned)
            assert field.body.record()["warning"] == (field.body.warning or None)
            assert field.body.warning in repr(field)


def test_a_body_that_is_not_credible_or_edited_is_not_named() -> None:
    report = body_report(wall=None, ratio=9.0, searched=False)
    assert field_with(report | {"credibility": {"credible": False}}).body is None
    assert field_with(report | {"edits": [{"edit": "x"}]}).body is None


def test_info_shows_the_body_and_its_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "jug.safetensors"
    save(field_with(body_report(wall=0.0013, ratio=3.67, searched=True)), path)
    assert main(["info", str(path), "--json"]) == 0
    told = capsys.readouterr()
    body = json.loads(told.out)["body"]
    assert body["wall_thickness"] == pytest.approx(0.0013)
    assert body["wall_interval"] == [0.0009, 0.0018]
    assert body["stiffness_ratio"] == pytest.approx(3.67)
    assert body["warning"] in told.err
    assert "0.9 to 1.8 mm" in told.err
    assert "95 MJ/kg" in told.err


@pytest.mark.parametrize(
    "damage", [{"bodies": []}, {"bodies": [3]}, {"bodies": {}}, {"thickness": 3}, {"thickness": {"a": 1}}]
)
def test_a_damaged_report_of_a_body_is_refused(tmp_path: Path, damage: dict[str, object]) -> None:
    report = body_report(wall=0.0013, ratio=1.0, searched=True)
    with pytest.raises(FieldFileError):
        save(field_with(report | damage), tmp_path / "jug.safetensors")


def test_an_outlier_says_first_what_was_done_and_has_figures_only_for_verbose(monkeypatch: pytest.MonkeyPatch) -> None:
    figures = {"place": [0.046, -0.003, 0.1], "ratio": -1.9, "place_ratio": 1.6, "distance": 0.0086, "reversed": False}
    report: dict[str, object] = {
        "outliers": {"a.wav": "a.wav contradicts", "b.wav": "b.wav contradicts"},
        "outlier_figures": {"a.wav": figures},
        "excluded": ["a.wav"],
    }
    left_out, used = outlier_words(field_with(report))
    assert left_out.startswith("left out")
    assert used.startswith("used")
    assert "1.9" not in left_out
    monkeypatch.setattr(display, "verbose", True)
    left_out, used = outlier_words(field_with(report))
    assert "-1.9" in left_out
    assert "(0.046, -0.003, 0.1) m" in left_out
    assert used.endswith("contradicts")
