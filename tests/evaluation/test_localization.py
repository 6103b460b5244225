"""The localization of impacts and the score of edits, in evaluations."""

import json
import pickle
from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from avmsf.capture import Impacts, read_capture
from avmsf.cli import main
from avmsf.datasets import CaptureCollection
from avmsf.editing.reference import Reference
from avmsf.editing.stable_audio import StableAudio
from avmsf.errors import EvaluationError, LocationError
from avmsf.evaluation import report
from avmsf.evaluation.editing import PROMPTS, REALIMPACT_26, Edits, audible_modes, spectral_distance
from avmsf.evaluation.localization import located, nearest_spectrum, published_distance, rendered_gains
from avmsf.evaluation.methods import FieldMethod
from avmsf.evaluation.mode_embedding import FEATURES, MaterialSpace
from avmsf.evaluation.objects import ObjectInputs
from avmsf.evaluation.registry import EditProtocolSettings, VisualInput
from avmsf.evaluation.results import ObjectRecord, ResultsFolder
from avmsf.evaluation.simple_methods import NearestRecording, WhiteNoise
from avmsf.evaluation.task import Task
from avmsf.field.config import PAPER
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.sound_field import SoundField
from avmsf.localization.contact_map import ContactPosterior
from avmsf.modal.extraction.finders import HighResolution
from avmsf.modal.extraction.stft import ShortTime
from avmsf.modal.modes import ModalBank
from factories.made_audio import save_audio
from factories.made_clap import save_clap
from factories.plate_field import QUICK, plate_extraction, plate_features, plate_fit, plate_impacts
from factories.plate_set import PlateInputs, fill_plates
from factories.raising import raises
from factories.verbs import run_verb, sets


def test_the_nearest_recording_finds_itself_and_noise_counts_as_a_random_point() -> None:
    train, points = plate_impacts(), plate_features().points
    size = float((points.amax(0) - points.amin(0)).norm())
    assert located(NearestRecording(train), train, train, points)[0] == {"rmed": (0.0,) * len(train)}
    expected = [float((points.double() - place).norm(dim=1).mean()) / size for place in train.contacts]
    assert located(WhiteNoise(train), train, train, points)[0]["rmed"] == pytest.approx(expected)
    silent = replace(train, sounds=0 * train.sounds)
    assert located(NearestRecording(train), train, silent, points)[0]["rmed"] == pytest.approx(expected)


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


@cache
def smooth_field() -> tuple[SoundField, Impacts, torch.Tensor]:
    """Return a field, its own sounds at every sixtieth point of the plate, and all these points."""
    train, points, rows = plate_impacts(), plate_features().points, torch.arange(0, 600, 60)
    config = replace(QUICK, warmup_steps=0, steps=1, residual=False)
    field = fit(train, plate_features(), plate_extraction(train), config, gains=MixtureEstimator(("smooth",)))
    # Localization compares with mean gains: sounds are its own where they are rendered with these.
    field = replace(field, gain_field=replace(field.gain_field, spread_share=0.0))
    struck, sounds = points[rows].to(train.contacts), field.render(points[rows])
    return field, replace(train.take(range(len(rows))), contacts=struck, sounds=sounds), points


def test_a_field_finds_where_its_own_sounds_come_from() -> None:
    field, test, points = smooth_field()
    found = located(field, plate_impacts(), test, points)[0]
    assert set(found) == {"rmed", "rmed_posterior"}
    assert max(found["rmed"]) < 0.02
    assert sorted(found["rmed_posterior"])[5] < 0.1


def test_the_published_distance_is_one_minus_the_cosine_between_the_gains_of_the_regression() -> None:
    field, test, points = smooth_field()
    points, sound = points[::10], test.sounds[3]
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
    field, test, points = smooth_field()
    size = float((points.amax(0) - points.amin(0)).norm())
    noise = torch.randn(test.sounds[0].shape, generator=torch.Generator().manual_seed(1))
    test = replace(test, sounds=torch.cat([test.sounds[:-1], noise[None]]))
    errors, maps = located(field, plate_impacts(), test, points, published=True, map_rows=(0, len(test) - 1))
    gains = rendered_gains(field, points)
    for row, rmed in enumerate(errors["rmed"]):
        place = points[int(published_distance(field, gains, test.sounds[row]).argmin())]
        assert rmed == pytest.approx(float((place - test.contacts[row]).norm()) / size, rel=1e-5)
    # Noise has a least distance too, and no map.
    assert set(maps) == {0}
    order = torch.cdist(maps[0].points, points).argmin(1)
    torch.testing.assert_close(maps[0].distance, published_distance(field, gains, test.sounds[0])[order])


