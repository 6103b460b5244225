"""Scores that are reported with a field do not depend on the times at which single recordings start."""

import pytest

from avmsf.capture.impacts import Impacts
from avmsf.cli.report import compare
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.modal.extraction.extract import extract_modes
from factories.delayed_plate import ALIGNED, delays, strikes, without_delays

COUNT, TRAIN = 16, 12


def errors_of(impacts: Impacts) -> dict[str, list[float]]:
    """Return each method's relative STFT errors at the last contacts; all but the floor know the first alone."""
    train, test = impacts.take(range(TRAIN)), impacts.take(range(TRAIN, COUNT))
    modes, features = extract_modes(train), FeatureField.from_contacts(impacts.contacts)
    field = fit(train, features, modes, FitConfig(steps=0, residual=False), gains=MixtureEstimator(("thin-plate",)))
    scores = compare(field, train, test, modes)
    return {method: each.values["relative_stft"].tolist() for method, each in scores.items()}


def test_errors_do_not_depend_on_delays() -> None:
    starts = delays(COUNT)
    delayed = strikes(COUNT, starts=starts)
    same = without_delays(delayed, extract_modes(delayed.take(range(TRAIN))), starts)
    found, expected = errors_of(delayed), errors_of(same)
    for method, errors in expected.items():
        assert found[method] == pytest.approx(errors, rel=ALIGNED, abs=ALIGNED), method
