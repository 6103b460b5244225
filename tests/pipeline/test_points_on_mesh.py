"""Points of Gaussians beside a mesh: on the mesh, or left out; all as they were where the mesh is elsewhere."""

import torch
import trimesh

from avmsf.features.feature_field import FeatureField
from avmsf.mesh import Surface
from avmsf.pipeline.shape import OFF_MESH, moved_onto

BALL = trimesh.creation.icosphere(4, 0.1)
SURFACE = Surface(torch.from_numpy(BALL.vertices).float(), torch.from_numpy(BALL.faces))


def gaussians() -> tuple[FeatureField, torch.Tensor]:
    """Return points about a ball, each with its row as feature, and their distances from the middle."""
    generator = torch.Generator().manual_seed(0)
    ways = torch.nn.functional.normalize(torch.randn(600, 3, generator=generator), dim=1)
    radius = torch.where(torch.arange(600) % 10 == 0, 0.08, 0.1 + 0.002 * torch.randn(600, generator=generator))
    return FeatureField(radius[:, None] * ways, torch.arange(600.0)[:, None], "rows"), radius


def test_points_move_onto_the_mesh_and_those_far_from_it_go() -> None:
    features, radius = gaussians()
    moved = moved_onto(features, SURFACE)
    size = 0.2 * 3**0.5
    kept = torch.nonzero((radius - 0.1).abs() <= OFF_MESH * size).flatten()
    assert torch.equal(moved.features[:, 0].long(), kept)
    assert 500 < len(kept) < 560
    # Triangles of this ball lie up to .2 % of the radius beneath it.
    assert float((moved.points.norm(dim=1) - 0.1).abs().max()) < 3e-4
    ways = torch.nn.functional.normalize(features.points[kept], dim=1)
    assert float((moved.points - 0.1 * ways).norm(dim=1).max()) < 1e-3


def test_points_of_another_frame_and_a_cloud_change_nothing() -> None:
    features, _ = gaussians()
    far = Surface(SURFACE.vertices + 1.0, SURFACE.faces)
    bare = Surface(SURFACE.vertices, SURFACE.faces[:0])
    assert moved_onto(features, far) is features
    assert moved_onto(features, bare) is features
