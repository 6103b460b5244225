"""What is said of a field: its body, its quality, outliers, and the scores of the baselines next to it."""

from pathlib import Path

import pytest
import torch

from avmsf.cli.output import display
from avmsf.cli.report import field_lines, outlier_words, quality_words
from avmsf.field.sound_field import Origin, SoundField
from avmsf.modal.residual_noise import Residual
from factories.made_fields import BANK, positional

FOUND = {"positions": 9, "error": 0.3, "nearest_mean": 0.7, "next_contact": [0.02, -0.01, 0.08], "next_distance": 0.041}


def field_with(report: dict[str, object]) -> SoundField:
    zero = torch.zeros(len(BANK), dtype=torch.float64)
    return SoundField(BANK, positional(), zero, Residual(torch.full((9,), 1e-3)), 8000.0, 400, Origin(report=report))


def test_a_field_without_a_verdict_gets_no_words_and_one_with_advice_names_the_command() -> None:
    for report in ({}, {"quality": FOUND, "edits": [{"edit": "x"}]}):
        assert quality_words(field_with(report), Path("f")) == []
    assert "avmsf suggest f" in quality_words(field_with({"quality": FOUND}), Path("f"))[0]


def test_the_body_is_named_with_the_ratio_of_stiffness_to_density_and_what_it_explains() -> None:
    # Frequencies are half of aluminum's: a quarter of its 26 MJ/kg.
    body = {"body": "shape", "wall_thickness": None, "frequency_factor": 0.5, "support": "free"}
    report = {"bodies": [body], "credibility": {"credible": True, "with_body": 2.5, "without_body": 0.75}}
    lines = field_lines(field_with(report), Path("f"), settings=False)
    (line,) = [each for each in lines if each.split()[0] == "body"]
    assert "6.5 MJ/kg" in line
    assert "1.8 per mode" in line


def test_an_outlier_says_what_was_done_and_has_figures_only_for_verbose(monkeypatch: pytest.MonkeyPatch) -> None:
    figures = {"place": [0.046, -0.003, 0.1], "ratio": -1.9, "place_ratio": 1.6, "distance": 0.0086, "reversed": False}
    report: dict[str, object] = {
        "outliers": {"a.wav": "a.wav contradicts", "b.wav": "b.wav contradicts"},
        "outlier_figures": {"a.wav": figures},
        "excluded": ["a.wav"],
    }
    left_out, used = outlier_words(field_with(report))
    assert (left_out.split()[0], used.split()[0], "1.9" in left_out) == ("left", "used", False)
    monkeypatch.setattr(display, "verbose", True)
    left_out, used = outlier_words(field_with(report))
    assert "-1.9" in left_out
    assert "(0.046, -0.003, 0.1) m" in left_out
    assert used.endswith("contradicts")
