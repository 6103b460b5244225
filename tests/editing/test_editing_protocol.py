"""The protocol of editing: its objects, its methods, and scores that can be told beforehand."""

import json
import math
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
import torch

from avmsf.capture.folder import Capture
from avmsf.datasets.numbering import REALIMPACT_NAMES, material_in, number_of
from avmsf.datasets.realimpact import SELF_INTERSECTING
from avmsf.editing.config import DistillationConfig
from avmsf.editing.reference import Reference
from avmsf.editing.stable_audio import StableAudio
from avmsf.errors import AvmsfWarning, EditError, EvaluationError, SimulationError
from avmsf.evaluation.clap import Clap
from avmsf.features.feature_field import FeatureField
from avmsf.fem.elastic_modes import elastic_modes
from avmsf.fem.material import GLASS, MATERIALS, STEEL, WOOD
from avmsf.modal.extraction.extract import extract_sounds
from avmsf.modal.extraction.finders import ShortTime
from avmsf.modal.modes import ModalBank
from benchmarks import editingprotocol as protocol
from benchmarks.editing import (
    PHYSICS,
    PROMPTS,
    RECORDED_TRANSITIONS,
    UNTOUCHED,
    EditMethod,
    EditTask,
    generation,
    prompted_tasks,
    score_edits,
    spectral_distance,
    towards_reference,
    towards_words,
)
from benchmarks.editing_objects import (
    PUBLISHED,
    REALIMPACT_26,
    KnownObject,
    audible_modes,
    paper_object,
    recorded_objects,
)
from benchmarks.editingprotocol import SEVEN_TRANSITIONS, SIMULATED_TRANSITIONS
from benchmarks.mode_embedding import FEATURES, MaterialSpace
from benchmarks.simulatedobjects import SolvedShape
from factories.made_audio import save_audio
from factories.made_clap import save_clap
from factories.made_modes import sliding_plate
from factories.plate_field import plate_impacts
from factories.raising import raises, warns
from oracles.block import block

RATE = 16000.0
QUICK = {"steps": 3, "contacts_per_step": 2, "fft_sizes": (512, 128)}


@cache
def plate() -> SolvedShape:
    elastic = sliding_plate((300.0, 610.0, 990.0, 1010.0, 1700.0, 2100.0), material=STEEL)
    # A blow on the plate's edge would be silent, for its modes move across it alone.
    up = elastic.shapes[..., 2:]
    return SolvedShape("plate", replace(elastic, shapes=torch.cat([0.5 * up, 0.3 * up, up], dim=2)))


@cache
def struck(material: str, size: float = 1.0) -> KnownObject:
    return plate().struck(MATERIALS[material], size=size, sample_rate=RATE, seconds=0.15)


def reference_to(known: KnownObject) -> Reference:
    return Reference.of(known.impacts.sounds, sample_rate=RATE, name=known.name)


def embedded(space: MaterialSpace, points: np.ndarray) -> MaterialSpace:
    """Return the space with an embedding that is made up: UMAP would have to be compiled."""
    vars(space)["embedding"] = points
    return space


def flat_space(features: str = "rings") -> MaterialSpace:
    """A space of plates in three materials with all points of its embedding at zero."""
    objects = [struck(material, size) for material in ("ceramic", "wood", "glass") for size in (0.8, 1.0, 1.3)]
    space = MaterialSpace.of([each.bank for each in objects], [each.material for each in objects], features=features)
    return embedded(space, np.zeros((9, 2), dtype=np.float32))


@pytest.fixture
def space(monkeypatch) -> MaterialSpace:
    monkeypatch.setattr(MaterialSpace, "place", lambda self, bank: np.array([3.0, 4.0], dtype=np.float32))
    return flat_space()


def test_a_shape_remade_is_one_solved_anew():
    sides, cells, size = (0.11, 0.05, 0.02), (3, 2, 1), 1.7
    solved = SolvedShape("block", elastic_modes(block(sides, cells), replace(STEEL, poisson=0.27), count=5))
    remade = solved.remade(WOOD, size=size)
    anew = elastic_modes(block(tuple(size * side for side in sides), cells), replace(WOOD, poisson=0.27), count=5)
    assert torch.allclose(remade.frequency, anew.frequency, rtol=1e-7, atol=0.0)
    assert remade.mass == pytest.approx(anew.mass, rel=1e-12)
    places = anew.nodes[::7]
    up = torch.tensor([[0.3, 0.5, 0.8]], dtype=torch.float64).expand(len(places), -1)
    # Shapes have a sign by chance.
    assert torch.allclose(remade.gains(places, up).abs(), anew.gains(places, up).abs(), rtol=1e-4, atol=1e-6)


