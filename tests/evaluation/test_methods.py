"""Every method by its name: what all renderers have in common, and what each is known to give."""

import math
import pickle
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch

from avmsf.baselines.diffsound.body_family import BodyFamily
from avmsf.baselines.diffsound.material_fit import DiffSoundConfig
from avmsf.capture.impacts import Impacts
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import CaptureError, EvaluationError, FitError, SceneError
from avmsf.evaluation.methods import (
    NETWORK,
    PAPER_GRID,
    FieldMethod,
    RecordedMethod,
    candidates,
    method_named,
    random_modes,
)
from avmsf.evaluation.registry import METHODS, METRICS, VisualInput, resolve
from avmsf.evaluation.splits import split
from avmsf.evaluation.task import Method, Renderer, Task, report_of
from avmsf.features.feature_field import FeatureField
from avmsf.fem.candidate_bodies import CandidateBodies, CandidateBody
from avmsf.fem.elastic_modes import elastic_modes
from avmsf.fem.isotropic import isotropic_modes
from avmsf.fem.material import NOMINAL
from avmsf.fem.walls import shell
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.attention import Attention
from avmsf.modal.extraction.stft import ShortTime
from avmsf.modal.modes import synthesize
from factories.clouds import cloud
from factories.known_bodies import KnownBodies
from factories.made_sheet import sheet_over
from factories.plate_field import PLATE, QUICK, RATE, plate_extraction, plate_features, plate_impacts
from factories.raising import raises
from oracles.block import block

TINY = replace(QUICK, hidden=16, layers=1, warmup_steps=6, steps=4, fft_sizes=(256,), early=256)
COUNT, TRAIN = 20, 9
VISUAL = VisualInput("visual")
SECONDS, SAMPLES = 0.1, 800


def struck() -> Impacts:
    return plate_impacts(COUNT, seconds=SECONDS)


def with_fit(method: FieldMethod, config: FitConfig) -> FieldMethod:
    return replace(method, pipeline=replace(method.pipeline, fit=config))


def tiny(method: Any) -> Any:
    """Return a method of the same kind that is fitted in a moment."""
    if "diffsound" in method.name:
        config = DiffSoundConfig("steel", transport_steps=1, difference_steps=2, search=0)
        return replace(method, fit=partial(method.fit, config=config))
    if isinstance(method, FieldMethod):
        if method.grid is not None:
            method = replace(method, grid={"clusters": (4, 8), "learning_rate": (1e-2,), "steps": (2,)})
        config = method.pipeline.fit
        names = ("residual", "residual_noise", "feature_scale", "bands", "positive_gains")
        kept = {name: getattr(config, name) for name in names}
        return with_fit(method, replace(TINY, **kept, steps=min(4, config.steps)))
    return method


@cache
def plate_bodies() -> CandidateBodies:
    """Return a sheet of the plate's size, of a few hundred elements: enough to be computed with."""
    sheet = sheet_over(np.linspace(0, PLATE.length, 5), np.linspace(0, PLATE.width, 5))
    solid = shell(sheet, thickness=PLATE.thickness, detail=0.15)
    return KnownBodies([CandidateBody(PLATE.thickness, elastic_modes(solid, NOMINAL, count=12))])


@cache
def plate_family() -> BodyFamily:
    """Return the plate as a filled body."""
    solid = block((PLATE.length, PLATE.width, PLATE.thickness), (6, 5, 1))
    return BodyFamily((isotropic_modes(solid, count=8),), ())


def plate_task(train: Impacts, *, impacts: Impacts | None = None, seed: int = 0) -> Task:
    known = struck() if impacts is None else impacts
    fields = {}

    def field(name):
        if name not in fields:
            fields[name] = tiny(method_named(name)).fit(task)
        return fields[name]

    given = {"name": "plate", "train": train, "contacts": known.contacts, "names": known.names, "seed": seed}
    given |= {"modes": lambda: plate_extraction(train), "features": lambda look: plate_features(200)}
    given |= {"bodies": plate_bodies, "symmetries": lambda: None, "settings": CaptureSettings(), "family": plate_family}
    given |= {"other_recording": lambda: torch.linspace(-1, 1, SAMPLES), "gaussians": lambda: cloud(60)}
    task = Task(**given, field=field)
    return task


@cache
def parts() -> tuple[Impacts, Impacts]:
    return split(struck(), TRAIN)


@cache
def made(name: str, seed: int = 0) -> Renderer:
    return tiny(method_named(name)).fit(plate_task(parts()[0], seed=seed))


NAMES = [name for name, entry in METHODS.items() if not entry.path and not entry.is_edit]
# To choose takes a fit of every kind for every contact left out.
fitted_quickly = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name == "field-auto" else name for name in NAMES]
)


