"""Baselines that are scored next to a field."""

from dataclasses import replace

import pytest
import torch

from avmsf.cli.report import compare
from avmsf.evaluation.scores import evaluate
from avmsf.evaluation.simple_methods import MeanWaveform
from avmsf.evaluation.splits import split
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.modal.extraction.extract import extract_modes
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