def test_a_field_of_an_object_sounds_as_recorded():
    known = struck("ceramic")
    rendered = known.sound_field.render(known.impacts.contacts, directions=known.impacts.directions)
    error = (rendered - known.impacts.sounds).norm() / known.impacts.sounds.norm()
    assert float(error) < 0.05


def test_only_modes_that_are_heard_count():
    bank = ModalBank(torch.tensor([100.0, 200.0, 300.0, 9000.0], dtype=torch.float64), torch.full((4,), 5.0).double())
    # Energies of 0, -60.2 and -59.2 dB, and the loudest of all beyond half the sample rate.
    amplitudes = torch.tensor([[1.0, 0.98e-3, 1.1e-3, 50.0]])
    assert audible_modes(bank, amplitudes, sample_rate=RATE).frequency.tolist() == [100.0, 300.0]
    assert audible_modes(bank, amplitudes).frequency.tolist() == [100.0, 9000.0]
    # A quarter of the damping is four times the energy.
    slow = replace(bank, damping=torch.tensor([5.0, 1.25, 5.0, 5.0], dtype=torch.float64))
    assert audible_modes(slow, amplitudes, sample_rate=RATE).frequency.tolist() == [100.0, 200.0, 300.0]
    with raises(EvaluationError, name="bank", value=4):
        audible_modes(bank, amplitudes, sample_rate=100.0)


def test_the_26_objects_follow_the_rule_that_is_told():
    def told(name: str) -> str | None:
        words = {"Plastic": "plastic", "Metal": "metal"}
        named = material_in(name) or next((each for word, each in words.items() if word in name), None)
        return "metal" if named == "iron" else named

    fit = [name for name in REALIMPACT_NAMES if told(name) and number_of(name) not in SELF_INTERSECTING]
    expected = {name for each in set(map(told, fit)) for name in [one for one in fit if told(one) == each][:7]}
    assert set(REALIMPACT_26) == expected
    assert len(REALIMPACT_26) == 26
    assert all(told(name) == material for name, material in REALIMPACT_26.items())


class Recorded:
    """A dataset of plates under RealImpact's names."""

    def __init__(self, *names: str) -> None:
        self.names = names

    def objects(self) -> tuple[str, ...]:
        return self.names

    def capture(self, identifier: str) -> Capture:
        return Capture(identifier, plate_impacts(4), None)


def test_recorded_objects_are_those_there_are():
    found = recorded_objects(Recorded("68_WoodBoard", "94_GlassGoblet", "59_stand"))
    assert [(each.name, each.material) for each in found] == [("68_WoodBoard", "wood"), ("94_GlassGoblet", "glass")]
    assert len(found[0].bank) > 3


def test_the_papers_objects_have_short_time_modes_and_a_trained_network():
    dataset, asked = Recorded("68_WoodBoard"), []

    def features(name: str) -> FeatureField:
        asked.append(name)
        return FeatureField.from_points(plate_impacts(4).contacts)

    config = replace(PUBLISHED, warmup_steps=1, steps=1, clusters=4)
    (found,) = recorded_objects(dataset, make=partial(paper_object, features=features, config=config))
    sounds = plate_impacts(4).sounds
    modes = extract_sounds(sounds, sample_rate=plate_impacts(4).sample_rate, method=ShortTime())
    assert torch.equal(found.modes.bank.frequency, modes.bank.frequency)
    assert asked == []
    assert found.sound_field.origin.report["gain_model"] == "attention"
    assert asked == ["68_WoodBoard"]
    assert float(found.sound_field.residual.magnitude.max()) > 0


@pytest.fixture
def plates_alone(monkeypatch) -> None:
    """Let the simulated protocol's shapes all be plates, and its sounds short."""
    monkeypatch.setattr(SolvedShape, "of", classmethod(lambda cls, kind, *, seed: replace(plate(), kind=kind)))
    struck = SolvedShape.struck
    monkeypatch.setattr(
        SolvedShape,
        "struck",
        lambda self, material, *, size: struck(self, material, size=size, sample_rate=RATE, seconds=0.1),
    )
    # Judged by plain distances: UMAP takes its time to compile.
    monkeypatch.setattr(MaterialSpace, "embedding", property(lambda self: np.zeros((len(self.vectors), 2))))
    monkeypatch.setattr(MaterialSpace, "place", lambda self, bank: FEATURES[self.features](bank)[:2])


