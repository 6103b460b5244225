"""A field from photographs and impacts alone: its shape becomes bodies, and its wall's thickness reaches the report."""

import json
import shutil
from pathlib import Path

import pytest

from avmsf.cli import main
from avmsf.field.gains.elastic import Elastic
from avmsf.field.store import load
from avmsf.mesh import read_surface
from avmsf.mesh.closest_point import ClosestPoints
from avmsf.photographs.folder import write_frames
from avmsf.pipeline.config import CACHE, SURFACE
from avmsf.simulate.recipe import EXAMPLE, EXAMPLE_FOLDER
from factories.plate_capture import TINY, fill_plate
from factories.settings import sets
from factories.small_scene import SMALL_SPLAT, slab_views

Streams = pytest.CaptureFixture[str]
SMALL = (
    *SMALL_SPLAT,
    *sets("lift.encoder=descriptors lift.points=600 lift.symmetry=false modes=12"),
    *TINY[:-2],
)


@pytest.fixture(scope="module")
def slab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a capture folder with photographs of the slab and impacts on it."""
    folder = fill_plate(tmp_path_factory.mktemp("photographs") / "slab", surface=False)
    write_frames(slab_views(), folder)
    return folder


@pytest.mark.slow
def test_photographs_alone_give_elastic_mode_shapes(slab: Path, capsys: Streams) -> None:
    bodies = (*sets("body.wall=0 body.shapes=6 body.dofs=1500 body.supports=free"),)
    assert main(["fit", str(slab), *SMALL, *bodies, "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    report = made["report"]
    assert Elastic.kind not in report["unavailable"]
    assert report["bodies"][0]["body"].startswith("solid body")
    assert main(["fit", str(slab), *SMALL, *bodies, "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert [each["stage"] for each in again["stages"]] == ["views", "cloud", "features", "surface", "modes", "fit"]
    assert not any(each["fresh"] for each in again["stages"])


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
