import numpy as np
import pytest
import trimesh

from avmsf.mesh.level_set import enclose
from avmsf.photographs.hull import Grid
from avmsf.reconstruction.fairing import fair_hull
from avmsf.reconstruction.visual_hull import Outline, hull_distance
from factories.looked_at import ball, mesh_of, views_of


def _hull(mesh: trimesh.Trimesh, *, taut: bool) -> trimesh.Trimesh:
    outlines = [Outline.of(view) for view in views_of(mesh, azimuths=24)]
    grid = Grid.around(mesh.bounds[0] - 0.03, mesh.bounds[1] + 0.03, cells=96, finest=1.0, margin=2)
    hull = hull_distance(outlines, grid, rank=0)
    values = fair_hull(hull, outlines, grid, float(np.linalg.norm(mesh.extents)))[0] if taut else hull
    return mesh_of(enclose(values, 0.0, lowest=grid.lowest, spacing=grid.spacing))


@pytest.mark.slow
def test_the_pyramid_above_a_flat_top_is_removed() -> None:
    block = trimesh.creation.cylinder(radius=0.05, height=0.04, sections=96)
    above = _hull(block, taut=False).bounds[1, 2] - 0.02
    assert above > 0.003
    assert _hull(block, taut=True).bounds[1, 2] - 0.02 < 0.35 * above


@pytest.mark.slow
def test_a_ball_stays_as_large_as_its_hull() -> None:
    before, after = (_hull(ball(0.05), taut=taut).volume for taut in (False, True))
    assert after == pytest.approx(before, rel=0.01)
