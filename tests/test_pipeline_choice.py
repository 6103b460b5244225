"""Features are chosen by what they foretell of training contacts, never of others."""

from dataclasses import replace

import torch

from avmsf.field.config import FitConfig
from avmsf.modal.extract import HighResolution, extract
from avmsf.pipeline.choice import choose_features
from avmsf.scene.features import FeatureField
from avmsf.simulate.plate import plate_surface_points, sample_contacts, strike
from plate_capture import CONTACT_TIME, HIGHEST, PLATE, RATE

CONFIG = FitConfig(clusters=8, width=16, hidden=64, layers=2, warmup_steps=150, steps=0, fft_sizes=(1024, 256))


def blows(count: int):
    generator = torch.Generator().manual_seed(3)
    contacts = sample_contacts(PLATE, count, generator=generator)
    options = {"sample_rate": RATE, "seconds": 0.5, "noise_db": -40.0, "highest": HIGHEST}
    return strike(PLATE, contacts, generator=generator, contact_time=CONTACT_TIME, **options)


def candidates() -> dict[str, FeatureField]:
    """Places in random order beside true ones: what is near in these features is anywhere on the plate."""
    true = FeatureField.from_points(plate_surface_points(PLATE, 2000))
    shuffled = true.features[torch.randperm(len(true.points), generator=torch.Generator().manual_seed(0))]
    return {"shuffled": replace(true, features=20 * shuffled), "true": true}


def test_features_that_tell_where_a_place_is_win_over_the_same_ones_shuffled() -> None:
    train = blows(12)
    choice = choose_features(train, extract(train, HighResolution(modes=10)), candidates(), CONFIG)
    assert choice.name == "true"
    assert choice.errors["true"] < 0.9 * choice.errors["shuffled"]


def test_with_too_few_contacts_nothing_is_decided() -> None:
    train = blows(3)
    choice = choose_features(train, extract(train, HighResolution(modes=10)), candidates(), CONFIG)
    assert (choice.name, choice.errors) == ("shuffled", {})