@pytest.mark.slow
def test_a_network_of_the_published_form_finds_its_own_recordings() -> None:
    train, config = plate_impacts(), replace(PAPER, damping="shared", clusters=8, width=16, hidden=64)
    field = plate_fit(replace(config, warmup_steps=300, steps=300, fft_sizes=(1024, 256), interleave=2), train=train)
    points = torch.cat([train.contacts, plate_features().points[::3].to(train.contacts)])
    found = located(field, train, train, points, published=True)[0]["rmed"]
    # Of what the network puts out, without regard to how it sounds, two thirds are off by more.
    assert sorted(found)[8] < 0.02


@pytest.mark.slow
def test_heat_maps_have_the_true_contacts_and_the_papers_methods_their_own_distance(tmp_path, monkeypatch):
    data, results = fill_plates(tmp_path / "plates", ("a",), count=20, truth=True), tmp_path / "results"
    asked: dict[bool, torch.Tensor] = {}
    drawn: dict[str, tuple[ContactPosterior, torch.Tensor]] = {}

    def quick(method: FieldMethod, task: Task) -> SoundField:
        points, config = task.features(VisualInput("visual", bare=True)), replace(QUICK, warmup_steps=0, steps=1)
        return fit(task.train, points, task.modes(), config, gains=MixtureEstimator(("smooth",)))

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


RATE = 16000.0


def test_only_modes_that_are_audible_count():
    bank = ModalBank(torch.tensor([100.0, 200.0, 300.0, 9000.0], dtype=torch.float64), torch.full((4,), 5.0).double())
    # Energies of 0, -60.2 and -59.2 dB, and the loudest of all beyond half the sample rate.
    amplitudes = torch.tensor([[1.0, 0.98e-3, 1.1e-3, 50.0]])
    assert audible_modes(bank, amplitudes, sample_rate=RATE).frequency.tolist() == [100.0, 300.0]
    assert audible_modes(bank, amplitudes).frequency.tolist() == [100.0, 9000.0]


def test_the_26_objects_are_seven_of_each_material_where_there_are_so_many():
    assert Counter(REALIMPACT_26.values()) == {"ceramic": 7, "wood": 7, "metal": 7, "plastic": 4, "glass": 1}
    # Iron is metal, of which an eighth is left out, and a mesh that intersects itself.
    assert REALIMPACT_26["17_IronSkillet"] == "metal"
    assert {"92_MetalSpatula", "73_PlasticBin"}.isdisjoint(REALIMPACT_26)


def test_the_spectral_distance_is_free_of_level():
    decay = torch.exp(-30.0 * torch.arange(2400) / RATE)
    tones = torch.stack([torch.sin(2 * torch.pi * pitch * torch.arange(2400) / RATE) * decay for pitch in (500, 900)])
    known, other = (Reference.of(each[None], sample_rate=RATE) for each in tones)
    assert spectral_distance(7.0 * tones[:1], known, sample_rate=RATE).item() == pytest.approx(0.0, abs=1e-5)
    assert spectral_distance(0.0 * tones[:1], known, sample_rate=RATE).item() == pytest.approx(1.0)
    assert spectral_distance(tones[:1], other, sample_rate=RATE).item() > 0.5
    with raises(EvaluationError, name="reference", value=RATE):
        spectral_distance(tones, known, sample_rate=8000.0)


NAMES = ("a-ceramic", "b-ceramic", "c-wood", "d-wood", "e-glass", "f-glass")
CHEAP = (*sets("edit.fields=field-smooth edit.guide.steps=1 extraction=short-time modes=16"), "--figures")


