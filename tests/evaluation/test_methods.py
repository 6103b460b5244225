"""Every method by its name: what all renderers have in common, and what each is known to give."""

import math
from dataclasses import replace
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
from avmsf.errors import EvaluationError, FitError, SceneError
from avmsf.evaluation.field_methods import PAPER_GRID, FieldMethod, Grid, random_modes
from avmsf.evaluation.methods import RecordedMethod, diffsound, method_named
from avmsf.evaluation.registry import METHODS
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
from avmsf.field.sound_field import SoundField
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.synthesis import synthesize
from factories.made_sheet import sheet_over
from factories.plate_field import PLATE, QUICK, RATE, plate_extraction, plate_features, plate_impacts
from factories.raising import raises
from factories.sonicgauss_cases import cloud
from oracles.block import block

TINY = replace(QUICK, hidden=16, layers=1, warmup_steps=6, steps=4, fft_sizes=(256,), early=256)
COUNT, TRAIN = 20, 9
SECONDS, SAMPLES = 0.1, 800


def struck() -> Impacts:
    return plate_impacts(COUNT, seconds=SECONDS)


def with_fit(method: FieldMethod, config: FitConfig) -> FieldMethod:
    return replace(method, pipeline=replace(method.pipeline, fit=config))


def tiny(method: Any) -> Any:
    """Return a method of the same kind that is fitted in a moment."""
    if method.name.startswith("diffsound"):
        config = DiffSoundConfig(transport_steps=1, difference_steps=2, search=0)
        return replace(method, fit=partial(diffsound, config=config, weighted=method.name.endswith("weighted")))
    if isinstance(method, FieldMethod):
        if method.grid is not None:
            method = replace(method, grid=Grid((4, 8), (1e-2,), (2,), (1.0,), ("shared",)))
        config = method.pipeline.fit
        kept = {name: getattr(config, name) for name in ("residual", "feature_scale", "bands")}
        return with_fit(method, replace(TINY, **kept, steps=min(4, config.steps)))
    return method


@cache
def plate_bodies() -> CandidateBodies:
    """Return a sheet of the plate's size, of a few hundred elements: enough to be computed with."""
    sheet = sheet_over(np.linspace(0, PLATE.length, 5), np.linspace(0, PLATE.width, 5))
    solid = shell(sheet, thickness=PLATE.thickness, detail=0.15)
    return CandidateBodies([CandidateBody(PLATE.thickness, elastic_modes(solid, NOMINAL, count=12))])


@cache
def plate_family() -> BodyFamily:
    """Return the plate as a filled body."""
    solid = block((PLATE.length, PLATE.width, PLATE.thickness), (6, 5, 1))
    return BodyFamily((isotropic_modes(solid, count=8),), ())


def plate_task(train: Impacts, *, impacts: Impacts | None = None, seed: int = 0) -> Task:
    known = struck() if impacts is None else impacts
    return Task(
        name="plate",
        train=train,
        contacts=known.contacts,
        names=known.names,
        seed=seed,
        modes=lambda: plate_extraction(train),
        features=lambda look: plate_features(200),
        bodies=plate_bodies,
        other_recording=lambda: torch.linspace(-1, 1, SAMPLES),
        family=plate_family,
        gaussians=lambda: cloud(60),
    )


@cache
def parts() -> tuple[Impacts, Impacts]:
    return split(struck(), TRAIN)


@cache
def made(name: str, seed: int = 0) -> Renderer:
    return tiny(method_named(name)).fit(plate_task(parts()[0], seed=seed))


NAMES = [name for name, entry in METHODS.items() if not entry.path]
every_method = pytest.mark.parametrize("name", NAMES)
# To choose takes a fit of every kind for every contact left out.
fitted_quickly = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name == "field-auto" else name for name in NAMES]
)


@fitted_quickly
def test_a_sound_depends_on_its_contact_alone(name):
    _, test = parts()
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


@fitted_quickly
def test_a_seed_decides_all_chance(name):
    train, test = parts()
    again = tiny(method_named(name)).fit(plate_task(train)).render(test.contacts)
    assert torch.equal(again, made(name).render(test.contacts))


@every_method
def test_one_or_two_shots_are_enough(name):
    impacts = struck()
    for count in (1, 2):
        train = impacts.take(range(count))
        renderer = tiny(method_named(name)).fit(plate_task(train))
        sounds = renderer.render(impacts.contacts)
        assert sounds.shape == (COUNT, SAMPLES)
        assert bool(torch.isfinite(sounds).all())
        if name.startswith("knn"):
            assert report_of(renderer) == {"neighbors": count}


