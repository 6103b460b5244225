"""Where a hammer gets to: closed forms of a cup, a hollow ball and a slab with points inside."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from avmsf.errors import FitError
from avmsf.field.hammer_access import HAMMER_DIAMETER, MeshAccess, PointAccess
from avmsf.field.next_contacts import suggest
from factories.believing_field import (
    LENGTH,
    WIDTH,
    bar_contacts,
    drawn_gains,
    elastic_field,
    positional_field,
    sound_field,
)

WALL = 0.003


def cup(inner: float, height: float) -> trimesh.Trimesh:
    """Return a round cup that is open above, with this inner radius, meters."""
    outer = inner + WALL
    profile = [(0, 0), (outer, 0), (outer, height), (inner, height), (inner, WALL), (0, WALL)]
    mesh = trimesh.creation.revolve(np.array(profile), sections=64)
    assert mesh.is_watertight
    assert mesh.volume > 0
    return mesh


def by_mesh(mesh: trimesh.Trimesh) -> MeshAccess:
    return MeshAccess(np.array(mesh.vertices), np.array(mesh.faces))


def by_points(mesh: trimesh.Trimesh) -> PointAccess:
    return PointAccess(np.array(trimesh.sample.sample_surface(mesh, 12_000, seed=0)[0]))


both = pytest.mark.parametrize("access", [by_mesh, by_points])


@both
@pytest.mark.parametrize("hollow", [0.09, 0.07])
def test_nothing_inside_a_closed_shell_can_be_struck(access, hollow) -> None:  # type: ignore[no-untyped-def]
    outer, inner = trimesh.creation.icosphere(4, 0.1), trimesh.creation.icosphere(4, hollow)
    inner.invert()
    shell = trimesh.util.concatenate([outer, inner])
    struck, _, _ = access(shell)(np.array(inner.vertices)[::10])
    assert not struck.any()
    # Points leave their surface less sure than triangles do.
    struck, _, _ = access(shell)(np.array(outer.vertices)[::10])
    assert struck.mean() > (0.99 if access is by_mesh else 0.95)


@pytest.mark.parametrize("inner", [0.03, 0.05])
def test_a_wall_inside_is_struck_over_the_opposite_rim_alone(inner: float) -> None:
    """A rod that leans 45 degrees from a vertical wall rises as far as it goes across, to the opposite rim."""
    height = 6 * inner
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    reach = 2 * inner

    def wall(depth: float) -> np.ndarray:
        return np.stack([inner * np.cos(angle), inner * np.sin(angle), np.full(40, height - depth)], axis=1)

    judge = by_mesh(cup(inner, height))
    # Turns are tried 30 degrees apart, so that the steepest may miss the rim's middle by 15; the rod is thick.
    assert judge(wall(0.5 * reach * np.cos(np.radians(15)) - HAMMER_DIAMETER))[0].all()
    assert not judge(wall(1.05 * reach))[0].any()
    assert not judge(wall(2 * reach))[0].any()


def test_the_axis_of_a_hammer_lies_clear_and_is_the_nearest_to_the_normal() -> None:
    inner, height = 0.03, 0.18
    judge = by_mesh(cup(inner, height))
    # The outer wall is struck straight on, the inner one over the opposite rim, 60 mm away.
    places = np.array([[inner + WALL, 0.0, 0.1], [inner, 0.0, height - 0.02], [inner, 0.0, height - 0.04]])
    struck, _, axes = judge(places)
    assert struck.all()
    assert axes[0] == pytest.approx([1.0, 0.0, 0.0], abs=0.06)
    tilt = np.degrees(np.arccos(-axes[1:, 0]))
    assert (np.degrees(np.arctan([20 / 60, 40 / 60])) - 1 < tilt).all()
    assert tilt == pytest.approx([30.0, 45.0], abs=3.0)
    assert (axes[1:, 2] > 0).all()


def test_suggestions_are_struck_along_the_axis_that_lies_clear(monkeypatch: pytest.MonkeyPatch) -> None:
    contacts, leaning = bar_contacts(6), np.array([0.6, 0.0, 0.8])

    def judge(access: MeshAccess, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return np.ones(len(places), dtype=bool), places, np.broadcast_to(leaning, places.shape)

    monkeypatch.setattr(MeshAccess, "__call__", judge)
    found = suggest(sound_field(elastic_field(contacts, drawn_gains(contacts, seed=1))), 2).directions
    assert torch.allclose(found, -torch.from_numpy(leaning).expand(2, 3))


def test_a_place_within_a_wall_is_moved_onto_its_surface_and_one_far_off_is_none() -> None:
    judge = by_mesh(trimesh.creation.box((0.3, 0.2, 0.1)))
    struck, feet, _ = judge(np.array([[0.01, 0.02, 0.048], [0.0, 0.0, 0.0], [0.0, 0.0, 0.07]]))
    assert struck.tolist() == [True, False, False]
    assert feet[0] == pytest.approx([0.01, 0.02, 0.05])


@pytest.mark.parametrize("made", [elastic_field, positional_field])
def test_points_within_the_object_are_not_suggested(made) -> None:  # type: ignore[no-untyped-def]
    contacts = bar_contacts(6)
    gains = made(contacts, drawn_gains(contacts, seed=1))
    surface = gains.points
    # A second face below, and points between the two.
    below, between = surface - torch.tensor([0, 0, 0.04]), surface - torch.tensor([0, 0, 0.02])
    field = sound_field(replace(gains, points=torch.cat([surface, between, below])))
    found = suggest(field, 20)
    middle = (found.contacts - torch.tensor([LENGTH / 2, WIDTH / 2, -0.02])).abs()
    assert not bool((middle < torch.tensor([LENGTH / 2 - 0.02, WIDTH / 2 - 0.02, 0.005])).all(1).any())
    assert found.unreachable > 0


def test_an_object_that_cannot_be_struck_is_refused() -> None:
    contacts = bar_contacts(6)
    gains = elastic_field(contacts, drawn_gains(contacts, seed=1))
    with pytest.raises(FitError):
        suggest(sound_field(replace(gains, points=gains.points + torch.tensor([0, 0, 0.1]))), 1)


def test_a_side_without_points_is_suggested_on_request_alone() -> None:
    contacts = bar_contacts(6)
    gains = elastic_field(contacts, drawn_gains(contacts, seed=1))
    half = replace(gains, points=gains.points[gains.points[:, 0] < LENGTH / 2])
    assert float(suggest(sound_field(half), 5).contacts[:, 0].max()) < LENGTH / 2
    assert float(suggest(sound_field(half), 5, unseen=True).contacts[:, 0].max()) > 0.6 * LENGTH
    with pytest.raises(FitError):
        suggest(sound_field(positional_field(contacts, drawn_gains(contacts, seed=1))), 1, unseen=True)