@pytest.fixture
def plates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return captures named by materials, which are placed by two components of their vectors: UMAP has to compile."""
    monkeypatch.setattr(MaterialSpace, "embedding", property(lambda self: np.zeros((len(self.vectors), 2))))
    monkeypatch.setattr(MaterialSpace, "place", lambda self, bank: FEATURES[self.features](bank)[:2])
    return fill_plates(tmp_path / "plates", NAMES)


def edited(plates: Path, *words: str) -> tuple[ObjectRecord, Path]:
    """Run the protocol on one object, and return its record and the folder of results."""
    folder = plates.parent / "results"
    assert run_verb("evaluate", "edit", str(plates), *CHEAP, *words, "--output", str(folder)) == 0
    (record,) = ResultsFolder(folder).records()
    assert all(each.failure is None for each in record.outcomes)
    return record, folder


def test_edits_go_towards_recordings_of_the_new_material_and_physics_has_its_frequencies(plates: Path) -> None:
    methods = ("unedited", "edit-independent", "edit-physics")
    record, folder = edited(plates, "--objects", "b-ceramic", "--methods", ",".join(methods))
    # Objects of the new material take turns: the second ceramic plate has the second wooden one.
    assert [case.key for case in record.cases] == ["edit: ceramic to wood: d-wood"]
    found = {each.method: each for each in record.outcomes}
    assert tuple(found) == methods
    assert all({*each.figures} == {"umap", "umap_dampings"} and len(each.values["spectral"]) == 8
               for each in found.values())  # fmt: skip
    # Sound in wood is sqrt(E rho' / E' rho) = 1.35 times as slow, .43 octaves, and vectors have octaves; its damping
    # lowers frequencies a little more.
    apart = np.subtract(*(found[name].report["places"]["umap"] for name in ("unedited", "edit-physics")))
    assert apart * np.sqrt(32) == pytest.approx(np.log2(np.sqrt(72e9 / 2700 * 750 / 11e9)), abs=0.015)
    assert (folder / "figures" / "umap ceramic to wood.png").exists()
    assert json.loads((folder / "summary.json").read_text())["methods"]["unedited"].keys() >= {"umap", "spectral"}


def test_models_and_embeddings_do_not_go_to_other_processes(tmp_path: Path) -> None:
    edits = Edits(CaptureCollection(tmp_path), EditProtocolSettings(), HighResolution(), tmp_path)
    vars(edits)["model"] = lambda: "is not pickled"
    assert pickle.loads(pickle.dumps(edits)).model is None


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`torch.nn.utils.weight_norm` is deprecated:FutureWarning")
def test_edits_towards_words_have_a_clap_score_and_its_curve(plates: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("diffusers", reason="needs pip install 'avmsf[text]'")
    pytest.importorskip("transformers")
    generate = StableAudio.generate

    def ringing(self, prompt, *, seconds, seed):
        """Let what a random network makes die away, for in its noise there are no modes."""
        made = generate(self, prompt, seconds=seconds, seed=seed, steps=5)
        return made * torch.exp(-40.0 * torch.arange(len(made)) / self.sample_rate)

    monkeypatch.setattr(StableAudio, "generate", ringing)
    save_clap(plates.parent / "clap")
    model, clap = save_audio(plates.parent / "audio"), plates.parent / "clap"
    words = sets(f"edit.model={model} edit.clap={clap} edit.generated=0.5")
    methods = ("unedited", "generation", "edit-independent")
    record, folder = edited(plates, "--objects", "a-ceramic", "--methods", ",".join(methods), *words)
    assert [case.key for case in record.cases] == [f"edit: ceramic to wood: {prompt}" for prompt in PROMPTS["wood"]]
    assert [each.method for each in record.outcomes] == [*methods] * 2
    assert all(len(each.values["clap"]) == 8 and "spectral" not in each.values for each in record.outcomes)
    assert [step for step, _ in record.outcomes[2].report["clap"]] == [0, 1]
    assert (folder / "figures" / "clap.png").exists()


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        (("edit", "--methods", "knn3"), "method", "knn3"),
        (("farthest", "--methods", "unedited"), "method", "unedited"),
        (("edit", "--set", "edit.clap=folder"), "edit.clap", None),
        (("edit", "--set", "edit.fields=knn3"), "edit.fields", "knn3"),
    ],
)
def test_what_makes_no_edit_is_refused(words: tuple[str, ...], name: str, value: str | None, plates: Path) -> None:
    with raises(EvaluationError, name=name, value=value):
        run_verb("evaluate", words[0], str(plates), *words[1:])
