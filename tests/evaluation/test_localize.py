"""Localization as an experiment of `avmsf evaluate`: errors of methods whose answer is known."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from avmsf.bench.baselines import NearestStrike, WhiteNoise
from avmsf.bench.locating import located
from avmsf.bench.locatingbaselines import random_distance
from avmsf.cli import main
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from plate_field import QUICK, plate_extraction, plate_features, plate_impacts
from plate_set import fill_plates


def test_the_nearest_recording_finds_itself_and_noise_counts_as_a_random_point() -> None:
    train, points = plate_impacts(), plate_features().points
    size = float((points.amax(0) - points.amin(0)).norm())
    assert located(NearestStrike(train), train, train, points) == {"rmed": (0.0,) * len(train)}
    expected = [random_distance(points.double(), place[None]) / size for place in train.contacts]
    assert located(WhiteNoise(train), train, train, points)["rmed"] == pytest.approx(expected)
    silent = replace(train, sounds=0 * train.sounds)
    assert located(NearestStrike(train), train, silent, points)["rmed"] == pytest.approx(expected)


def test_a_field_finds_where_its_own_sounds_come_from() -> None:
    train, features = plate_impacts(), plate_features()
    config = replace(QUICK, warmup_steps=0, steps=1, residual=False)
    field = fit(train, features, plate_extraction(train), config, gains=MixtureEstimator(("smooth",)))
    rows = torch.arange(0, 600, 60)
    sounds = field.render(features.points[rows])
    struck = replace(train.take(range(len(rows))), contacts=features.points[rows].to(train.contacts), sounds=sounds)
    found = located(field, train, struck, features.points)
    assert set(found) == {"rmed", "rmed_posterior"}
    assert max(found["rmed"]) < 0.02
    assert sorted(found["rmed_posterior"])[5] < 0.1


def test_the_experiment_is_a_command(tmp_path: Path) -> None:
    data, results = fill_plates(tmp_path / "plates", ("a",), count=20, truth=True), tmp_path / "results"
    words = ["--objects", "a", "--methods", "white-noise,nearest", "--output", str(results)]
    assert main(["evaluate", "localize", str(data), *words]) == 0
    summary = json.loads((results / "summary.json").read_text())
    means = summary["methods"]
    assert set(means["nearest"]) == {"rmed"}
    assert 0 < means["nearest"]["rmed"] < means["white-noise"]["rmed"] < 1