@fitted_quickly
def test_a_sound_depends_on_its_contact_and_the_seed_alone(name):
    train, test = parts()
    renderer = made(name)
    assert isinstance(method_named(name), Method)
    assert isinstance(renderer, Renderer)
    assert method_named(name).name == name
    assert renderer.sample_rate == RATE
    together = renderer.render(test.contacts)
    assert together.shape == (len(test), SAMPLES)
    assert together.dtype == torch.float32
    assert bool(torch.isfinite(together).all())
    for row in (0, 4, len(test) - 1):
        # Sums run in another order in a product of another size: float32 rounding, a hundred thousandth of the loudest.
        alone = renderer.render(test.contacts[row : row + 1])[0]
        assert torch.allclose(alone, together[row], rtol=0, atol=1e-5 * float(together.abs().max()))
    assert renderer.render(test.contacts[:0]).shape == (0, SAMPLES)
    assert torch.equal(tiny(method_named(name)).fit(plate_task(train)).render(test.contacts), together)


# Of those that differ in the values of the same settings the first stands for all.
KINDS = {(each.fit, each.make, *each.settings): name for name, each in reversed(METHODS.items()) if name in NAMES}


@pytest.mark.parametrize("name", KINDS.values())
def test_one_or_two_shots_are_enough(name):
    impacts = struck()
    for count in (1, 2):
        renderer = tiny(method_named(name)).fit(plate_task(impacts.take(range(count))))
        sounds = renderer.render(impacts.contacts)
        assert sounds.shape == (COUNT, SAMPLES)
        assert bool(torch.isfinite(sounds).all())


@pytest.mark.parametrize("name", ["knn-gains", "spline-gains"])
def test_methods_with_modes_render_them_and_the_residual(name):
    train, test = parts()
    renderer, bank = made(name), plate_extraction(train).bank
    assert torch.equal(renderer.bank.frequency, bank.frequency)
    modes = replace(renderer, noise=False).render(test.contacts)
    # The plate's sounds are sines alone, and so are these.
    gains = -renderer.complex_gains(test.contacts).imag
    made_of = synthesize(gains, bank.frequency, bank.damping, samples=SAMPLES, sample_rate=RATE)
    assert torch.allclose(modes, made_of, rtol=0, atol=1e-6 * float(modes.abs().max()))
    noise = renderer.render(test.contacts) - modes
    assert torch.allclose(noise[0], noise[3], rtol=0, atol=1e-4 * float(noise.abs().max()))
    magnitude = float(plate_extraction(train).residual.magnitude[0])
    # Flat noise of 800 samples: its root mean square scatters by 2.5 %.
    assert float(noise[0].square().mean().sqrt()) == pytest.approx(magnitude, rel=0.1)
    other = made(name, seed=1).render(test.contacts)
    assert not torch.allclose(other, modes + noise, rtol=0, atol=0.1 * magnitude)


def test_fields_read_what_their_names_say():
    asked = []

    def features(look):
        asked.append(look)
        return plate_features(200)

    def blind(look):
        raise SceneError("no visual input", name=look.form)

    task = replace(plate_task(parts()[0]), features=features)
    for name in ("field", "field-positions", "field-unaligned", "field-no-residual", "field-no-initialization"):
        tiny(method_named(name)).fit(task)
    assert asked == [VISUAL, replace(VISUAL, bare=True), replace(VISUAL, pooled=False), VISUAL, VISUAL]
    with raises(SceneError, name="visual"):
        tiny(method_named("field")).fit(replace(task, features=blind))


def test_ablations_leave_out_what_their_names_say():
    bank = plate_extraction(parts()[0]).bank
    assert float(made("field-no-residual").residual.magnitude.abs().max()) == 0.0
    assert torch.equal(made("field-warmup").bank.frequency, bank.frequency)
    assert not torch.equal(made("field").bank.frequency, bank.frequency)
    assert made("field-warmup").origin.config.steps == 0
    free = made("field-no-initialization")
    config = free.origin.config
    assert (config.warmup_steps, config.steps, config.correction_rate) == (0, 10, 0.03)
    assert len(free.bank) == len(bank)
    assert float((free.bank.frequency - bank.frequency).abs().min()) > 0.01
    assert made("field", seed=7).origin.config.seed == 7


