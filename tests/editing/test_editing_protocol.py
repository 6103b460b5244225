"""The benchmark's protocol of editing: its objects, its scores, its record and the figures of that record."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from avmsf.datasets.numbering import REALIMPACT_NAMES, material_in, number_of
from avmsf.datasets.realimpact import SELF_INTERSECTING
from avmsf.editing.reference import Reference
from avmsf.editing.stable_audio import StableAudio
from avmsf.errors import AvmsfWarning, EditError, EvaluationError
from avmsf.fem.elastic_modes import elastic_modes
from avmsf.fem.material import MATERIALS, STEEL, WOOD
from avmsf.modal.modes import ModalBank
from benchmarks import editingprotocol as protocol
from benchmarks.editing import (
    PHYSICS,
    PROMPTS,
    UNTOUCHED,
    EditMethod,
    EditTask,
    score_edits,
    spectral_distance,
)
from benchmarks.editing_objects import REALIMPACT_26, KnownObject, audible_modes
from benchmarks.editingprotocol import SEVEN_TRANSITIONS
from benchmarks.mode_embedding import FEATURES, MaterialSpace
from benchmarks.simulatedobjects import SolvedShape
from factories.made_audio import save_audio
from factories.made_clap import save_clap
from factories.made_modes import sliding_plate
from factories.raising import raises, warns
from oracles.block import block

RATE = 16000.0


@cache
def plate() -> SolvedShape:
    elastic = sliding_plate((300.0, 610.0, 990.0, 1010.0, 1700.0, 2100.0), material=STEEL)
    # An impact on the plate's edge would be silent, for its modes move across it alone.
    up = elastic.shapes[..., 2:]
    return SolvedShape("plate", replace(elastic, shapes=torch.cat([0.5 * up, 0.3 * up, up], dim=2)))


@cache
def struck(material: str) -> KnownObject:
    return plate().struck(MATERIALS[material], sample_rate=RATE, seconds=0.15)


@pytest.fixture(autouse=True)
def plain_places(monkeypatch) -> None:
    """Place objects by two components of their vectors: UMAP takes its time to compile."""
    monkeypatch.setattr(MaterialSpace, "embedding", property(lambda self: np.zeros((len(self.vectors), 2))))
    monkeypatch.setattr(MaterialSpace, "place", lambda self, bank: FEATURES[self.features](bank)[:2])


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


def test_only_modes_that_are_audible_count():
    bank = ModalBank(torch.tensor([100.0, 200.0, 300.0, 9000.0], dtype=torch.float64), torch.full((4,), 5.0).double())
    # Energies of 0, -60.2 and -59.2 dB, and the loudest of all beyond half the sample rate.
    amplitudes = torch.tensor([[1.0, 0.98e-3, 1.1e-3, 50.0]])
    assert audible_modes(bank, amplitudes, sample_rate=RATE).frequency.tolist() == [100.0, 300.0]
    assert audible_modes(bank, amplitudes).frequency.tolist() == [100.0, 9000.0]


def test_the_26_objects_follow_the_published_rule():
    def told(name: str) -> str | None:
        words = {"Plastic": "plastic", "Metal": "metal"}
        named = material_in(name) or next((each for word, each in words.items() if word in name), None)
        return "metal" if named == "iron" else named

    fit = [name for name in REALIMPACT_NAMES if told(name) and number_of(name) not in SELF_INTERSECTING]
    expected = {name for each in set(map(told, fit)) for name in [one for one in fit if told(one) == each][:7]}
    assert set(REALIMPACT_26) == expected
    assert len(REALIMPACT_26) == 26
    assert all(told(name) == material for name, material in REALIMPACT_26.items())


def test_physics_reaches_the_object_of_the_new_material_and_a_failure_costs_its_own_score_alone():
    def fail(task):
        raise EditError("diverged", value=3)

    wanted, task = struck("wood"), EditTask(struck("ceramic"), "wood")
    made = PHYSICS.edit(task)
    assert torch.allclose(made.bank.frequency, wanted.bank.frequency[: len(made.bank)], rtol=1e-6)
    assert torch.allclose(made.bank.damping, wanted.bank.damping[: len(made.bank)], rtol=1e-6)
    objects = [struck(material) for material in ("ceramic", "wood", "glass")] * 2
    space = MaterialSpace.of([each.bank for each in objects], [each.material for each in objects], features="rings")
    with warns(AvmsfWarning, name="plate-ceramic to wood, failing"):
        scores = score_edits([task], (EditMethod("failing", fail), UNTOUCHED), {"flat": space})
    assert [each.method for each in scores] == ["before"]


def test_the_spectral_distance_is_free_of_level():
    known, other = (Reference.of(struck(each).impacts.sounds, sample_rate=RATE) for each in ("glass", "wood"))
    sounds = struck("glass").impacts.sounds[:3]
    made = replace(UNTOUCHED.edit(EditTask(struck("glass"), "wood")), sounds=7.0 * sounds)
    assert spectral_distance(made, known) == pytest.approx(0.0, abs=1e-5)
    assert spectral_distance(replace(made, sounds=0.0 * sounds), known) == pytest.approx(1.0)
    assert spectral_distance(made, other) > 0.5
    with raises(EvaluationError, name="reference", value=16000.0):
        spectral_distance(replace(made, sample_rate=8000.0), known)


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


def scored(record: Path) -> set[tuple[str, str, str]]:
    """Return the method, the first material and the second of every score in a file."""
    scores = json.loads(record.read_text(encoding="utf-8"))["scores"]
    return {(each["method"], each["source"], each["target"]) for each in scores}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`torch.nn.utils.weight_norm` is deprecated:FutureWarning")
def test_the_protocol_of_words_runs_on_simulated_objects_and_its_record_is_drawn(plates_alone, tmp_path, monkeypatch):
    pytest.importorskip("diffusers", reason="needs pip install 'avmsf[text]'")
    pytest.importorskip("transformers")
    monkeypatch.setattr(protocol, "SEVEN_TRANSITIONS", SEVEN_TRANSITIONS[3:4])
    generate = StableAudio.generate

    def ringing(self, prompt, *, seconds, seed):
        """Let what a random network makes die away, for in its noise there are no modes."""
        made = generate(self, prompt, seconds=seconds, seed=seed, steps=5)
        return made * torch.exp(-40.0 * torch.arange(len(made)) / self.sample_rate)

    monkeypatch.setattr(StableAudio, "generate", ringing)
    save_clap(tmp_path / "clap")
    model, record = save_audio(tmp_path / "tiny-audio"), tmp_path / "scores.json"
    figures = tmp_path / "figures"
    words = ["--simulated", "--model", str(model), "--clap", str(tmp_path / "clap"), "--generated", "0.5"]
    assert protocol.main([*words, "--steps", "1", "--record", str(record), "--figures", str(figures)]) == 0
    methods = ("before", "generation", "audio-sds", "hierarchical")
    assert scored(record) == {(name, "steel", "plastic") for name in methods}
    scores = json.loads(record.read_text(encoding="utf-8"))["scores"]
    # Two shapes, two prompts.
    assert [sum(each["method"] == name for each in scores) for name in methods] == [4] * 4
    assert {each["prompt"] for each in scores} == {*PROMPTS["plastic"]}
    names = {path.name for path in figures.iterdir()}
    assert {"umap-pitches-steel-to-plastic.png", "clap.png"} <= names


@pytest.mark.slow
def test_the_simulated_protocol_without_a_model_goes_by_recordings(plates_alone, tmp_path, monkeypatch):
    monkeypatch.setattr(protocol, "SEVEN_TRANSITIONS", SEVEN_TRANSITIONS[5:6])
    record = tmp_path / "scores.json"
    assert protocol.main(["--simulated", "--steps", "1", "--record", str(record)]) == 0
    methods = ("before", "unconstrained", "hierarchical", "physics")
    assert scored(record) == {(name, "iron", "polycarbonate") for name in methods}