@pytest.mark.parametrize("name", ["nearest", "knn3", "knn3-directions", "knn-gains", "spline-gains"])
def test_the_order_of_training_rows_changes_nothing(name):
    train, test = parts()
    rows = torch.randperm(TRAIN, generator=torch.Generator().manual_seed(1)).tolist()
    shuffled = method_named(name).fit(plate_task(train.take(rows))).render(test.contacts)
    straight = made(name).render(test.contacts)
    assert torch.allclose(shuffled, straight, rtol=0, atol=1e-5 * float(straight.abs().max()))


@pytest.mark.parametrize("name", ["nearest", "spline-gains"])
def test_training_contacts_sound_as_recorded(name):
    train, _ = parts()
    difference = made(name).render(train.contacts) - train.sounds
    # The recordings' noise is 40 dB down, and the spline's own noise comes to as much once more. The plate's true modes
    # are a little off in its extraction, 20 dB at the end of the sound.
    limit = 0.0 if name == "nearest" else 0.35
    assert float(difference.square().mean().sqrt() / train.sounds.square().mean().sqrt()) <= limit


@pytest.mark.parametrize("name", ["knn-gains", "spline-gains", "field", "field-no-initialization"])
def test_methods_with_modes_give_their_bank_and_gains(name):
    train, test = parts()
    renderer = made(name)
    gains = -renderer.complex_gains(test.contacts).imag
    assert gains.shape == (len(test), len(renderer.bank))
    if name != "field-no-initialization":
        assert len(renderer.bank) == len(plate_extraction(train).bank)
    if name.endswith("gains"):
        sounds = replace(renderer, noise=False).render(test.contacts)
        made_of = synthesize(gains, renderer.bank.frequency, renderer.bank.damping, samples=SAMPLES, sample_rate=RATE)
        # The plate's sounds are sines alone, and so are these.
        assert torch.allclose(sounds, made_of, rtol=0, atol=1e-6 * float(sounds.abs().max()))


@pytest.mark.parametrize("name", ["knn-gains", "spline-gains"])
def test_noise_beside_modes_is_the_residual(name):
    _, test = parts()
    noise = made(name).render(test.contacts) - replace(made(name), noise=False).render(test.contacts)
    assert torch.allclose(noise[0], noise[3], rtol=0, atol=1e-4 * float(noise.abs().max()))
    magnitude = float(plate_extraction(parts()[0]).residual.magnitude[0])
    # Flat noise of 800 samples: its root mean square scatters by 2.5 %.
    assert float(noise[0].square().mean().sqrt()) == pytest.approx(magnitude, rel=0.1)
    other = made(name, seed=1).render(test.contacts)
    assert not torch.allclose(other, made(name).render(test.contacts), rtol=0, atol=0.1 * magnitude)


def test_a_random_impact_is_the_strangers_everywhere():
    train, test = parts()
    sounds = made("random-impact").render(test.contacts)
    assert torch.equal(sounds, torch.linspace(-1, 1, SAMPLES).expand(len(test), -1))
    with raises(EvaluationError, name="stranger"):
        method_named("random-impact").fit(replace(plate_task(train), other_recording=no_stranger))


def no_stranger():
    raise EvaluationError("no other object", name="stranger")


def test_fields_read_what_their_names_say():
    train, _ = parts()
    asked = []

    def features(look):
        asked.append(look)
        return plate_features(200)

    task = replace(plate_task(train), features=features)
    for name in ("field", "field-positions", "field-unaligned", "field-no-residual", "field-no-initialization"):
        tiny(method_named(name)).fit(task)
    assert asked == ["visual", "positions", "unaligned", "visual", "visual"]

    def blind(look):
        raise SceneError("no visual input", name=look)

    with raises(SceneError, name="visual"):
        tiny(method_named("field")).fit(replace(task, features=blind))


def test_ablations_leave_out_what_their_names_say():
    train, _ = parts()
    assert float(made("field-no-residual").residual.magnitude.abs().max()) == 0.0
    bank = plate_extraction(train).bank
    assert torch.equal(made("field-warmup").bank.frequency, bank.frequency)
    assert not torch.equal(made("field").bank.frequency, bank.frequency)
    assert made("field-warmup").origin.config.steps == 0
    free = made("field-no-initialization")
    config = free.origin.config
    assert (config.warmup_steps, config.steps, config.correction_rate) == (0, 10, 0.03)
    assert len(free.bank) == len(bank)
    assert float((free.bank.frequency - bank.frequency).abs().min()) > 0.01
    assert made("field", seed=7).origin.config.seed == 7


