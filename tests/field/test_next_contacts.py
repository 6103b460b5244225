"""Where to strike next, and where a hammer reaches."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from avmsf.editing.modal_edit import adjust_modes
from avmsf.errors import ArrayError, FitError
from avmsf.field.gains.elastic import REACH
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.next_contacts import HAMMER_DIAMETER, reached_on_mesh, reached_on_points, suggest
from avmsf.field.sound_field import SoundField
from factories.believing_field import (
    BANK,
    DOWN,
    ELASTIC,
    LENGTH,
    NOISE,
    PERTURBATION,
    REMAINDER,
    SIZE,
    WIDTH,
    bar_contacts,
    bar_points,
    cosines,
    drawn_gains,
    elastic_field,
    one_hypothesis,
    positional_field,
    sound_field,
)
from factories.looked_at import cup
from factories.made_fields import BANK as MODES
from factories.made_fields import attention
from factories.raising import raises

both_models = pytest.mark.parametrize("made", [elastic_field, positional_field])


def of_one_hypothesis(count: int = 5) -> SoundField:
    contacts = bar_contacts(count)
    return sound_field(one_hypothesis(contacts, drawn_gains(contacts, seed=1)))


def open_variance(field: SoundField, extra: Tensor, points: Tensor) -> Tensor:
    """Return the energy that is not known at points with `extra` struck too, by the textbook's formula."""
    gains = field.gain_field
    assert isinstance(gains, MixtureGains)
    contacts, values = gains.contacts, torch.view_as_real(gains.values)
    struck = torch.cat([contacts, extra])
    total = torch.zeros(len(points), dtype=torch.float64)
    for mode in range(len(BANK)):
        shares = 1.0 / (1.0 + (2.0 * torch.log(ELASTIC[mode] / ELASTIC) / PERTURBATION) ** 2)
        shares = shares / (cosines(contacts).square() @ shares).mean()

        def kernel(one: Tensor, two: Tensor, shares: Tensor = shares) -> Tensor:
            smooth = torch.exp(-0.5 * (one[:, None] - two).square().sum(2) / (REACH * SIZE) ** 2)
            return (1 - REMAINDER) * cosines(one) @ torch.diag(shares) @ cosines(two).T + REMAINDER * smooth

        known = kernel(contacts, contacts) + NOISE * torch.eye(len(contacts))
        scale = torch.einsum("cd,ce,ed->", values[:, mode], torch.linalg.inv(known), values[:, mode])
        all_of = kernel(struck, struck) + NOISE * torch.eye(len(struck))
        cross, own = kernel(points, struck), (1 - REMAINDER) * cosines(points).square() @ shares + REMAINDER
        left = own - (cross @ torch.linalg.inv(all_of) * cross).sum(1)
        total += scale / len(contacts) * left / (4 * BANK.damping[mode])
    return total


def test_the_expected_error_is_that_of_regression_with_the_contacts_struck() -> None:
    field = of_one_hypothesis()
    found = suggest(field, 3)
    ratio = found.before**2 / float(open_variance(field, found.contacts[:0], found.points).mean())
    for count, after in enumerate(found.after, 1):
        expected = float(open_variance(field, found.contacts[:count], found.points).mean())
        # Shapes are held in float32.
        assert after**2 == pytest.approx(ratio * expected, rel=1e-4)


def test_each_contact_is_the_best_of_all_candidates() -> None:
    field = of_one_hypothesis()
    candidates = bar_contacts(12, seed=7)
    candidates = candidates[((candidates[:, None] - field.gain_field.contacts).norm(dim=2) > 1e-6).all(1)]  # type: ignore[attr-defined]
    found = suggest(field, 2, candidates=candidates)
    taken = candidates[:0]
    for row in found.rows.tolist():
        errors = [
            float(open_variance(field, torch.cat([taken, each[None]]), found.points).mean()) for each in candidates
        ]
        assert min(range(len(errors)), key=errors.__getitem__) == row
        taken = torch.cat([taken, candidates[row : row + 1]])
    assert torch.equal(found.contacts, candidates[found.rows])


