"""Surfaces made fit: what faces inwards is turned, noise goes, holes are measured."""

import math

import numpy as np
import pytest
import torch
import trimesh

from avmsf.errors import SimulationError
from avmsf.fem.mesh_check import CheckedSurface, checked
from avmsf.fem.mesh_smoothing import ROUGH, denoised, roughness
from avmsf.fem.skin import Skin
from avmsf.mesh.closest_point import ClosestPoints
from avmsf.mesh.surface import Surface
from factories.raising import raises


def surface_of(mesh: trimesh.Trimesh) -> Surface:
    return Surface(torch.from_numpy(np.array(mesh.vertices)).float(), torch.from_numpy(np.array(mesh.faces)))


def skin_of(mesh: trimesh.Trimesh) -> Skin:
    return Skin.of(surface_of(mesh))


def cup(below: float) -> Skin:
    """Return the part of a ball of radius 1 below this height."""
    angles = np.linspace(0.0, math.acos(-below), 40)
    return skin_of(trimesh.creation.revolve(np.stack([np.sin(angles), -np.cos(angles)], axis=1), sections=64))


def test_an_inverted_part_is_turned_and_the_wall_of_a_void_is_not():
    outer, inner, beside = (trimesh.creation.icosphere(2, radius=radius) for radius in (1.0, 0.8, 0.5))
    inner.invert()
    beside.apply_translation((3.0, 0.0, 0.0))
    beside.invert()
    truth = (1.0 - 0.8**3 + 0.5**3) * trimesh.creation.icosphere(2).volume
    told: list[str] = []
    found = checked(surface_of(trimesh.util.concatenate([outer, inner, beside])), log=told.append)
    assert found.skin.volume == pytest.approx(truth, rel=1e-5)
    assert len(told) == 1
    assert told[0].startswith("320 of 960 triangles")
    # All of it inside out: the void goes with the body around it.
    every = trimesh.util.concatenate([outer, inner])
    every.invert()
    assert checked(surface_of(every), log=told.append).skin.volume == pytest.approx(
        (1.0 - 0.8**3) * trimesh.creation.icosphere(2).volume, rel=1e-5
    )


@pytest.mark.parametrize(("below", "vessel"), [(0.05, True), (0.9, True), (-0.995, False)])
def test_an_open_vessel_that_faces_inwards_is_told_and_stays(below: float, vessel: bool):
    skin = cup(below)
    outwards = Surface(torch.from_numpy(skin.points).float(), torch.from_numpy(skin.faces))
    for surface, expected in ((outwards, False), (Surface(outwards.vertices, outwards.faces.flip(1)), vessel)):
        told: list[str] = []
        found = checked(surface, log=told.append).skin
        # A dish a twentieth as deep as its radius has no inside worth the name.
        assert any("inwards" in message for message in told) == expected
        assert (found.volume > 0) == (Skin.of(surface).volume > 0)


def test_lids_are_measured_as_they_would_close_the_holes():
    half = CheckedSurface(cup(0.05))
    # The disc on a dome of height h on a ball of radius 1 is (2 - h) / (4 - h) of all.
    assert half.lids == pytest.approx((2 - 1.05) / (4 - 1.05), abs=0.005)
    with raises(SimulationError, name="mesh", value=half.lids):
        half.expect_filling()
    assert half.mean_thickness is None
    nearly = CheckedSurface(cup(0.9))
    nearly.expect_filling()
    held = nearly.mean_thickness
    assert held is not None
    assert held == pytest.approx(2 * 4 / 3 * math.pi / (4 * math.pi), rel=0.05)


def test_no_wall_is_guessed_where_the_surface_holds_little_more_than_it():
    whole = CheckedSurface(skin_of(trimesh.creation.icosphere(4)))
    # Twice the volume over the area is two thirds of the radius, of which a wall may be a sixth.
    whole.expect_hollow(0.110)
    with raises(SimulationError, name="wall", value=0.112):
        whole.expect_hollow(0.112)
    CheckedSurface(cup(0.05)).expect_hollow(0.3)


def test_noise_is_taken_out_of_a_mesh_by_as_much_as_it_has():
    clean = skin_of(trimesh.creation.icosphere(4))
    for part in (0.01, 0.02):
        noise = part * clean.size * np.random.default_rng(0).standard_normal(clean.points.shape) / math.sqrt(3)
        found, moved = denoised(Skin(clean.points + noise, clean.faces))
        assert moved == pytest.approx(part * clean.size, rel=0.1)
        surface = ClosestPoints(clean.points[clean.faces])
        before = np.sqrt((surface(clean.points + noise).distances ** 2).mean())
        assert np.sqrt((surface(found.points).distances ** 2).mean()) < 0.35 * before
        assert roughness(found) < 8.0
        assert found.volume == pytest.approx(Skin(clean.points + noise, clean.faces).volume, rel=1e-9)


def test_what_is_not_noisy_stays_as_it_is():
    box = skin_of(trimesh.creation.box((1.0, 0.2, 0.01)))
    for skin in (box, box.remeshed(0.03), skin_of(trimesh.creation.icosphere(4)), cup(0.3)):
        assert roughness(skin) < ROUGH
        found, moved = denoised(skin)
        assert found is skin
        assert moved == 0.0


def test_a_rough_form_that_is_no_noise_stays():
    # Each vertex lies on a wave that its neighbors predict, though triangles turn by more than noise would make them.
    x, y = np.meshgrid(np.linspace(0, 1, 49), np.linspace(0, 1, 49), indexing="ij")
    rows = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (part.ravel() for part in (rows[:-1, :-1], rows[1:, :-1], rows[1:, 1:], rows[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    heights = 0.12 * np.sin(12 * math.pi * x.ravel()) * np.sin(12 * math.pi * y.ravel())
    waves = Skin(np.stack([x.ravel(), y.ravel(), heights], axis=1), faces)
    assert roughness(waves) > ROUGH
    assert denoised(waves)[0] is waves


def test_smoothing_is_told():
    clean = skin_of(trimesh.creation.icosphere(3))
    noise = 0.02 * clean.size * np.random.default_rng(0).standard_normal(clean.points.shape)
    told: list[str] = []
    rough = Surface(torch.from_numpy(clean.points + noise).float(), torch.from_numpy(clean.faces))
    checked(rough, log=told.append)
    assert len(told) == 1
    assert f"{roughness(Skin.of(rough)):.0f} degrees" in told[0]


def test_corners_a_millionth_of_the_size_apart_are_one() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    corners = np.array(ball.triangles).reshape(-1, 3)
    corners += 1e-7 * np.random.default_rng(0).uniform(-1, 1, corners.shape)
    faces = torch.arange(len(corners)).reshape(-1, 3)
    skin = Skin.of(Surface(torch.from_numpy(corners), faces))
    assert (len(skin.points), len(skin.faces)) == (len(ball.vertices), len(ball.faces))
