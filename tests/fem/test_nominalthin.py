"""Dense meshes: thinned to the same body, without their noise, and with their rims where they were."""

import fast_simplification
import numpy as np
import pytest
import torch
import trimesh
from scipy import ndimage

from avmsf.fem import mesh_thinning as nominalthin
from avmsf.fem.candidate_bodies import nominal_bodies
from avmsf.fem.mesh_thinning import simplified, thinned
from avmsf.fem.skin import Skin
from avmsf.fem.tetrahedra import fill
from avmsf.mesh.closest_point import ClosestPoints
from avmsf.mesh.level_set import enclose
from avmsf.mesh.surface import Surface


def ellipsoid(subdivisions: int) -> Skin:
    """Return one with half axes of 60, 45 and 30 mm."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Skin(np.array(mesh.vertices) * [0.060, 0.045, 0.030], np.array(mesh.faces))


def vessel(sections: int) -> Skin:
    """Return the part of a ball of 5 cm from its bottom to 115 degrees."""
    angles = np.linspace(0.0, 2.0, sections // 2)
    mesh = trimesh.creation.revolve(0.05 * np.stack([np.sin(angles), -np.cos(angles)], axis=1), sections=sections)
    return Skin.of(surface_of(Skin(np.array(mesh.vertices), np.array(mesh.faces))))


def surface_of(skin: Skin) -> Surface:
    return Surface(torch.from_numpy(skin.points).float(), torch.from_numpy(skin.faces))


@pytest.mark.slow
@pytest.mark.parametrize(("dense", "coarse"), [(ellipsoid(5), ellipsoid(4)), (vessel(160), vessel(70))])
def test_a_dense_mesh_vibrates_as_a_coarse_one_of_the_same_shape(
    dense: Skin, coarse: Skin, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Those that the wall is made of are far fewer.
    for name in ("MOST", "ENOUGH"):
        monkeypatch.setattr(nominalthin, name, 6000)
    told: list[str] = []
    found, known = (
        nominal_bodies(surface_of(skin), walls=[0.002], count=4, dofs=8000, log=told.append).bodies[0].elastic
        for skin in (dense, coarse)
    )
    assert f"{len(dense.faces)} triangles" in told[0]
    assert "6000 triangles" in told[1]
    assert sum("6000 triangles" in message for message in told) == 1
    # Without thinning, elements that differ change frequencies by 1.5 % at this size.
    assert found.frequency.numpy() == pytest.approx(known.frequency.numpy(), rel=0.03)
    assert found.mass == pytest.approx(known.mass, rel=0.01)


def test_a_noisy_mesh_is_thinned_without_its_noise_and_stays_a_skin(monkeypatch: pytest.MonkeyPatch) -> None:
    clean = ellipsoid(5)
    noise = 0.01 * clean.size * np.random.default_rng(0).standard_normal(clean.points.shape) / 3**0.5
    told: list[str] = []
    for name in ("MOST", "ENOUGH"):
        monkeypatch.setattr(nominalthin, name, 4000)
    found = thinned(Skin(clean.points + noise, clean.faces), log=told.append)
    assert len(found.faces) == 4000
    assert (found.open_edges, found.crowded_edges) == (0, 0)
    surface = ClosestPoints(clean.points[clean.faces])
    before = np.sqrt((surface(clean.points + noise).distances ** 2).mean())
    assert np.sqrt((surface(found.points).distances ** 2).mean()) < 0.35 * before
    assert found.volume == pytest.approx(clean.volume, rel=0.01)
    assert told[-1].endswith("degrees")


def test_a_thinned_sheet_keeps_its_rim(monkeypatch: pytest.MonkeyPatch) -> None:
    side = np.linspace(0.0, 1.0, 61)
    rows = np.arange(61 * 61).reshape(61, 61)
    a, b, c, d = (part.ravel() for part in (rows[:-1, :-1], rows[1:, :-1], rows[1:, 1:], rows[:-1, 1:]))
    points = np.stack([*(each.ravel() for each in np.meshgrid(side, side, indexing="ij")), np.zeros(61 * 61)], axis=1)
    sheet = Skin(points, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]))
    for name in ("MOST", "ENOUGH"):
        monkeypatch.setattr(nominalthin, name, 1000)
    found = thinned(sheet, log=lambda words: None)
    assert len(found.faces) <= 1000
    # Each corner may lose a triangle, with sides of about .045 now.
    assert found.areas.sum() == pytest.approx(1.0, abs=4 * 0.045**2 / 2)
    assert np.ptp(found.points, axis=0) == pytest.approx([1.0, 1.0, 0.0], abs=1e-6)
    assert 0 < found.open_edges < sheet.open_edges


def test_more_triangles_are_left_where_fewer_would_tear_the_skin(monkeypatch: pytest.MonkeyPatch) -> None:
    ball = ellipsoid(4)

    def tearing(points: np.ndarray, faces: np.ndarray, *, target_count: int) -> tuple[np.ndarray, np.ndarray]:
        return points, faces if target_count >= 4000 else faces[:target_count]

    monkeypatch.setattr(fast_simplification, "simplify", tearing)
    for name in ("MOST", "ENOUGH"):
        monkeypatch.setattr(nominalthin, name, 1000)
    found = thinned(ball, log=lambda words: None)
    assert np.array_equal(found.faces, ball.faces)
    for name in ("MOST", "ENOUGH"):
        monkeypatch.setattr(nominalthin, name, 3000)
    assert thinned(ball, log=lambda words: None) is ball


def test_fewer_triangles_of_a_thin_shell_keep_its_volume() -> None:
    outer, inner = ellipsoid(4), ellipsoid(4)
    count = len(outer.points)
    shell = Skin(
        np.concatenate([outer.points, 0.95 * inner.points]), np.concatenate([outer.faces, count + inner.faces[:, ::-1]])
    )
    found = simplified(shell, 1200)
    assert 1000 < len(found.faces) <= 1200
    assert found.open_edges == 0
    assert found.volume == pytest.approx(shell.volume, rel=0.05)


def test_a_knotted_skin_shares_a_few_edges_rather_than_keep_its_triangles_and_is_filled() -> None:
    values = ndimage.gaussian_filter(np.random.default_rng(0).standard_normal((40, 40, 40)), 2.0)
    values /= values.std()
    radius = np.linalg.norm(np.meshgrid(*[np.linspace(-1, 1, 40)] * 3), axis=0)
    sponge = np.minimum(values + 0.5, 4 * (0.85 - radius)).astype(np.float32)
    skin = Skin.of(enclose(sponge, 0.0, lowest=np.zeros(3), spacing=0.01))
    assert len(simplified(skin, 1000).faces) > 10_000
    found = simplified(skin, 1000, most=4000)
    assert len(found.faces) <= 1000
    assert found.open_edges == 0
    assert found.volume == pytest.approx(skin.volume, rel=0.02)
    filled = fill(surface_of(found), detail=0.1)
    assert float(filled.volumes.sum()) == pytest.approx(skin.volume, rel=0.05)