def test_the_papers_method_finds_modes_in_its_own_way():
    def shared():
        raise AssertionError("the shared modes were asked for")

    train = plate_impacts()
    task = replace(plate_task(train, impacts=train), modes=shared)
    pipeline = replace(NETWORK, extraction="short-time", fit=replace(QUICK, steps=1, correction_rate=0.0))
    field = FieldMethod("quick", pipeline, VisualInput("paper"), published=True).fit(task)
    assert torch.allclose(field.bank.frequency, ShortTime().find(train.sounds, train.sample_rate).frequency)


def test_what_stands_beside_the_papers_field_has_its_gains_or_its_noise():
    train, test = parts()
    task = plate_task(train)
    field = task.field("paper")
    averaged = method_named("paper-mean-gains").fit(task).render(test.contacts)
    nearest = torch.cdist(test.contacts, train.contacts).argsort(dim=1)[:, :3]
    expected = torch.stack([field.render(train.contacts[rows]).mean(0) for rows in nearest])
    torch.testing.assert_close(averaged, expected, rtol=1e-3, atol=1e-5 * float(expected.abs().max()))
    measured, learned = (tiny(method_named(name)).fit(task) for name in ("diffsound", "paper-diffsound"))
    sounds = [each.render(test.contacts) for each in (measured, learned)]
    torch.testing.assert_close(sounds[1] - sounds[0], (field.noise() - measured.noise).expand(len(test), -1))


def test_without_initialization_no_mode_of_the_recordings_leaks_in():
    """Other recordings of the same energy give the same start; and the fit begins as silent as that start says."""
    train, _ = parts()
    both = train, replace(train, sounds=train.sounds.flip(1))
    start, again = (random_modes(each, modes=12, bins=17, generator=torch.Generator().manual_seed(3)) for each in both)
    frequency, damping = start.bank.frequency, start.bank.damping
    for one, two in ((frequency, again.bank.frequency), (damping, again.bank.damping), (start.gains, again.gains)):
        assert torch.allclose(one, two, rtol=1e-6)
    assert bool((frequency.diff() > 0).all())
    # Fifty periods in .1 s, and nine tenths of 4 kHz; from one neper over the sound to a quality of ten.
    assert float(frequency.min()) > 50 / SECONDS
    assert float(frequency.max()) < 3600
    assert bool((damping >= 1 / SECONDS).all())
    assert bool((damping <= math.pi * frequency / 10).all())
    sounds = synthesize(start.gains, frequency, damping, samples=SAMPLES, sample_rate=RATE)
    # Half of a damped sine's square is lost or won to its phase and its neighbors.
    assert float(sounds.square().mean() / train.sounds.square().mean()) == pytest.approx(1.0, abs=0.5)
    config = replace(TINY, warmup_steps=0, steps=1, learning_rate=1e-9)
    untrained = fit(train, plate_features(200), start, config, gains=Attention())
    assert torch.allclose(untrained.gain_field.gain_scale, start.gains[0].real)
    with raises(FitError, name="train", value=100):
        short = replace(train, sounds=train.sounds[:, :100])
        random_modes(short, modes=3, bins=17, generator=torch.Generator())


def test_the_papers_grid_has_all_its_combinations():
    configs = candidates(PAPER_GRID, TINY)
    assert len(configs) == len({repr(asdict(each)) for each in configs}) == 162
    assert {each.warmup_steps for each in configs} == {TINY.warmup_steps}
    # Adam has one rate in the paper.
    for each in configs:
        assert each.warmup_rate == each.correction_rate == each.noise_rate == each.learning_rate


def test_a_grid_is_chosen_from_by_envelopes_held_out_of_training(monkeypatch):
    train, _ = parts()
    seen = []

    def watched(impacts, features, modes, config, **rest):
        seen.append(impacts.names)
        assert len(modes.gains) == len(impacts)
        return fit(impacts, features, modes, config, **rest)

    monkeypatch.setattr("avmsf.pipeline.fit.fit_field", watched)
    # A rate at which nothing is learnt beside one at which much is, in a warm-up too short to matter.
    grid = {"clusters": (8,), "learning_rate correction_rate": (1e-7, 2e-2), "steps": (30,), "damping": ("shared",)}
    method = with_fit(FieldMethod("grid", grid=grid), replace(TINY, warmup_steps=1, warmup_rate=1e-7))
    field = method.fit(plate_task(train))
    report = report_of(field)["grid"]
    chosen = {"clusters": 8, "learning_rate": 2e-2, "correction_rate": 2e-2, "steps": 30, "damping": "shared"}
    assert report["chosen"] == chosen
    assert report["validation_envelope"][1] < report["validation_envelope"][0]
    assert field.origin.config.learning_rate == 2e-2
    # A quarter of nine is held out of the trials, and all nine learn in the end.
    held = set(report["validation_contacts"])
    assert len(held) == 2
    assert [set(names) for names in seen] == [set(train.names) - held] * 2 + [set(train.names)]
    few = with_fit(FieldMethod("grid", grid=grid), TINY).fit(plate_task(train.take(range(5))))
    assert report_of(few)["grid"] == {"validated": False}


