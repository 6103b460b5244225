"""What decides whether a stage runs again: its inputs and the code, not the state of the machine."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import pytest
import torch

import avmsf.pipeline.fit as module
from avmsf.capture import read_capture
from avmsf.editing import guided
from avmsf.errors import SimulationError
from avmsf.fem import candidate_bodies as nominal
from avmsf.fem.candidate_bodies import CandidateBodies, SurfaceBodies
from avmsf.field import fit as field_fit
from avmsf.field.config import FitConfig
from avmsf.field.fit import fingerprint
from avmsf.field.gains.data import gain_data
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.store import load
from avmsf.mesh.surface import Surface
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import BodyConfig, PipelineConfig
from avmsf.pipeline.stages import StageFolder
from avmsf.simulate import recipe
from factories.plate_capture import fill_plate
from factories.plate_field import plate_extraction, plate_features, plate_impacts
from factories.ringing_field import ringing_field


def body_key() -> set[str]:
    """Return the names of the cached files of the bodies of a triangle with a wall."""
    with TemporaryDirectory() as folder:
        surface = Surface(torch.eye(3), torch.tensor([[0, 1, 2]]))
        SurfaceBodies(surface, count=2, dofs=1000, cache=Path(folder)).modes(0.01)
        return {each.name for each in Path(folder).iterdir()}


def fit_key() -> str:
    impacts = plate_impacts(6, seconds=0.1)
    case = gain_data(impacts, plate_features(60), plate_extraction(impacts), FitConfig())
    return fingerprint(case, MixtureEstimator())


def edit_key() -> dict[str, str]:
    field = ringing_field()
    return guided.checkpoint_identity(field, field.gain_field.points[:2], {}, {})


@pytest.mark.parametrize(
    ("module", "key"),
    [
        (recipe, lambda: recipe.ObjectRecipe().elastic_values()),
        (nominal, body_key),
        (field_fit, fit_key),
        (guided, edit_key),
    ],
    ids=["elastic modes", "body", "fit", "edit"],
)
def test_other_code_has_another_key(
    module: ModuleType, key: Callable[[], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = key()
    assert key() == before
    monkeypatch.setattr(module, "source_digest", lambda module: "changed")
    assert key() != before


def test_the_checkpoint_of_an_edit_is_of_one_field_alone() -> None:
    field, changed = ringing_field(), ({"pitch": 1.001}, {"damping": 1.001}, {"level": 1.001}, {"seconds": 0.501})
    others = [*(ringing_field(**each) for each in changed), replace(field, phase=field.phase + 0.001)]
    contacts = field.gain_field.points[:2]
    keys = [guided.checkpoint_identity(each, contacts, {}, {})["field"] for each in (field, *others)]
    assert len(set(keys)) == len(keys)


@pytest.mark.slow
def test_a_field_does_not_depend_on_free_memory_and_is_made_again_once_there_are_bodies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = read_capture(fill_plate(tmp_path / "plate"))
    failures: list[Exception | None] = []

    def bodies(*arguments: Any, **named: Any) -> CandidateBodies:
        if (failure := failures.pop()) is not None:
            raise failure
        return candidate_bodies(*arguments, **named)

    monkeypatch.setattr(module, "candidate_bodies", bodies)
    settings = FitConfig(steps=2, fft_sizes=(1024, 256))
    config = PipelineConfig(body=BodyConfig(wall=0.004, shapes=8, dofs=1000), fit=settings, modes=6)
    folder = StageFolder(tmp_path / "cache")

    def run(failure: Exception | None = None) -> bool:
        """Return whether the field was made now."""
        failures[:] = [failure]
        return module.fit_in_stages(capture, config, folder).stages["field.safetensors"].fresh

    assert run(SimulationError("3.1 GB are free"))
    assert not run(SimulationError("2.9 GB are free"))
    assert run()
    assert load(folder.path("field.safetensors")).origin.report["unavailable"] == {}
    assert not run()
    # Bodies were not asked for.
    assert failures == [None]