def test_without_initialization_no_mode_of_the_recordings_leaks_in():
    """Other recordings of the same energy give the same start; and the fit begins as silent as that start says."""
    train, _ = parts()
    chance = torch.Generator().manual_seed(3)
    start = random_modes(train, modes=12, bins=17, generator=chance)
    other = replace(train, sounds=train.sounds.flip(1))
    again = random_modes(other, modes=12, bins=17, generator=torch.Generator().manual_seed(3))
    for one, two in zip((*bank_of(start), start.gains), (*bank_of(again), again.gains), strict=True):
        assert torch.allclose(one, two, rtol=1e-6)
    frequency, damping = bank_of(start)
    assert bool((frequency.diff() > 0).all())
    # Fifty periods in .1 s, and nine tenths of 4 kHz; from one neper over the sound to a quality of ten.
    assert float(frequency.min()) > 50 / SECONDS
    assert float(frequency.max()) < 3600
    assert bool((damping >= 1 / SECONDS).all())
    assert bool((damping <= math.pi * frequency / 10).all())
    sounds = synthesize(start.gains, frequency, damping, samples=SAMPLES, sample_rate=RATE)
    # Half of a damped sine's square is lost or won to its phase and its neighbors.
    assert float(sounds.square().mean() / train.sounds.square().mean()) == pytest.approx(1.0, abs=0.5)
    untrained = fit(
        train, plate_features(200), start, replace(TINY, warmup_steps=0, steps=1, learning_rate=1e-9), gains=Attention()
    )
    assert torch.allclose(untrained.gain_field.gain_scale, start.gains[0].real)


def bank_of(extraction: Extraction) -> tuple[torch.Tensor, torch.Tensor]:
    return extraction.bank.frequency, extraction.bank.damping


def test_nothing_can_be_started_from_nothing():
    train, _ = parts()
    short = replace(train, sounds=train.sounds[:, :100])
    with raises(FitError, name="train", value=100):
        random_modes(short, modes=3, bins=17, generator=torch.Generator())


def test_the_papers_grid_has_all_its_combinations():
    candidates = list(PAPER_GRID.candidates(TINY))
    assert len(candidates) == 162
    found = {(each.clusters, each.learning_rate, each.steps, each.early_weight, each.damping) for each in candidates}
    assert len(found) == 162
    assert {each.warmup_steps for each in candidates} == {TINY.warmup_steps}


def test_a_grid_is_chosen_from_by_envelopes_held_out_of_training():
    train, _ = parts()
    # A rate at which nothing is learnt beside one at which much is, in a warm-up too short to matter.
    grid = Grid((8,), (1e-7, 2e-2), (30,), (1.0,), ("shared",))
    method = with_fit(FieldMethod("grid", grid=grid), replace(TINY, warmup_steps=1, warmup_rate=1e-7))
    field = method.fit(plate_task(train))
    report = report_of(field)["grid"]
    assert report["chosen"] == {
        "clusters": 8,
        "learning_rate": 2e-2,
        "steps": 30,
        "early_weight": 1.0,
        "damping": "shared",
    }
    assert report["validation_envelope"][1] < report["validation_envelope"][0]
    assert field.origin.config.learning_rate == 2e-2
    # A quarter of nine, and all nine learn in the end.
    assert len(report["validation_contacts"]) == 2
    assert set(report["validation_contacts"]) < set(train.names)
    assert field.origin.trained_on == train.names
    few = with_fit(FieldMethod("grid", grid=grid), TINY).fit(plate_task(train.take(range(5))))
    assert report_of(few)["grid"] == {"validated": False}


def test_a_grids_trials_do_not_learn_from_what_they_are_judged_by(monkeypatch):
    train, _ = parts()
    seen = []

    def watched(impacts, features, modes, config, **rest):
        seen.append(impacts.names)
        assert len(modes.gains) == len(impacts)
        return fit(impacts, features, modes, config, **rest)

    monkeypatch.setattr("avmsf.evaluation.field_methods.fit", watched)
    grid = Grid((8,), (1e-2,), (2,), (0.5, 1.0), ("shared",))
    field = with_fit(FieldMethod("grid", grid=grid), TINY).fit(plate_task(train))
    held = set(report_of(field)["grid"]["validation_contacts"])
    assert len(seen) == 3
    for names in seen[:2]:
        assert set(names) == set(train.names) - held
    assert seen[2] == train.names


def test_a_field_of_few_points_has_no_more_regions():
    train, _ = parts()
    points = FeatureField.from_contacts(struck().contacts, count=6)
    field = tiny(method_named("field")).fit(replace(plate_task(train), features=lambda look: points))
    assert isinstance(field, SoundField)
    assert field.gain_field.shape.clusters == len(points.points) < 8


def test_reports_say_what_was_used():
    assert report_of(made("white-noise")) == {}
    assert report_of(made("knn3")) == {"neighbors": 3}
    assert report_of(made("spline-gains")) == {
        "kernel": "thin plate",
        "directions": 2,
        "sites": TRAIN,
    }
    assert report_of(made("field-positions"))["damping"] in ("shared", "per-contact")


