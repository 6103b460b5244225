"""Scores of a field are taken where the training recordings start."""

from dataclasses import replace

import pytest
import torch

from avmsf.bench.evaluation import split
from avmsf.capture.impacts import Impacts
from avmsf.cli.scores import compare
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.modal.extraction.extract import extract
from avmsf.scene.features import FeatureField
from avmsf.simulate.plate import Plate, sample_contacts, strike

MARGIN = 64


def shaken(impacts: Impacts, deviation: float) -> Impacts:
    """Return recordings read at starts that are off by a normal number of samples, with what lies around them."""
    delays = deviation * torch.randn(len(impacts), dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    quiet = torch.zeros(len(impacts), 4 * MARGIN)
    whole = replace(impacts, before=quiet, after=quiet).delayed(delays - MARGIN).sounds
    return replace(
        impacts,
        sounds=whole[:, MARGIN:-MARGIN].contiguous(),
        before=whole[:, :MARGIN].contiguous(),
        after=whole[:, -MARGIN:].contiguous(),
    )


def test_jitter_of_the_starts_does_not_count() -> None:
    generator = torch.Generator().manual_seed(0)
    plate = Plate(alpha=40.0)
    contacts = sample_contacts(plate, 20, generator=generator)
    exact = strike(
        plate, contacts, sample_rate=8000.0, seconds=0.5, generator=generator, noise_db=-50.0, highest=2500.0
    )
    errors = {}
    for deviation in (0.0, 3.0):
        train, test = split(shaken(exact, deviation), count=14)
        modes = extract(train)
        features = FeatureField.from_contacts(exact.contacts)
        field = fit(train, features, modes, FitConfig(steps=0), gains=MixtureEstimator(("thin-plate",)))
        scores = compare(field, train, test, modes)
        errors[deviation] = {name: each.mean()["relative_stft"] for name, each in scores.items()}
    for name in ("field", "mean waveform of 3 nearest"):
        assert errors[3.0][name] == pytest.approx(errors[0.0][name], rel=0.04), name
