"""A field from photographs and impacts alone: its shape becomes bodies, and its wall's thickness reaches the report."""

import json
import shutil
from pathlib import Path

import pytest

from avmsf.cli import main
from avmsf.field.store import load
from avmsf.mesh import read_surface
from avmsf.mesh.closest_point import ClosestPoints
from avmsf.pipeline.config import CACHE, SURFACE
from avmsf.simulate.recipe import EXAMPLE, EXAMPLE_FOLDER
from factories.settings import sets

Streams = pytest.CaptureFixture[str]


@pytest.mark.slow
def test_the_thickness_of_a_wall_reaches_the_report(tmp_path: Path, capsys: Streams) -> None:
    folder = tmp_path / "mug"
    shutil.copytree(EXAMPLE_FOLDER, folder)
    words = [*sets("splat.steps=400 splat.start_points=3000 lift.encoder=descriptors")]
    words += [*sets("lift.symmetry=false fit.steps=2 modes=32"), "--train-count", "12"]
    bodies = [*sets("body.shapes=16 body.dofs=8000 body.supports=free")]
    assert main(["fit", str(folder), *words, *bodies, "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    found = made["report"]["thickness"]
    assert found["low"] < found["median"] < found["high"]
    assert found["median"] == pytest.approx(EXAMPLE.thickness, rel=0.4)
    field = load(made["field"])
    assert field.origin.report["thickness"] == found
    # Gaussians lie below the surface; the field's points are on it.
    surface = read_surface(folder / CACHE / SURFACE)
    nearest = ClosestPoints(surface.vertices.double().numpy()[surface.faces.numpy()])
    assert nearest(field.gain_field.points.double().numpy()).distances.max() < 1e-6