def test_unknown_names_are_refused_with_the_known_ones(tmp_path):
    with raises(EvaluationError, name="method", value="spline-gain") as caught:
        method_named("spline-gain")
    assert str(caught.value).endswith("spline-gains?")
    with raises(EvaluationError, name="method", value="audio") as caught:
        method_named("audio")
    assert all(name in str(caught.value) for name in METHODS)
    for name, folder in (("recorded:", None), (f"recorded:{tmp_path}/none", tmp_path / "none")):
        with raises(EvaluationError, file=folder, name="method", value=name):
            method_named(name)
    method = method_named(f"recorded:{tmp_path}")
    assert method == RecordedMethod(f"recorded:{tmp_path}", tmp_path)
    assert method.name == f"recorded:{tmp_path}"


def test_methods_are_told_apart_by_their_words():
    """A results folder remembers methods by these, so no address of an object may be in them."""
    words = [repr(method_named(name)) for name in NAMES]
    assert len(set(words)) == len(words)
    assert not [word for word in words if " at 0x" in word]


def write_sounds(folder, impacts: Impacts, *, rate: int = int(RATE), ending: str = ".wav") -> None:
    for name, sound in zip(impacts.names, impacts.sounds, strict=True):
        path = folder / "plate" / f"{name}{ending}"
        path.parent.mkdir(parents=True, exist_ok=True)
        soundfile.write(path, sound.numpy(), rate, subtype="FLOAT")


def test_others_sounds_come_back_as_they_were_written(tmp_path):
    train, test = parts()
    write_sounds(tmp_path, test)
    task = plate_task(train)
    renderer = method_named(f"recorded:{tmp_path}").fit(task)
    assert isinstance(renderer, Renderer)
    rows = [5, 0, 7]
    assert torch.equal(renderer.render(test.contacts[rows]), test.sounds[rows])
    assert torch.equal(renderer.render(test.contacts.float()), test.sounds)
    assert renderer.render(test.contacts[:0]).shape == (0, SAMPLES)
    # Recordings that are called by their files are looked up by them.
    called = replace(task, names=tuple(f"{name}.wav" for name in task.names))
    assert torch.equal(method_named(f"recorded:{tmp_path}").fit(called).render(test.contacts), test.sounds)
    # Two blows in one place: the one that has a sound stands for both.
    doubled = replace(task, contacts=torch.cat([test.contacts[:1], task.contacts]), names=("elsewhere", *task.names))
    assert torch.equal(method_named(f"recorded:{tmp_path}").fit(doubled).render(test.contacts), test.sounds)


def test_others_sounds_that_do_not_fit_are_refused_by_name(tmp_path):
    train, test = parts()
    task = plate_task(train)
    with raises(EvaluationError, file=tmp_path / "plate", name=None):
        RecordedMethod("recorded", tmp_path).fit(task)
    write_sounds(tmp_path, test)
    renderer = RecordedMethod("recorded", tmp_path).fit(task)
    with raises(EvaluationError, file=f"plate/{train.names[0]}.wav", name=train.names[0]):
        renderer.render(train.contacts[:1])
    with raises(EvaluationError, name="contacts", value=[1.0, 2.0, 3.0]):
        renderer.render(torch.tensor([[1.0, 2.0, 3.0]]))
    path = tmp_path / "plate" / f"{test.names[0]}.wav"
    sound = test.sounds[0].numpy()
    for data, rate in ((sound[:700], 8000), (sound, 16000)):
        soundfile.write(path, data, rate, subtype="FLOAT")
        with raises(EvaluationError, file=path, name="samples", value=(len(data), rate, 1)):
            renderer.render(test.contacts[:1])
    soundfile.write(path, np.stack([sound, 0.5 * sound], axis=1), 8000, subtype="FLOAT")
    with raises(EvaluationError, file=path, name="samples", value=(SAMPLES, RATE, 2)):
        renderer.render(test.contacts[:1])
    soundfile.write(path, np.stack([sound, sound], axis=1), 8000, subtype="FLOAT")
    assert torch.equal(renderer.render(test.contacts[:1]), test.sounds[:1])
    path.write_bytes(b"no sound")
    with raises(EvaluationError, file=path, name="bytes", value=8):
        renderer.render(test.contacts[:1])


def test_a_digest_is_of_the_wavs_of_one_object(tmp_path: Path) -> None:
    method = RecordedMethod("recorded", tmp_path)
    paths = [tmp_path / name / "001.wav" for name in ("bowl", "mug")]
    for path in paths:
        path.parent.mkdir()
        path.write_bytes(b"one")
    before, identity = method.digest("bowl"), repr(method)
    paths[1].write_bytes(b"two")
    assert method.digest("bowl") == before
    paths[0].write_bytes(b"two")
    assert method.digest("bowl") != before
    assert repr(method) == identity