def scored(record: Path) -> set[tuple[str, str, str]]:
    """Return the method, the first material and the second of every score in a file."""
    scores = json.loads(record.read_text(encoding="utf-8"))["scores"]
    return {(each["method"], each["source"], each["target"]) for each in scores}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`torch.nn.utils.weight_norm` is deprecated:FutureWarning")
def test_the_protocol_of_words_runs_on_simulated_objects(plates_alone, tmp_path, monkeypatch, capsys):
    pytest.importorskip("diffusers", reason="needs pip install 'avmsf[text]'")
    pytest.importorskip("transformers")
    monkeypatch.setattr(protocol, "SEVEN_TRANSITIONS", SEVEN_TRANSITIONS[3:4])
    generate = StableAudio.generate

    def ringing(self, prompt, *, seconds, seed):
        """Let what a random network says die away, for in its noise there are no modes."""
        made = generate(self, prompt, seconds=seconds, seed=seed, steps=5)
        return made * torch.exp(-40.0 * torch.arange(len(made)) / self.sample_rate)

    monkeypatch.setattr(StableAudio, "generate", ringing)
    save_clap(tmp_path / "clap")
    model, record = save_audio(tmp_path / "tiny-audio"), tmp_path / "scores.json"
    words = ["--simulated", "--model", str(model), "--clap", str(tmp_path / "clap"), "--generated", "0.5"]
    assert protocol.main([*words, "--steps", "1", "--record", str(record)]) == 0
    methods = ("before", "generation", "audio-sds", "hierarchical")
    assert scored(record) == {(name, "steel", "plastic") for name in methods}
    scores = json.loads(record.read_text(encoding="utf-8"))["scores"]
    # Two strangers, two prompts.
    assert [sum(each["method"] == name for each in scores) for name in methods] == [4] * 4
    assert {each["prompt"] for each in scores} == {*PROMPTS["plastic"]}
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])
    for name in methods:
        assert figures[f"simulated.clap_{name}"] == pytest.approx(
            np.mean([each["clap"] for each in scores if each["method"] == name])
        )
        assert math.isfinite(figures[f"simulated.umap_{name}"])
    # Strangers make no cluster.
    assert len(json.loads(record.read_text(encoding="utf-8"))["spaces"]["pitches"]["names"]) == 4 * 7


@pytest.mark.slow
def test_the_simulated_protocol_without_a_model_goes_by_recordings(plates_alone, tmp_path, monkeypatch):
    monkeypatch.setattr(protocol, "SEVEN_TRANSITIONS", SEVEN_TRANSITIONS[5:6])
    record = tmp_path / "scores.json"
    assert protocol.main(["--simulated", "--steps", "1", "--record", str(record)]) == 0
    methods = ("before", "unconstrained", "hierarchical", "physics")
    assert scored(record) == {(name, "iron", "polycarbonate") for name in methods}


@pytest.mark.parametrize(
    "error", [EditError("diverged", value=3), EvaluationError("no audible mode", value=9), "silence"]
)
def test_an_edit_that_fails_costs_its_own_score_alone(space, error):
    def fail(task):
        raise error

    class Silence(Generator):
        def generate(self, prompt, *, seconds, seed):
            return torch.zeros(8000)

    failing = generation(Silence()) if error == "silence" else EditMethod("failing", fail)
    task = EditTask(struck("ceramic"), "glass", prompt="glass")
    with warns(AvmsfWarning, name=f"plate-ceramic to glass, {failing.name}"):
        scores = score_edits([task], (failing, UNTOUCHED), {"flat": space})
    assert [each.method for each in scores] == ["before"]


def test_every_transition_has_two_prompts_for_every_object():
    for _, target in (*RECORDED_TRANSITIONS, *SIMULATED_TRANSITIONS, *SEVEN_TRANSITIONS):
        assert len(set(PROMPTS[target])) == 2
    tasks = prompted_tasks([struck("ceramic"), struck("glass")], SIMULATED_TRANSITIONS)
    assert [(task.object.name, task.target, task.prompt) for task in tasks] == [
        (f"plate-{source}", target, prompt)
        for source, target in (("ceramic", "wood"), ("glass", "steel"))
        for prompt in PROMPTS[target]
    ]


