"""Localization as an experiment of `avmsf evaluate`: errors of methods whose answer is known."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from avmsf.baselines.diffsound.renderer import DiffSound
from avmsf.capture import Impacts, read_capture
from avmsf.cli import main
from avmsf.errors import EvaluationError, LocationError
from avmsf.evaluation import report
from avmsf.evaluation.localization import (
    MAX_VERTICES,
    located,
    nearest_spectrum,
    published_distance,
    random_distance,
    rendered_gains,
)
from avmsf.evaluation.methods import FieldMethod
from avmsf.evaluation.objects import ObjectInputs
from avmsf.evaluation.results import ResultsFolder
from avmsf.evaluation.simple_methods import NearestRecording, WhiteNoise
from avmsf.evaluation.task import Task
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import PAPER
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.sound_field import SoundField
from avmsf.localization.contact_map import ContactPosterior
from avmsf.modal.extraction.finders import ShortTime
from factories.plate_field import QUICK, plate_extraction, plate_features, plate_fit, plate_impacts
from factories.plate_set import PlateInputs, fill_plates
from factories.raising import raises


def test_the_nearest_recording_finds_itself_and_noise_counts_as_a_random_point() -> None:
    train, points = plate_impacts(), plate_features().points
    size = float((points.amax(0) - points.amin(0)).norm())
    assert located(NearestRecording(train), train, train, points)[0] == {"rmed": (0.0,) * len(train)}
    expected = [random_distance(points, place) / size for place in train.contacts]
    assert located(WhiteNoise(train), train, train, points)[0]["rmed"] == pytest.approx(expected)
    silent = replace(train, sounds=0 * train.sounds)
    assert located(NearestRecording(train), train, silent, points)[0]["rmed"] == pytest.approx(expected)


def test_chance_is_the_mean_distance_from_the_right_place() -> None:
    points = torch.tensor([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    assert random_distance(points, torch.tensor([0.0, 3.0, 0.0])) == pytest.approx((3 + 5 + math.sqrt(109)) / 3)


def test_the_most_similar_spectrum_is_a_sounds_own_however_loud_and_never_that_of_silence() -> None:
    train, generator = plate_impacts(6), torch.Generator().manual_seed(1)
    nearest = nearest_spectrum(train)
    for row, sound in enumerate(train.sounds):
        noise = 1e-3 * float(sound.abs().max()) * torch.randn(len(sound), generator=generator)
        assert nearest(-300.0 * (sound + noise)) == row
    with raises(EvaluationError, name="sound", value=0.0):
        nearest(0.0 * train.sounds[0])
    quiet = train.sounds.clone()
    quiet[1] = 0.0
    nearest = nearest_spectrum(replace(train, sounds=quiet))
    assert [nearest(sound) for sound in train.sounds[[0, 2, 3]]] == [0, 2, 3]
    assert nearest(train.sounds[1]) != 1


def smooth_field(train: Impacts, features: FeatureField) -> SoundField:
    config = replace(QUICK, warmup_steps=0, steps=1, residual=False)
    field = fit(train, features, plate_extraction(train), config, gains=MixtureEstimator(("smooth",)))
    # Localization compares with mean gains: sounds are its own where they are rendered with these.
    return replace(field, gain_field=replace(field.gain_field, spread_share=0.0))


def struck(field: SoundField, points: torch.Tensor) -> Impacts:
    """Return the field's own sounds at every sixtieth point."""
    train, rows = plate_impacts(), torch.arange(0, 600, 60)
    sounds = field.render(points[rows])
    return replace(train.take(range(len(rows))), contacts=points[rows].to(train.contacts), sounds=sounds)


def test_a_field_finds_where_its_own_sounds_come_from() -> None:
    train, points, field = plate_impacts(), plate_features().points, smooth_field(plate_impacts(), plate_features())
    found = located(field, train, struck(field, points), points)[0]
    assert set(found) == {"rmed", "rmed_posterior"}
    assert max(found["rmed"]) < 0.02
    assert sorted(found["rmed_posterior"])[5] < 0.1


def test_the_published_distance_is_one_minus_the_cosine_between_the_gains_of_the_regression() -> None:
    points = plate_features().points[::10]
    field = smooth_field(plate_impacts(), plate_features())
    sound = struck(field, plate_features().points).sounds[3]
    recorded = ShortTime().gains(sound[None], field.bank, field.sample_rate)[0].numpy()
    gains = rendered_gains(field, points)
    own = ShortTime().gains(field.render(points, noise=False), field.bank, field.sample_rate).numpy()
    expected = 1.0 - own @ recorded / np.linalg.norm(own, axis=1) / np.linalg.norm(recorded)
    assert published_distance(field, gains, sound).numpy() == pytest.approx(expected, abs=1e-6)
    # Neither force nor polarity changes it.
    assert published_distance(field, gains, -250.0 * sound).numpy() == pytest.approx(expected, abs=1e-4)
    with raises(LocationError, name="sound"):
        published_distance(field, gains, 0.0 * sound)


