"""The paper's method in an evaluation: its own extraction, its features, and an encoder that is never replaced."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from avmsf.datasets import CaptureCollection
from avmsf.errors import EvaluationError, SceneError
from avmsf.evaluation.case_run import Evaluation
from avmsf.evaluation.field_methods import NETWORK, FieldMethod
from avmsf.evaluation.methods import method_named
from avmsf.evaluation.plan import available_encoders, visual_inputs
from avmsf.evaluation.registry import PROTOCOLS
from avmsf.evaluation.results import ResultsFolder
from avmsf.evaluation.scores import MetricSettings
from avmsf.evaluation.task import Task
from avmsf.features.descriptors import ImageDescriptors
from avmsf.features.encoder import Encoder
from avmsf.modal.extraction.finders import ShortTime
from avmsf.pipeline.config import DESCRIPTORS, DINO, PRESETS, LiftConfig
from avmsf.pipeline.features import DinoEncoder
from factories.plate_field import QUICK, plate_features, plate_impacts
from factories.plate_set import PlateInputs
from factories.raising import raises


@pytest.mark.parametrize(
    ("name", "damping"), [("paper", "shared"), ("paper-grid", "shared"), ("paper-per-contact", "per-contact")]
)
def test_the_method_is_the_preset_with_one_damping(name: str, damping: Any) -> None:
    field: Any = method_named(name)
    preset = PRESETS["paper"]
    assert field.pipeline == replace(preset, fit=replace(preset.fit, damping=damping))
    assert (field.visual_input, field.published) == ("paper", True)


def test_a_method_may_find_modes_in_its_own_way() -> None:
    impacts = plate_impacts()

    def shared() -> Any:
        raise AssertionError("the shared modes were asked for")

    task = Task(
        name="plate",
        train=impacts,
        contacts=impacts.contacts,
        names=impacts.names,
        seed=0,
        modes=shared,
        features=lambda look: plate_features(),
        bodies=shared,
        other_recording=shared,
        family=shared,
        gaussians=shared,
    )
    pipeline = replace(NETWORK, extraction="short-time", fit=replace(QUICK, steps=1, correction_rate=0.0))
    field = FieldMethod("quick", pipeline, "paper", published=True).fit(task)
    expected = ShortTime().find(impacts.sounds, impacts.sample_rate)
    assert torch.allclose(field.bank.frequency, expected.frequency)


@pytest.fixture
def no_dino(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: Any, **__: Any) -> DinoEncoder:
        raise SceneError("facebook/dinov2-base: no weights", value="facebook/dinov2-base")

    monkeypatch.setattr(DinoEncoder, "load", missing)


@pytest.mark.usefixtures("no_dino")
def test_an_encoder_that_is_not_there_is_refused_by_the_paper_and_said_elsewhere() -> None:
    said = list[str]()
    with raises(SceneError, value="facebook/dinov2-base"):
        available_encoders(LiftConfig(), {"visual", "paper"}, log=said.append)
    usual, paper = available_encoders(LiftConfig(), {"visual"}, log=said.append)
    assert (usual.encoder, paper.encoder) == (DESCRIPTORS, DINO)
    assert any("descriptors" in line for line in said)
    named = available_encoders(LiftConfig(encoder=DESCRIPTORS), {"paper"}, log=said.append)
    assert [each.encoder for each in named] == [DESCRIPTORS, DESCRIPTORS]
    assert named[1].onto == "gaussians"


def test_encoders_are_loaded_once_on_the_device_and_only_for_who_reads_them(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded, said = [], list[str]()

    def load(name: str, *, device: torch.device, **_: Any) -> Encoder:
        loaded.append((name, device.type))
        return ImageDescriptors()

    monkeypatch.setattr(DinoEncoder, "load", load)

    def read_by(protocol: str, *names: str) -> frozenset[Any]:
        return visual_inputs([method_named(name) for name in names], PROTOCOLS[protocol])

    read = read_by("farthest", "knn3", "white-noise", "diffsound")
    assert available_encoders(LiftConfig(), read, device="cpu", log=said.append)[0] == LiftConfig()
    assert available_encoders(LiftConfig(), read_by("localize", "field-auto"), log=said.append)[0] == LiftConfig()
    assert loaded == []
    # Recordings are located at the points that features have.
    assert read_by("localize", "nearest") == {"surface"}
    read = read_by("farthest", "field", "field-auto", "paper-grid")
    assert read == {"visual", "surface", "paper"}
    assert available_encoders(LiftConfig(), read, device="cpu", log=said.append)[0].encoder == DINO
    assert loaded == [(DINO, "cpu")]


def test_methods_without_features_share_results_with_any_encoder(tmp_path: Path) -> None:
    def begin(name: str, encoder: str | None) -> None:
        evaluation = Evaluation(
            CaptureCollection(tmp_path), "plates", PROTOCOLS["farthest"], (method_named(name),), PlateInputs(),
            metric_settings=MetricSettings(cdpam=False), encoder=encoder,
        )  # fmt: skip
        evaluation.begin(ResultsFolder(tmp_path / "results"))

    begin("knn3", None)
    begin("field", DESCRIPTORS)
    begin("knn3", DESCRIPTORS)
    with raises(EvaluationError, name="field"):
        begin("field", DINO)
