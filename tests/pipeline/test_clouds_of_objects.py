"""An object's Gaussians in an evaluation: those of its folder, or an error where nothing shows it."""

from pathlib import Path

import pytest
import torch

from avmsf.datasets import CaptureCollection
from avmsf.errors import SceneError
from avmsf.evaluation.case_run import Evaluation
from avmsf.evaluation.methods import FunctionMethod
from avmsf.evaluation.objects import ObjectInputs
from avmsf.evaluation.registry import PROTOCOLS
from avmsf.evaluation.results import ResultsFolder
from avmsf.evaluation.runner import run_object
from avmsf.evaluation.scores import MetricSettings
from avmsf.evaluation.simple_methods import NearestRecording
from avmsf.evaluation.task import Task
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.ply import write_splats
from factories.plate_capture import fill_plate
from factories.plate_set import PlateInputs, fill_plates
from factories.sonicgauss_cases import cloud


def test_given_gaussians_are_read_and_an_object_that_nothing_shows_is_refused(tmp_path: Path) -> None:
    for name in ("shown", "hidden"):
        fill_plate(tmp_path / "set" / name, surface=False)
    given = cloud(200)
    write_splats(given, tmp_path / "set" / "shown" / "splats.ply")
    looks = ObjectInputs(CaptureCollection(tmp_path / "set"), tmp_path / "cache")
    assert torch.equal(looks.cloud("shown").centers, given.centers)
    assert torch.equal(looks.cloud("shown", views=12).centers, given.centers)
    with pytest.raises(SceneError):
        looks.cloud("hidden")


def test_methods_get_the_gaussians_of_their_object_and_views(tmp_path: Path) -> None:
    asked = []

    class Inputs(PlateInputs):
        def cloud(self, identifier: str, views: int | None = None) -> GaussianCloud:
            asked.append((identifier, views))
            return cloud(7)

    def fit(task: Task) -> NearestRecording:
        assert len(task.gaussians()) == 7
        return NearestRecording(task.train)

    dataset, results = CaptureCollection(fill_plates(tmp_path / "plates")), ResultsFolder(tmp_path / "results")
    settings = MetricSettings(cdpam=False)
    protocol = PROTOCOLS["farthest"]
    run_object(
        Evaluation(dataset, "plates", protocol, (FunctionMethod("asking", fit),), Inputs(), metric_settings=settings),
        "a",
        results,
    )
    record = results.read("a")
    assert record is not None
    assert record.outcomes[0].failure is None
    assert asked == [("a", None)]
