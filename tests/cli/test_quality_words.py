"""The verdict on a field in a file names the command that lists more contacts."""

import shlex
from pathlib import Path

import torch

from avmsf.cli.fit import summary
from avmsf.cli.options import suggest
from avmsf.cli.scores import quality_words
from avmsf.field.soundfield import Origin, SoundField
from avmsf.modal.residual import Residual
from made_fields import BANK, positional

FOUND = {"positions": 9, "error": 0.3, "nearest_mean": 0.7, "next_contact": [0.02, -0.01, 0.08], "next_distance": 0.041}


def field_with(report: dict[str, object]) -> SoundField:
    zero = torch.zeros(len(BANK), dtype=torch.float64)
    return SoundField(BANK, positional(), zero, Residual(torch.full((9,), 1e-3)), 8000.0, 400, Origin(report=report))


def test_the_command_can_be_given_as_it_stands(tmp_path: Path) -> None:
    path = tmp_path / "my bowl.safetensors"
    (words,) = quality_words(field_with({"quality": FOUND}), path)
    assert "41 mm" in words
    program, verb, *arguments = shlex.split(words[words.index("avmsf suggest") :])
    assert (program, verb) == ("avmsf", "suggest")
    assert suggest.parse(arguments).field == path


def test_without_a_contact_no_command_is_named() -> None:
    found = {name: FOUND[name] for name in ("positions", "error", "nearest_mean")}
    (words,) = quality_words(field_with({"quality": found}), Path("f"))
    assert "suggest" not in words


def test_an_edited_or_unjudged_field_gets_no_words() -> None:
    assert quality_words(field_with({}), Path("f")) == []
    assert quality_words(field_with({"quality": FOUND, "edits": [{"edit": "x"}]}), Path("f")) == []


def test_the_summary_gives_the_ratio_of_stiffness_to_density() -> None:
    # Frequencies of one shape scale with the square root of the ratio: half of aluminum's is a quarter of it.
    body = {"body": "solid", "wall_thickness": None, "frequency_factor": 0.5}
    credibility = {"credible": True, "with_body": 2.5, "without_body": 0.75}
    words = summary(field_with({"gain_model": "mixture", "bodies": [body], "credibility": credibility}), 9)
    assert "0.25 times" in words
    assert "by 1.8 per mode" in words
