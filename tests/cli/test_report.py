"""What is said of a field: its body, its quality, outliers, and the scores of the baselines next to it."""

import math
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from avmsf.cli.report import compare
from avmsf.errors import EvaluationError, FieldFileError
from avmsf.evaluation.scores import Scores, evaluate
from avmsf.evaluation.simple_methods import MeanWaveform
from avmsf.evaluation.splits import split
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import save
from avmsf.modal.extraction.extract import extract_modes
from avmsf.modal.residual_noise import Residual
from factories.made_fields import BANK, positional
from factories.raising import raises
from oracles.plate import Plate, sample_contacts, strike


def field_with(report: dict[str, object]) -> SoundField:
    zero = torch.zeros(len(BANK), dtype=torch.float64)
    return SoundField(BANK, positional(), zero, Residual(torch.full((9,), 1e-3)), 8000.0, 400, Origin(report=report))


def body_report(*, wall: float | None, ratio: float, searched: bool = False) -> dict[str, object]:
    """A report whose most probable body has this wall, meters, and this ratio of stiffness to density over aluminum's.

    Frequencies of one shape scale with the square root of the ratio.
    """
    body = {"body": "shape", "wall_thickness": wall, "frequency_factor": math.sqrt(ratio), "support": "free"}
    credibility = {"credible": True, "with_body": 2.5, "without_body": 0.75}
    thickness = {"median": 0.0013, "low": 0.0009, "high": 0.0018} if searched else None
    return {"bodies": [body], "credibility": credibility, "thickness": thickness}


def test_a_body_stiffer_than_every_material_warns_and_a_plausible_one_does_not() -> None:
    # Ceramic has 1.03 times aluminum's ratio. Beyond it 5 % of frequency are allowed for, and 20 % of thickness: a
    # jug's of 1.15 has the truth within its interval.
    for wall, searched in ((0.0013, True), (0.0035, False), (None, False)):
        for ratio in (3.67, 1.7, 1.5, 1.03, 0.1):
            field = field_with(body_report(wall=wall, ratio=ratio, searched=searched))
            assert field.body is not None
            assert bool(field.body.warning) is (ratio > 1.6)
            assert field.body.record()["warning"] == (field.body.warning or None)
            assert field.body.warning in repr(field)


def test_a_body_that_is_not_credible_or_edited_is_not_named() -> None:
    report = body_report(wall=None, ratio=9.0)
    assert field_with(report | {"credibility": {"credible": False}}).body is None
    assert field_with(report | {"edits": [{"edit": "x"}]}).body is None


@pytest.mark.parametrize(
    "damage", [{"bodies": []}, {"bodies": [3]}, {"bodies": {}}, {"thickness": 3}, {"thickness": {"a": 1}}]
)
def test_a_damaged_report_of_a_body_is_refused(tmp_path: Path, damage: dict[str, object]) -> None:
    with pytest.raises(FieldFileError):
        save(field_with(body_report(wall=0.0013, ratio=1.0, searched=True) | damage), tmp_path / "jug.safetensors")


@pytest.mark.parametrize("directed", [True, False])
def test_neighbors_by_direction_are_scored_where_directions_are_known(directed: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    plate = Plate(alpha=40.0)
    contacts = sample_contacts(plate, 10, generator=generator)
    straight = strike(plate, contacts, sample_rate=8000.0, seconds=0.1, generator=generator, highest=2500.0)
    # Every other impact comes from behind, and its sound is the negated one.
    signs = torch.tensor([1.0, -1.0]).repeat(5)[:, None]
    directions = torch.tensor([0.0, 0.0, -1.0]) * signs
    impacts = replace(straight, sounds=signs * straight.sounds, directions=directions if directed else None)
    train, test = split(impacts, 7)
    modes, features = extract_modes(train), FeatureField.from_contacts(contacts)
    field = fit(train, features, modes, FitConfig(steps=0), gains=MixtureEstimator(("thin-plate",)))
    scores = compare(field, train, test, modes)
    by_direction = scores.get("mean waveform of 3 nearest, by direction")
    assert (by_direction is not None) == directed
    if by_direction is not None:
        alike_train, alike_test = split(straight, 7)
        alike = evaluate(MeanWaveform(alike_train), alike_test).mean()
        assert by_direction.mean() == pytest.approx(alike, rel=1e-5)
        assert scores["mean waveform of 3 nearest"].mean() != pytest.approx(alike, rel=0.1)


def test_scores_are_a_data_frame_where_pandas_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    scores = Scores(("a.wav", "b.wav"), {"l1": torch.tensor([1.0, 2.0]), "envelope": torch.tensor([3.0, 4.0])})
    monkeypatch.setitem(sys.modules, "pandas", None)
    with raises(EvaluationError, name="pandas"):
        scores.to_frame()
    stand_in = SimpleNamespace(DataFrame=lambda columns, index: (columns, index))
    monkeypatch.setitem(sys.modules, "pandas", stand_in)
    columns, index = scores.to_frame()
    assert index == ["a.wav", "b.wav"]
    assert {name: each.tolist() for name, each in columns.items()} == {"l1": [1.0, 2.0], "envelope": [3.0, 4.0]}