@both_models
def test_contacts_differ_lie_on_the_object_and_lower_the_error_each(made: type) -> None:
    contacts = bar_contacts(6)
    found = suggest(sound_field(made(contacts, drawn_gains(contacts, seed=3))), 8)
    errors = [found.before, *found.after]
    assert all(later < earlier for earlier, later in pairwise(errors))
    assert errors[0] < 1.5
    both = torch.cat([contacts, found.contacts])
    assert len(torch.unique(both, dim=0)) == 14
    assert float((found.contacts[:, None] - bar_points().double()).norm(dim=2).amin(1).max()) < 1e-9
    assert (found.directions is None) == (made is positional_field)
    if found.directions is not None:
        assert torch.allclose(found.directions, DOWN.expand(8, 3))


def test_fields_without_a_posterior_and_edited_ones_are_refused() -> None:
    once = positional_field(bar_contacts(1).expand(3, 3), drawn_gains(bar_contacts(1), seed=6).expand(3, 4, 2))
    network, edited = replace(sound_field(attention()), bank=MODES), adjust_modes(of_one_hypothesis())
    for field, value in ((network, "attention"), (sound_field(once), 1), (edited, "edited")):
        with raises(FitError, name="field", value=value):
            suggest(field)


ONE = torch.tensor([[0.4, 0.1, 0.0]])


@pytest.mark.parametrize(
    ("count", "candidates", "directions", "fault"),
    [
        (0, None, None, {"name": "count", "value": 0}),
        *((count, None, None, {"name": "count"}) for count in (np.array([1, 2]), torch.tensor([1, 2]), True)),
        (1, torch.zeros(0, 3), None, {"name": "candidates", "value": 0}),
        (1, torch.tensor([[0.0, 0, 0], [0.0, float("nan"), 0]]), None, {"name": "candidates", "row": 1}),
        (1, torch.tensor([[0.4, 0.1, 0.2]]), None, {"name": "candidates", "row": 0, "value": [0.4, 0.1, 0.2]}),
        (1, ONE.expand(2, 3), DOWN.expand(1, 3), {"name": "directions", "value": [1, 3]}),
        (1, None, DOWN.expand(1, 3), {"name": "directions", "value": [1, 3]}),
        (1, ONE, torch.tensor([[0, 0, -math.inf]]), {"name": "directions", "row": 0, "value": -math.inf}),
        (1, bar_contacts(1), None, {"name": "candidates", "value": 0}),
    ],
)
def test_arguments_that_no_contact_can_be_suggested_for_are_refused(count, candidates, directions, fault):
    shapeless = fault["name"] == "directions" or ("row" in fault and "value" not in fault)
    with raises(ArrayError if shapeless else FitError, **fault):
        suggest(of_one_hypothesis(), count, candidates=candidates, directions=directions)


def test_where_fewer_places_are_left_than_asked_for_all_are_suggested() -> None:
    # One of three has a recording, and two are one place.
    found = suggest(of_one_hypothesis(), 5, candidates=torch.cat([bar_contacts(1), ONE, ONE]))
    assert found.rows.tolist() == [1]
    assert len(found.after) == 1


def test_of_very_many_candidates_some_that_are_far_apart_are_weighed(monkeypatch: pytest.MonkeyPatch) -> None:
    contacts, candidates = bar_contacts(6), bar_contacts(120, seed=4)
    field = sound_field(elastic_field(contacts, drawn_gains(contacts, seed=3)))
    whole = suggest(field, 3, candidates=candidates)
    monkeypatch.setattr("avmsf.field.next_contacts.MAX_CANDIDATES", 30)
    fewer = suggest(field, 3, candidates=candidates)
    assert torch.equal(fewer.contacts, candidates[fewer.rows])
    # A quarter of them loses next to nothing.
    assert fewer.after[-1] < whole.after[-1] + 0.1 * (whole.before - whole.after[-1])
    assert len(suggest(field, 40, candidates=candidates).rows) == 40


WALL = 0.003


