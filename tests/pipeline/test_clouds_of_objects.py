"""An object's Gaussians in an evaluation: those of its folder, or an error where nothing shows it."""

from pathlib import Path

import pytest
import torch

from avmsf.datasets import CaptureCollection
from avmsf.errors import SceneError
from avmsf.evaluation.objects import ObjectInputs
from avmsf.gaussians.ply import write_splats
from factories.plate_capture import fill_plate
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
