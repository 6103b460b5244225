"""Baselines that are scored next to a field."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from avmsf.cli.report import compare
from avmsf.errors import EvaluationError
from avmsf.evaluation.scores import Scores, evaluate
from avmsf.evaluation.simple_methods import MeanWaveform
from avmsf.evaluation.splits import split
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.modal.extraction.extract import extract_modes
from factories.raising import raises
from oracles.plate import Plate, sample_contacts, strike


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
    modes = extract_modes(train)
    field = fit(
        train, FeatureField.from_contacts(contacts), modes, FitConfig(steps=0), gains=MixtureEstimator(("thin-plate",))
    )
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