def test_a_field_of_few_points_has_no_more_regions():
    points = FeatureField.from_contacts(struck().contacts, count=6)
    field = tiny(method_named("field")).fit(replace(plate_task(parts()[0]), features=lambda look: points))
    assert field.gain_field.shape.clusters == len(points.points) < 8


def test_unknown_names_are_refused(tmp_path):
    refused = {"spline-gain": None, "audio": None, "recorded:": None, f"recorded:{tmp_path}/none": tmp_path / "none"}
    (tmp_path / "file").touch()
    refused |= {f"{kind}:{tmp_path}/file": tmp_path / "file" for kind in ("recorded", "sonicgauss")}
    for name, file in refused.items():
        with raises(EvaluationError, file=file, name="method", value=name):
            method_named(name)
    assert method_named(f"recorded:{tmp_path}") == RecordedMethod(f"recorded:{tmp_path}", tmp_path)


def test_every_method_is_told_apart_by_its_words_and_can_be_sent_to_a_worker():
    """A results folder remembers methods by their words, so no address of an object may be in them."""
    names = [name for name, entry in METHODS.items() if not entry.path]
    methods = [method_named(name) for name in names]
    assert [each.name for each in pickle.loads(pickle.dumps(methods))] == names
    words = [repr(each) for each in methods]
    assert len(set(words)) == len(words)
    assert not [word for word in words if " at 0x" in word]
    paths = [each.make or each.fit for each in METHODS.values()] + [each.function or print for each in METRICS.values()]
    assert all(map(callable, map(resolve, paths)))


def write_sounds(folder: Path, impacts: Impacts) -> None:
    for name, sound in zip(impacts.names, impacts.sounds, strict=True):
        path = folder / "plate" / f"{name}.wav"
        path.parent.mkdir(parents=True, exist_ok=True)
        soundfile.write(path, sound.numpy(), int(RATE), subtype="FLOAT")


def test_others_sounds_come_back_as_they_were_written(tmp_path):
    train, test = parts()
    write_sounds(tmp_path, test)
    task, method = plate_task(train), method_named(f"recorded:{tmp_path}")
    renderer = method.fit(task)
    assert isinstance(renderer, Renderer)
    assert torch.equal(renderer.render(test.contacts[[5, 0, 7]]), test.sounds[[5, 0, 7]])
    assert torch.equal(renderer.render(test.contacts.float()), test.sounds)
    assert renderer.render(test.contacts[:0]).shape == (0, SAMPLES)
    # Recordings that are called by their files are looked up by them.
    called = replace(task, names=tuple(f"{name}.wav" for name in task.names))
    # Of two impacts in one place the one that has a sound stands for both.
    doubled = replace(task, contacts=torch.cat([test.contacts[:1], task.contacts]), names=("elsewhere", *task.names))
    for other in (called, doubled):
        assert torch.equal(method.fit(other).render(test.contacts), test.sounds)


def test_others_sounds_that_do_not_fit_are_refused_by_name(tmp_path):
    train, test = parts()
    task, method = plate_task(train), RecordedMethod("recorded", tmp_path)
    with raises(EvaluationError, file=tmp_path / "plate", name=None):
        method.fit(task)
    write_sounds(tmp_path, test)
    renderer = method.fit(task)
    with raises(EvaluationError, file=f"plate/{train.names[0]}.wav", name=train.names[0]):
        renderer.render(train.contacts[:1])
    with raises(EvaluationError, name="contacts", value=[1.0, 2.0, 3.0]):
        renderer.render(torch.tensor([[1.0, 2.0, 3.0]]))
    path = tmp_path / "plate" / f"{test.names[0]}.wav"
    sound = test.sounds[0].numpy()
    for data, rate, channels in ((sound[:700], 8000, 1), (sound, 16000, 1), (np.stack([sound, sound / 2], 1), 8000, 2)):
        soundfile.write(path, data, rate, subtype="FLOAT")
        with raises(EvaluationError, file=path, name="samples", value=(len(data), rate, channels)):
            renderer.render(test.contacts[:1])
    soundfile.write(path, np.stack([sound, sound], axis=1), 8000, subtype="FLOAT")
    assert torch.equal(renderer.render(test.contacts[:1]), test.sounds[:1])
    path.write_bytes(b"no sound")
    with raises(CaptureError, file=path, name="bytes", value=8):
        renderer.render(test.contacts[:1])
