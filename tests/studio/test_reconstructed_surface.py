"""The surface that was reconstructed is served beside the Gaussians that it was made of, and not beside a mesh."""

import io
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from avmsf.field.store import save
from avmsf.gaussians.initialize import StartPoints, starting_cloud
from avmsf.gaussians.ply import write_splats
from avmsf.pipeline.config import CACHE, CACHED_FIELD, SURFACE
from avmsf.pipeline.scene import CLOUD
from avmsf.studio.opening import find_reconstructed, open_target
from opened_plate import plate_field
from served import served

SIDES = (0.24, 0.16, 0.02)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Return a capture folder in which Gaussians, a surface and a field were made."""
    folder = tmp_path / "plate"
    kept = folder / CACHE
    kept.mkdir(parents=True)
    points = plate_field().gain_field.points.float()
    write_splats(
        starting_cloud(
            StartPoints(points, torch.full_like(points, 0.5)), degree=0, scale=1.0, opacity=0.9, flatness=0.5
        ),
        kept / CLOUD,
    )
    box = trimesh.creation.box(np.ptp(points.numpy(), axis=0) + 0.01)
    box.apply_translation((points.amax(0) + points.amin(0)).numpy() / 2)
    box.export(kept / SURFACE)
    save(plate_field(), kept / CACHED_FIELD)
    # Coordinates of the capture's own files do not count for what was made of them.
    (folder / "capture.toml").write_text('unit = "mm"\n')
    return folder


def test_the_page_gets_the_surface_beside_the_gaussians(capture: Path, tmp_path: Path) -> None:
    with served(open_target(capture), tmp_path / "served") as page:
        # Files of the object are those of the first revision.
        assert page.ask("POST", "edit", {"base": 1, "pitch": 1.1}).status == 200
        manifest = page.manifest()
        assert manifest["live"]["revision"] == 2
        assert manifest["object"] == {"kind": "gaussians", "file": "object.ply"}
        assert manifest["surface"] == {"kind": "mesh", "file": "surface.glb"}
        content = page.get("surface.glb").content
    shown = trimesh.load(io.BytesIO(content), file_type="glb", force="mesh")
    np.testing.assert_allclose(shown.bounds, trimesh.load(capture / CACHE / SURFACE).bounds, atol=1e-6)


def test_a_mesh_of_the_objects_own_needs_no_other(capture: Path, tmp_path: Path) -> None:
    assert find_reconstructed(open_target(capture)) == (capture / CACHE / SURFACE).resolve()
    trimesh.creation.box([1000 * side for side in SIDES]).export(capture / "surface.stl")
    opened = open_target(capture)
    assert find_reconstructed(opened) is None
    with served(opened, tmp_path / "served") as page:
        manifest = page.manifest()
        assert (manifest["object"]["kind"], manifest["surface"]) == ("mesh", None)
        assert page.get("surface.glb").status == 404