def test_physics_reaches_the_object_of_the_new_material(space):
    wanted = struck("wood")
    (after,) = score_edits([EditTask(struck("ceramic"), "wood")], (PHYSICS,), {"flat": space})
    made = PHYSICS.edit(EditTask(struck("ceramic"), "wood"))
    assert torch.allclose(made.bank.frequency, wanted.bank.frequency[: len(made.bank)], rtol=1e-6)
    assert torch.allclose(made.bank.damping, wanted.bank.damping[: len(made.bank)], rtol=1e-6)
    assert after.umap["flat"] == pytest.approx(5.0)
    with raises(SimulationError, name="material", value="metal"):
        PHYSICS.edit(EditTask(struck("ceramic"), "metal"))


def test_the_spectral_distance_is_free_of_level():
    known = struck("glass")
    own = UNTOUCHED.edit(EditTask(known, "wood"))
    sounds = known.impacts.sounds[:3]
    made = replace(own, sounds=7.0 * sounds)
    assert spectral_distance(made, reference_to(known)) == pytest.approx(0.0, abs=1e-5)
    assert spectral_distance(replace(made, sounds=0.0 * sounds), reference_to(known)) == pytest.approx(1.0)
    assert spectral_distance(made, reference_to(struck("wood"))) > 0.5
    with raises(EvaluationError, name="reference", value=16000.0):
        spectral_distance(replace(made, sample_rate=8000.0), reference_to(known))


def test_a_common_pitch_reaches_what_single_modes_do_not():
    # The same plate of steel, higher by a factor: a common pitch is all there is to find.
    task = EditTask(struck("steel"), "glass", reference=reference_to(struck("steel", 0.8)))
    methods = {each.name: each for each in towards_reference(QUICK)}
    assert list(methods) == ["before", "unconstrained", "hierarchical", "physics"]
    before, single, common = (methods[name].edit(task) for name in ("before", "unconstrained", "hierarchical"))
    distance = [spectral_distance(made, task.reference) for made in (before, single, common)]
    assert distance[2] < 0.7 * min(distance[:2])
    wanted = struck("steel", 0.8).bank.frequency
    apart = [float((made.bank.frequency / wanted).log2().abs().max()) for made in (single, common)]
    # An octave's third; a few steps of single modes are a few hundredths, and a search ends within a semitone's half.
    assert apart[0] > 0.25
    assert apart[1] < 0.05


class Generator:
    """Makes a plate of glass from any words, half a second too late; its latents are waveforms."""

    name, sample_rate, channels = "generator", RATE, 1
    device, dtype = torch.device("cpu"), torch.float32

    def describe(self):
        return {}

    def encode(self, waveforms):
        return waveforms

    def decode(self, latents, *, samples):
        return latents[:, :, :samples]

    def embed(self, prompt, negative, *, seconds):
        return prompt

    def denoised(self, latents, level, conditioning, *, guidance):
        return latents

    def generate(self, prompt: str, *, seconds: float, seed: int) -> torch.Tensor:
        sounds = plate().struck(GLASS, sample_rate=RATE, seconds=0.4).impacts.sounds
        late = torch.nn.functional.pad(sounds[0], (8000, 0))
        return late / late.abs().max() + 1e-3 * torch.randn(len(late), generator=torch.Generator().manual_seed(seed))


def test_generated_sounds_are_judged_by_their_modes():
    made = generation(Generator()).edit(EditTask(struck("ceramic"), "glass", prompt="glass"))
    wanted = struck("glass").bank.frequency
    nearest = (made.bank.frequency[:, None] / wanted).log2().abs().amin(dim=1)
    # Half a semitone is .04; the sound's onset is found, not known.
    assert float(nearest.max()) < 0.005
    assert len(made.bank) >= 4


def test_words_have_the_papers_methods(space, monkeypatch):
    methods = towards_words(Generator(), {**QUICK, "steps": 1}, distillation=DistillationConfig(denoising=1))
    assert [each.name for each in methods] == ["before", "generation", "audio-sds", "hierarchical"]
    heard = []
    monkeypatch.setattr(
        Clap, "score", lambda self, sounds, prompts, *, sample_rate: heard.append(prompts) or torch.tensor([0.2, 0.4])
    )
    task = EditTask(struck("ceramic"), "glass", prompt="a glass is struck")
    scores = score_edits([task], methods, {"flat": space}, clap=Clap(None, None, "none", "none"))
    assert [score.clap for score in scores] == pytest.approx([0.3] * 4)
    assert heard == [["a glass is struck"]] * 4
    assert all(score.spectral is None for score in scores)
    with raises(EvaluationError, name="prompt"):
        methods[1].edit(replace(task, prompt=None))
    with raises(EvaluationError, name="reference"):
        towards_reference(QUICK)[1].edit(task)
