"""Settings of a fit: what is refused, and what they mean at a sample rate."""

import math
from itertools import product

import pytest

from avmsf.errors import FitError
from avmsf.field.config import PAPER, FitConfig
from factories.raising import raises


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *product(["clusters", "width", "hidden", "early", "interleave"], [0, -1]),
        *product(["bands", "layers", "steps", "warmup_steps", "patience", "hop", "seed"], [-1]),
        *product(["correction_rate", "weight_decay", "early_weight"], [-0.1, math.inf, math.nan]),
        *product(["feature_scale", "warmup_rate", "learning_rate"], [0.0, -1.0, math.inf, math.nan]),
        *product(["validation"], [-0.1, 0.6, math.nan]),
        *product(["fft_sizes"], [(), (1024, 0), (1023,), (1020,)]),
    ],
)
def test_settings_that_no_fit_can_run_with_are_refused_by_name(name, value):
    with raises(FitError, name=name) as caught:
        FitConfig(**{name: value})
    assert caught.value.value is value


def test_a_fit_of_no_steps_is_refused():
    with raises(FitError, name="steps", value=0):
        FitConfig(warmup_steps=0, steps=0)


def test_resolutions_follow_the_sample_rate():
    config = FitConfig(fft_sizes=(2048, 256), early=8192)
    assert config.resolutions(44100.0) == config.resolutions(48000.0) == ((2048, 256), (512, 64), 8192)
    assert config.resolutions(96000.0) == ((4096, 512), (1024, 128), 16384)
    # A structure at 400 Hz: a quarter, and even, as the transform needs it.
    assert config.resolutions(400.0) == ((512, 64), (128, 16), 2048)
    assert PAPER.resolutions(48000.0)[1] == (64, 64, 64, 64)
    assert PAPER.interleave == 1, "the paper compares all frames at every step"
    assert FitConfig(fft_sizes=(24,)).resolutions(400.0)[0] == (6,)


def test_the_network_has_the_configs_sizes():
    shape = FitConfig(clusters=3, bands=2, width=5, hidden=6, layers=1, feature_scale=0.5).shape
    assert (shape.clusters, shape.bands, shape.width, shape.hidden, shape.layers) == (3, 2, 5, 6, 1)
    assert shape.feature_scale == 0.5
    assert shape.spatial_damping is False