def struck_on(mesh: trimesh.Trimesh, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return reached_on_mesh(np.array(mesh.vertices), np.array(mesh.faces), places)


def by_mesh(mesh: trimesh.Trimesh, places: np.ndarray) -> np.ndarray:
    return struck_on(mesh, places)[0]


def by_points(mesh: trimesh.Trimesh, places: np.ndarray) -> np.ndarray:
    return reached_on_points(np.array(trimesh.sample.sample_surface(mesh, 12_000, seed=0)[0]), places)


both = pytest.mark.parametrize("access", [by_mesh, by_points])


@both
@pytest.mark.parametrize("hollow", [0.09, 0.07])
def test_nothing_inside_a_closed_shell_can_be_struck(access, hollow) -> None:  # type: ignore[no-untyped-def]
    outer, inner = trimesh.creation.icosphere(4, 0.1), trimesh.creation.icosphere(4, hollow)
    inner.invert()
    shell = trimesh.util.concatenate([outer, inner])
    assert not access(shell, np.array(inner.vertices)[::40]).any()
    # Points leave their surface less sure than triangles do.
    assert access(shell, np.array(outer.vertices)[::40]).mean() > (0.99 if access is by_mesh else 0.95)


@pytest.mark.parametrize("inner", [0.03, 0.05])
def test_a_wall_inside_is_struck_over_the_opposite_rim_alone(inner: float) -> None:
    """A rod that leans 45 degrees from a vertical wall rises as far as it goes across, to the opposite rim."""
    height = 6 * inner
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    reach = 2 * inner

    def wall(depth: float) -> np.ndarray:
        return np.stack([inner * np.cos(angle), inner * np.sin(angle), np.full(40, height - depth)], axis=1)

    open_cup = cup(radius=inner + WALL, height=height, wall=WALL)
    # Turns are tried 30 degrees apart, so that the steepest may miss the rim's middle by 15; the rod is thick.
    assert by_mesh(open_cup, wall(0.5 * reach * np.cos(np.radians(15)) - HAMMER_DIAMETER)).all()
    assert not by_mesh(open_cup, wall(1.05 * reach)).any()
    assert not by_mesh(open_cup, wall(2 * reach)).any()


def test_the_axis_of_a_hammer_lies_clear_and_is_the_nearest_to_the_normal() -> None:
    inner, height = 0.03, 0.18
    # The outer wall is struck straight on, the inner one over the opposite rim, 60 mm away.
    places = np.array([[inner + WALL, 0.0, 0.1], [inner, 0.0, height - 0.02], [inner, 0.0, height - 0.04]])
    struck, _, axes = struck_on(cup(radius=inner + WALL, height=height, wall=WALL), places)
    assert struck.all()
    assert axes[0] == pytest.approx([1.0, 0.0, 0.0], abs=0.06)
    tilt = np.degrees(np.arccos(-axes[1:, 0]))
    assert (np.degrees(np.arctan([20 / 60, 40 / 60])) - 1 < tilt).all()
    assert tilt == pytest.approx([30.0, 45.0], abs=3.0)
    assert (axes[1:, 2] > 0).all()


def test_suggestions_are_struck_along_the_axis_that_lies_clear(monkeypatch: pytest.MonkeyPatch) -> None:
    contacts, leaning = bar_contacts(6), np.array([0.6, 0.0, 0.8])

    def judge(vertices: np.ndarray, faces: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return np.ones(len(places), dtype=bool), places, np.broadcast_to(leaning, places.shape)

    monkeypatch.setattr("avmsf.field.next_contacts.reached_on_mesh", judge)
    found = suggest(sound_field(elastic_field(contacts, drawn_gains(contacts, seed=1))), 2).directions
    assert torch.allclose(found, -torch.from_numpy(leaning).expand(2, 3))


def test_a_place_within_a_wall_is_moved_onto_its_surface_and_one_far_off_is_none() -> None:
    places = np.array([[0.01, 0.02, 0.048], [0.0, 0.0, 0.0], [0.0, 0.0, 0.07]])
    struck, feet, _ = struck_on(trimesh.creation.box((0.3, 0.2, 0.1)), places)
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