def test_the_published_form_takes_the_least_cosine_distance_and_refuses_no_noise() -> None:
    points, train = plate_features().points, plate_impacts()
    field = smooth_field(train, plate_features())
    test = struck(field, points)
    size = float((points.amax(0) - points.amin(0)).norm())
    noise = torch.randn(test.sounds[0].shape, generator=torch.Generator().manual_seed(1))
    test = replace(test, sounds=torch.cat([test.sounds[:-1], noise[None]]))
    errors, maps = located(field, train, test, points, published=True, map_rows=(0, len(test) - 1))
    gains = rendered_gains(field, points)
    for row, rmed in enumerate(errors["rmed"]):
        place = points[int(published_distance(field, gains, test.sounds[row]).argmin())]
        assert rmed == pytest.approx(float((place - test.contacts[row]).norm()) / size, rel=1e-5)
    # Noise has a least distance too, and no map.
    assert set(maps) == {0}
    order = torch.cdist(maps[0].points, points).argmin(1)
    torch.testing.assert_close(maps[0].distance, published_distance(field, gains, test.sounds[0])[order])


def test_a_network_of_the_published_form_finds_its_own_recordings() -> None:
    train, config = plate_impacts(), replace(PAPER, damping="shared", clusters=8, width=16, hidden=64)
    field = plate_fit(replace(config, warmup_steps=300, steps=300, fft_sizes=(1024, 256), interleave=2), train=train)
    points = torch.cat([train.contacts, plate_features().points[::3].to(train.contacts)])
    found = located(field, train, train, points, published=True)[0]["rmed"]
    # Of what the network puts out, without regard to how it sounds, two thirds are off by more.
    assert sorted(found)[8] < 0.02


def test_diffsound_searches_the_vertices_of_the_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    searched = []

    def simulated(renderer: DiffSound, points: torch.Tensor) -> torch.Tensor:
        searched.append(points)
        return points

    monkeypatch.setattr(DiffSound, "gains", simulated)
    monkeypatch.setattr(DiffSound, "distance", lambda renderer, gains, sound: torch.zeros(len(gains)))
    train, points = plate_impacts(), plate_features().points
    vertices = torch.rand(MAX_VERTICES + 5000, 3, generator=torch.Generator().manual_seed(0))
    renderer = object.__new__(DiffSound)
    object.__setattr__(renderer, "sample_rate", train.sample_rate)
    for given in (None, vertices[:100], vertices):
        located(renderer, train, train, points, vertices=given)
    assert [len(each) for each in searched] == [min(2000, len(points)), 100, MAX_VERTICES]
    assert torch.equal(searched[1].float(), vertices[:100])
    assert len(searched[2].unique(dim=0)) == MAX_VERTICES


@pytest.mark.slow
def test_heat_maps_have_the_true_contacts_and_the_papers_methods_their_own_distance(tmp_path, monkeypatch):
    data, results = fill_plates(tmp_path / "plates", ("a",), count=20, truth=True), tmp_path / "results"
    asked: dict[bool, torch.Tensor] = {}
    drawn: dict[str, tuple[ContactPosterior, torch.Tensor]] = {}

    def quick(method: FieldMethod, task: Task) -> SoundField:
        config = replace(QUICK, warmup_steps=0, steps=1)
        return fit(task.train, task.features("positions"), task.modes(), config, gains=MixtureEstimator(("smooth",)))

    def watched(*given: Any, **named: Any) -> Any:
        asked[named["published"]] = named["vertices"]
        return located(*given, **named)

    def draw(found: ContactPosterior, *, title: str, truth: torch.Tensor) -> Figure:
        drawn[title] = (found, truth)
        return Figure()

    monkeypatch.setattr(ObjectInputs, "features", PlateInputs.features)
    monkeypatch.setattr(FieldMethod, "fit", quick)
    monkeypatch.setattr("avmsf.evaluation.runner.located", watched)
    monkeypatch.setattr(report, "draw_contact", draw)
    words = ["evaluate", "localize", str(data), "--objects", "a", "--methods", "field-auto,paper-grid,paper,nearest"]
    words += ["--set", "lift.encoder=descriptors", "--output", str(results), "--figures"]
    assert main(words) == 0
    assert set(asked) == {False, True}
    assert asked[True].shape == (4, 3)
    record = ResultsFolder(results).read("a")
    assert record is not None
    impacts = read_capture(data / "a").impacts
    contacts = dict(zip(impacts.names, impacts.contacts, strict=True))
    kept = list(record.cases[0].sounds)
    fields = ("field-auto", "paper-grid", "paper")
    assert list(drawn) == [f"a: {name} located by {each}" for each in fields for name in kept]
    for title, (_, truth) in drawn.items():
        torch.testing.assert_close(truth, contacts[title.split()[1]])
    ours, paper = (drawn[f"a: {kept[0]} located by {each}"][0] for each in ("field-auto", "paper"))
    assert torch.equal(ours.probability, paper.probability)
    assert not torch.allclose(ours.distance, paper.distance)
    pictures = sorted(path.name for path in (results / "figures").iterdir())
    assert len(pictures) == 1 + 3 * len(kept)


def test_the_experiment_is_a_command(tmp_path: Path) -> None:
    data, results = fill_plates(tmp_path / "plates", ("a",), count=20, truth=True), tmp_path / "results"
    words = ["--objects", "a", "--methods", "white-noise,nearest", "--output", str(results)]
    assert main(["evaluate", "localize", str(data), *words]) == 0
    summary = json.loads((results / "summary.json").read_text())
    means = summary["methods"]
    assert set(means["nearest"]) == {"rmed"}
    assert 0 < means["nearest"]["rmed"] < means["white-noise"]["rmed"] < 1
