"""The paper's method in an evaluation, and encoders that are loaded once and never replaced unsaid."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from avmsf.datasets import CaptureCollection
from avmsf.errors import EvaluationError, SceneError
from avmsf.evaluation.methods import method_named
from avmsf.evaluation.plan import Evaluation, available_encoders, visual_inputs
from avmsf.evaluation.registry import PROTOCOLS, MetricSettings
from avmsf.evaluation.results import ResultsFolder
from avmsf.features.descriptors import ImageDescriptors
from avmsf.features.encoder import Encoder
from avmsf.pipeline.config import DESCRIPTORS, DINO, PRESETS, LiftConfig
from avmsf.pipeline.features import DinoEncoder
from factories.plate_set import PlateInputs
from factories.raising import raises


@pytest.mark.parametrize(
    ("name", "damping"),
    [("av-msf", "validated"), ("paper", "shared"), ("paper-grid", "shared"), ("paper-per-contact", "per-contact")],
)
def test_the_papers_method_is_the_preset_with_one_damping(name: str, damping: Any) -> None:
    field: Any = method_named(name)
    preset = PRESETS["paper"]
    assert field.pipeline == replace(preset, fit=replace(preset.fit, damping=damping))
    assert (field.pipeline == preset) == (name == "av-msf")
    assert (field.visual_input, field.published) == ("paper", True)


def test_an_encoder_that_is_not_there_is_refused_by_the_paper_and_said_elsewhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def missing(*_: Any, **__: Any) -> DinoEncoder:
        raise SceneError("facebook/dinov2-base: no weights", value="facebook/dinov2-base")

    monkeypatch.setattr(DinoEncoder, "load", missing)
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
    # Recordings are located at the points that features have.
    assert read_by("localize", "nearest") == read_by("localize", "field-auto") == {"surface"}
    assert available_encoders(LiftConfig(), {"surface"}, log=said.append)[0] == LiftConfig()
    assert loaded == []
    read = read_by("farthest", "field", "field-auto", "paper-grid")
    assert read == {"visual", "surface", "paper"}
    assert available_encoders(LiftConfig(), read, device="cpu", log=said.append)[0].encoder == DINO
    assert loaded == [(DINO, "cpu")]


def test_methods_without_features_share_results_with_any_encoder(tmp_path: Path) -> None:
    def begin(name: str, encoder: str | None) -> None:
        methods, settings = (method_named(name),), MetricSettings(cdpam=False)
        evaluation = Evaluation(
            "plates", PROTOCOLS["farthest"], methods, PlateInputs(CaptureCollection(tmp_path), tmp_path), settings,
            encoder=encoder,
        )  # fmt: skip
        evaluation.begin(ResultsFolder(tmp_path / "results"))

    begin("knn3", None)
    begin("field", DESCRIPTORS)
    begin("knn3", DESCRIPTORS)
    with raises(EvaluationError, name="methods.field.encoder", value=DESCRIPTORS):
        begin("field", DINO)
