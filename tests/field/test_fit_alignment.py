"""Fields do not depend on the times at which single recordings start."""

from dataclasses import replace

import pytest
import torch

from avmsf.capture.impacts import Impacts
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.data import gain_data
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.modal.extraction.extract import Extraction, extract_modes
from factories.delayed_plate import ALIGNED, delays, distance, strikes, without_delays

COUNT = 12
FEATURES = FeatureField.from_contacts(strikes(COUNT).contacts)
CONFIG = FitConfig(steps=0, damping="shared")


@pytest.fixture(scope="module")
def delayed() -> tuple[Impacts, Extraction]:
    train = strikes(COUNT, starts=delays(COUNT))
    return train, extract_modes(train)


@pytest.fixture(scope="module")
def exact(delayed: tuple[Impacts, Extraction]) -> tuple[Impacts, Extraction]:
    train = without_delays(*delayed, delays(COUNT))
    return train, extract_modes(train)


def test_gains_to_spread_do_not_depend_on_delays(
    delayed: tuple[Impacts, Extraction], exact: tuple[Impacts, Extraction]
) -> None:
    cases = [gain_data(train, FEATURES, modes, CONFIG) for train, modes in (delayed, exact)]
    assert distance(*(each.train.sounds for each in cases)) < ALIGNED
    assert distance(*(each.gains for each in cases)) < ALIGNED


def test_a_field_and_the_gains_it_is_checked_by_do_not_depend_on_delays(
    delayed: tuple[Impacts, Extraction], exact: tuple[Impacts, Extraction]
) -> None:
    fields = [fit(train, FEATURES, modes, CONFIG) for train, modes in (delayed, exact)]
    known = [each.gain_field for each in fields]
    assert all(isinstance(each, MixtureGains) for each in known)
    assert distance(*(each.gains(delayed[0].contacts) for each in fields)) < ALIGNED
    # Between the contacts other hypotheses may be the more probable ones, which differ by less than is known.
    apart = fields[0].gains(FEATURES.points) - fields[1].gains(FEATURES.points)
    assert bool((apart.abs() < known[0].posterior(FEATURES.points).std[..., 0]).all())
    assert distance(*(torch.view_as_real(each.measured).flatten(1) for each in known)) < ALIGNED


def test_recordings_in_double_precision_are_recognized_by_their_alignment(delayed: tuple[Impacts, Extraction]) -> None:
    train = delayed[0]
    assert train.before is not None
    assert train.after is not None
    double = replace(train, sounds=train.sounds.double(), before=train.before.double(), after=train.after.double())
    modes = extract_modes(double)
    assert modes.alignment is not None
    aligned = double.delayed(modes.alignment.delays).sounds.float()
    assert torch.equal(gain_data(double, FEATURES, modes, CONFIG).train.sounds, aligned)


def test_aligned_recordings_are_not_delayed_again(delayed: tuple[Impacts, Extraction]) -> None:
    train, modes = delayed
    aligned = modes.aligned(train)
    assert torch.equal(gain_data(aligned, FEATURES, modes, CONFIG).train.sounds, aligned.sounds)
