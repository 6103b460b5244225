"""The paper's method in an evaluation: its own extraction, its features, and an encoder that is never replaced."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from avmsf.bench.fieldmethods import NETWORK, FieldMethod
from avmsf.bench.gridfield import GridField
from avmsf.bench.methods import METHODS
from avmsf.bench.task import Task
from avmsf.cli.evaluate import settled_lifts
from avmsf.config import DESCRIPTORS, DINO, PRESETS, LiftConfig
from avmsf.errors import SceneError
from avmsf.modal.extraction.finders import ShortTime
from avmsf.pipeline.features import DinoEncoder
from plate_field import QUICK, plate_features, plate_impacts
from raising import raises

PAPER = METHODS["paper"]


@pytest.mark.parametrize(
    ("name", "damping"), [("paper", "shared"), ("paper-grid", "shared"), ("paper-per-contact", "per-contact")]
)
def test_the_method_is_the_preset_with_one_damping(name: str, damping: Any) -> None:
    method: Any = METHODS[name]
    field = method.method if isinstance(method, GridField) else method
    preset = PRESETS["paper"]
    assert field.pipeline == replace(preset, fit=replace(preset.fit, damping=damping))
    assert (field.look, field.own_modes) == ("paper", True)


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
        stranger=shared,
    )
    pipeline = replace(NETWORK, method="short-time", fit=replace(QUICK, steps=1, correction_rate=0.0))
    field = FieldMethod("quick", pipeline, "paper", own_modes=True).fit(task)
    expected = ShortTime().find(impacts.sounds, impacts.sample_rate)
    assert torch.allclose(field.bank.frequency, expected.frequency)


@pytest.fixture
def no_dino(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: Any, **__: Any) -> DinoEncoder:
        raise SceneError("facebook/dinov2-base: no weights", value="facebook/dinov2-base")

    monkeypatch.setattr(DinoEncoder, "load", missing)


@pytest.mark.usefixtures("no_dino")
def test_an_encoder_that_is_not_there_is_refused_by_the_paper_and_said_elsewhere(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with raises(SceneError, value="facebook/dinov2-base"):
        settled_lifts(LiftConfig(), [METHODS["knn3"], PAPER])
    usual, paper = settled_lifts(LiftConfig(), [METHODS["knn3"], METHODS["field"]])
    assert (usual.encoder, paper.encoder) == (DESCRIPTORS, DINO)
    assert "descriptors" in capsys.readouterr().err
    named = settled_lifts(LiftConfig(encoder=DESCRIPTORS), [PAPER])
    assert [each.encoder for each in named] == [DESCRIPTORS, DESCRIPTORS]
    assert named[1].onto == "gaussians"
