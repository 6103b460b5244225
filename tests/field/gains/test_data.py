"""What gain models are given, and their fields scaled, refined and held."""

from dataclasses import replace
from functools import cache

import pytest
import torch

from avmsf._utils.tensor_files import TensorReader
from avmsf._utils.text import RecordError
from avmsf.capture.impacts import Impacts, rows_by_place
from avmsf.features.feature_field import FeatureField
from avmsf.fem.candidate_bodies import CandidateBody
from avmsf.fem.elastic_modes import HeldModes, elastic_modes
from avmsf.fem.material import NOMINAL, STEEL
from avmsf.fem.supports import Patch, Place, Support, patches_about
from avmsf.field.config import FIELD, FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.attention import held_out
from avmsf.field.gains.data import GainData, gain_data, orientation_signs
from avmsf.field.gains.estimator import MixtureEstimator, RefinedGains
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import off_surface, points_on_object
from avmsf.field.gains.scaled import BodyGains, ScaledGains
from avmsf.field.store import load, save
from avmsf.mesh.points import farthest_points
from avmsf.modal.extraction.extract import Extraction, extract_modes
from avmsf.modal.modes import ModalBank
from factories.believing_field import LENGTH, bar, bar_points
from factories.delayed_plate import ALIGNED, delays, distance, strikes, without_delays
from factories.known_bodies import KnownBodies
from factories.made_fields import FIELDS, blows, draw, model, places, positional, sounding
from factories.plate_field import plate_impacts
from factories.raising import raises
from oracles.block import block
from oracles.known_gains import known_gains


@pytest.mark.parametrize(
    ("places", "up", "expected"),
    [
        (range(6), [-1.0, -1, 1, -1, -1, -1], [1, 1, -1, 1, 1, 1]),
        # Two impacts in one place, from both sides of a wall.
        ([0, 0, 10], [1.0, -1, 1], [1, -1, 1]),
        (range(4), None, [1, 1, 1, 1]),
    ],
)
def test_an_impact_from_the_other_side_of_a_wall_turns_its_sign(places, up, expected):
    contacts = torch.tensor([[0.01 * place, 0.0, 0.0] for place in places], dtype=torch.float64)
    directions = None if up is None else torch.tensor([[0.0, 0.0, each] for each in up])
    assert orientation_signs(contacts, directions).tolist() == expected


def test_around_a_closed_object_directions_turn_gradually_and_no_sign_does():
    angles = torch.linspace(0, 2 * torch.pi, 13)[:-1]
    places = torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=1)
    assert orientation_signs(places.double(), -places).tolist() == [1] * 12


def test_all_directions_turned_change_nothing():
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(9, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(9, 3, generator=generator), dim=1)
    assert torch.equal(orientation_signs(places, directions), orientation_signs(places, -directions))


COUNT = 12
FEATURES = FeatureField.from_contacts(strikes(COUNT).contacts)
CONFIG = FitConfig(steps=0, damping="shared")


@pytest.fixture(scope="module")
def delayed() -> tuple[Impacts, Extraction]:
    train = strikes(COUNT, starts=delays(COUNT))
    return train, extract_modes(train)


@pytest.fixture(scope="module")
def exact(delayed: tuple[Impacts, Extraction]) -> tuple[Impacts, Extraction]:
    train = without_delays(*delayed, delays(COUNT))
    return train, extract_modes(train)


def test_a_field_and_the_gains_it_is_checked_by_do_not_depend_on_delays(delayed, exact):
    fields = [fit(train, FEATURES, modes, CONFIG) for train, modes in (delayed, exact)]
    known = [each.gain_field for each in fields]
    assert all(isinstance(each, MixtureGains) for each in known)
    assert distance(*(each.gains(delayed[0].contacts) for each in fields)) < ALIGNED
    # Between the contacts other hypotheses may be the more probable ones, which differ by less than is known.
    apart = fields[0].gains(FEATURES.points) - fields[1].gains(FEATURES.points)
    assert bool((apart.abs() < known[0].posterior(FEATURES.points).std[..., 0]).all())
    assert distance(*(torch.view_as_real(each.measured).flatten(1) for each in known)) < ALIGNED


def test_aligned_recordings_are_not_delayed_again(delayed: tuple[Impacts, Extraction]) -> None:
    train, modes = delayed
    aligned = modes.aligned(train)
    assert torch.equal(gain_data(aligned, FEATURES, modes, CONFIG).train.sounds, aligned.sounds)


def test_rows_are_grouped_by_place_in_the_order_of_the_table() -> None:
    contacts = torch.tensor([[2.0, 0, 0], [0, 0, 0], [2.001, 0, 0], [1, 0, 0], [0, 0, 0]])
    assert rows_by_place(contacts) == ((0, 2), (1, 4), (3,))
    assert rows_by_place(contacts[:0]) == ()


def test_without_repeats_the_last_of_the_farthest_points_are_held_out() -> None:
    contacts = plate_impacts(COUNT).contacts
    assert len(rows_by_place(contacts)) == COUNT
    assert held_out(contacts, 0.25) == farthest_points(contacts, COUNT).tolist()[-3:]
    assert held_out(contacts, 0.0) == held_out(contacts[:5], 0.4) == []
    assert len(held_out(contacts[:6], 0.4)) == 2


@pytest.mark.parametrize("apart", [0.0, 1e-3])
def test_repeats_are_held_out_with_their_places(apart: float) -> None:
    contacts = plate_impacts(COUNT).contacts
    once = held_out(contacts, 0.25)
    extent = (contacts.amax(0) - contacts.amin(0)).norm()
    again = contacts + apart * extent * torch.tensor([0.0, 0.0, 1.0], dtype=contacts.dtype)
    assert sorted(held_out(torch.cat([contacts, again]), 0.25)) == sorted(once + [row + COUNT for row in once])


FACTORS = torch.tensor([2.0, -0.5, 1.5, 0.0, 3.0], dtype=torch.float64)
PLACES = places(7, seed=8)
BLOWS = blows(PLACES, seed=9)


@pytest.mark.parametrize("name", ["attention with dampings", "positional", "elastic"])
def test_gains_and_deviations_are_the_inner_fields_times_the_factors(name):
    inner = FIELDS[name]()
    scaled = ScaledGains(inner, FACTORS)
    before, after = (each.predict(PLACES, BLOWS) for each in (inner, scaled))
    # A float32 number times a factor is rounded once.
    torch.testing.assert_close(after.parts, before.parts * FACTORS[:, None], rtol=1e-7, atol=0)
    assert before.damping is None or torch.equal(before.damping, after.damping)
    assert (before.damping is None) == (after.damping is None)
    deviations = [each.posterior(PLACES, BLOWS).std for each in (inner, scaled)]
    assert deviations[0] is None or torch.allclose(
        deviations[1], deviations[0] * FACTORS.abs().float()[:, None], rtol=1e-6
    )
    assert torch.equal(scaled.points, inner.points)


@pytest.mark.parametrize("name", ["attention", "positional", "elastic"])
def test_on_a_larger_object_places_are_where_they_would_be_on_the_small_one(name):
    inner = FIELDS[name]()
    large = ScaledGains(inner, torch.ones(5, dtype=torch.float64), 4.0)
    # Four is a power of two: lengths are not rounded.
    assert torch.equal(large.points, 4 * inner.points)
    assert torch.equal(large.predict(4 * PLACES, BLOWS).mean, inner.predict(PLACES, BLOWS).mean)
    deviations = large.posterior(4 * PLACES, BLOWS).std, inner.posterior(PLACES, BLOWS).std
    assert deviations == (None, None) or torch.equal(*deviations)
    assert not torch.equal(large.predict(PLACES, BLOWS).mean, inner.predict(PLACES, BLOWS).mean)


def test_of_scaled_gains_the_factors_multiply_and_nothing_nests(tmp_path):
    inner = FIELDS["positional"]()
    twice = ScaledGains(ScaledGains(inner, FACTORS, 0.5), 3 * FACTORS, 3.0)
    assert twice.field is inner
    assert torch.equal(twice.scale, 3 * FACTORS**2)
    assert twice.length == 1.5
    save(sounding(twice), tmp_path / "one")
    loaded = load(tmp_path / "one").gain_field
    assert torch.equal(loaded.predict(PLACES).mean, twice.predict(PLACES).mean)
    assert loaded.length == 1.5
    assert type(loaded.field) is type(inner)
    for length in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ValueError):
            ScaledGains(inner, FACTORS, length)
    with raises(RecordError, name="fitted_kind", value="scaled"):
        ScaledGains.restore(twice.record() | {"fitted_kind": "scaled"}, TensorReader({}, tmp_path, FIELD))


HEIGHT = 0.05
"""Of a false floor above the bar's sheet, meters: an eighth of the length, more than the tolerance."""


def test_a_place_on_a_false_floor_is_off_the_body_by_its_height_and_no_contact() -> None:
    points = bar_points()
    closed = BodyGains(torch.cat([points, points + torch.tensor([0.0, 0.0, HEIGHT])]).float(), bar())
    assert torch.equal(points_on_object(closed), points.float())
    # An edit of the size moves all of it.
    for length, gains in ((1.0, closed), (2.0, ScaledGains(closed, torch.ones(6, dtype=torch.float64), 2.0))):
        above = length * torch.tensor([[0.2, 0.05, 0.0], [0.2, 0.05, HEIGHT]])
        assert off_surface(above, gains) == [(1, pytest.approx(length * HEIGHT, abs=1e-6))]
        assert len(points_on_object(gains)) == len(points)
        assert float(gains.surface.vertices[:, 0].max()) == length * float(torch.tensor(LENGTH))
    # Gains without a body are known at all of their points.
    assert torch.equal(points_on_object(positional()), positional().points)
    assert positional().surface is None


CONTACTS, MODES = 14, 5
ORDER = torch.tensor([2, 4, 0])
DAMPING = torch.tensor([12.0, 15.0, 30.0, 22.0, 60.0], dtype=torch.float64)


def refined(shift: float = 0.0) -> RefinedGains:
    bank = ModalBank(torch.linspace(400.0, 3000.0, MODES, dtype=torch.float64), DAMPING)
    gains = RefinedGains(model(), bank)
    with torch.no_grad():
        gains.shift += shift * direction()
    return gains


@cache
def direction() -> torch.Tensor:
    return draw(2 * MODES, CONTACTS, 1, seed=4).float()


@pytest.mark.parametrize("shift", [0.0, 0.01])
def test_gains_are_the_mean_at_the_contacts_of_the_model_of_the_moved_values(shift):
    gains = refined(shift)
    finished = gains.finished(torch.arange(MODES))
    assert torch.equal(finished.values, model().values) == (shift == 0.0) == (float(gains.penalty().detach()) == 0.0)
    expected = finished.predict(finished.contacts, finished.training.directions).mean
    assert torch.allclose(gains.read(torch.arange(CONTACTS)).mean.detach(), expected, rtol=1e-4, atol=1e-3)


def test_a_shift_costs_its_squares_by_the_modes_energy():
    """A mode's energy is its mean square over its damping, as it sounds."""
    share = model().values.abs().square().sum(0) / DAMPING
    share /= share.sum()
    gains = refined(0.01)
    with torch.no_grad():
        # The second mode has nearly all of the energy.
        gains.shift[[1, MODES + 1]] = 0.0
    squares = (600.0 * gains.shift.detach().double()).square().reshape(2, MODES, -1).mean((0, 2))
    assert float(gains.penalty().detach()) == pytest.approx(float(0.05 * (squares * share).sum()), rel=1e-5)


def test_the_finished_model_is_judged_by_the_measured_gains_of_its_recordings():
    """Turned by the phase, one for each mode, that suits the model best."""
    gains = refined(0.01)
    finished = gains.finished(ORDER)
    turn = torch.exp(1j * torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64))
    judged = gains.finished(ORDER, finished.values * turn)
    assert torch.equal(judged.values, finished.values)
    assert torch.allclose(judged.measured, finished.values, rtol=1e-9)


SIDES = (0.24, 0.16, 0.003)


class Plate(KnownBodies):
    """A coarse plate of nominal material, which may be held."""

    supports = "try"

    def __init__(self, held_at: tuple[Place, ...] = ()) -> None:
        super().__init__([CandidateBody(None, held_modes(held_at).free)])
        self.held_at = held_at

    def held(self, body: CandidateBody) -> HeldModes:
        return held_modes(tuple(self.held_at))


@cache
def held_modes(held_at: tuple[Place, ...]) -> HeldModes:
    return HeldModes(block(SIDES, (9, 6, 1)), NOMINAL, count=16, patches=patches_about(held_at) or None)


FEET = ((0.04, 0.0267, 0.0), (0.2, 0.08, 0.0))


@pytest.mark.parametrize(("held", "stated"), [(True, FEET), (False, ((0.12, 0.08, 0.0),))])
def test_a_plate_is_held_where_its_user_says_and_it_shows_where_it_was_free(held, stated):
    support = Support(tuple(patches_about(stated)), 1e10) if held else None
    true = elastic_modes(block(SIDES, (13, 8, 1)), NOMINAL, count=12, support=support)
    report = MixtureEstimator(bodies=Plate(stated)).solve(known_gains(true)[0])[0].report
    evidence, found = report["support_evidence"], report["bodies"][0]
    assert (evidence["held"] > evidence["free"]) == held
    names = "(40, 27, 0) mm and (200, 80, 0) mm" if held else "(120, 80, 0) mm"
    assert found["support"] == f"held at {names}"
    assert not held or found["support_stiffness"] > 1e6
    assert not held or found["frequency_factor"] == pytest.approx(1.0, abs=0.1)


LEFT, RIGHT = Patch("left", (-1.0, 0.0, 0.0)), Patch("right", (1.0, 0.0, 0.0))
AT = {LEFT: "its end at (0, 80, 2) mm", RIGHT: "its end at (240, 80, 2) mm"}


@pytest.mark.parametrize(("sides", "stiffness"), [((), 0.0), ((LEFT,), 2e5), ((LEFT,), 1e10), ((LEFT, RIGHT), 2e6)])
def test_the_support_of_a_plate_is_found(sides: tuple[Patch, ...], stiffness: float):
    solid = block(SIDES, (13, 8, 1))
    uneven = 1.0 + 0.5 * solid.points[solid.cells].mean(1)[:, 0]
    support = Support(sides, stiffness) if sides else None
    true = elastic_modes(solid, STEEL, count=12, stiffness_factor=uneven, support=support)
    model, _ = MixtureEstimator(bodies=Plate()).solve(known_gains(true)[0])
    found = model.report["bodies"][0]
    assert model.report["supports_tried"]
    assert set(found["support"].removeprefix("held at ").split(" and ")) == ({AT[each] for each in sides} or {"free"})
    # In the unit of the nominal material, whose plate is not the true one.
    assert found["support_stiffness"] is None or found["support_stiffness"] > 0.1 * min(stiffness, 1e6)


def test_supports_are_not_tried_where_the_free_body_predicts_the_gains(monkeypatch: pytest.MonkeyPatch):
    asked = []
    monkeypatch.setattr(Plate, "held", lambda plate, body: asked.append(body))
    monkeypatch.setattr(Plate, "supports", "auto")
    case = known_gains(elastic_modes(block(SIDES, (9, 6, 1)), NOMINAL, count=12))[0]
    model, _ = MixtureEstimator(bodies=Plate()).solve(case)
    assert model.report["credibility"]["credible"]
    assert not model.report["supports_tried"]
    assert asked == []


def test_levels_of_recordings_without_forces_are_found():
    even = known_gains(elastic_modes(block(SIDES, (9, 6, 1)), NOMINAL, count=12))[0]
    levels = torch.exp(2.4 * draw(len(even.train), seed=7))
    levels /= levels.log().mean().exp()
    uneven = even.divided(1.0 / levels)
    of_unknown_forces = replace(uneven, train=replace(uneven.train, forces=None))

    def levels_of(data: GainData, bodies: Plate | None = None) -> list[float]:
        return MixtureEstimator(bodies=bodies).solve(data)[0].report["levels"]

    off = (torch.tensor(levels_of(of_unknown_forces, Plate()), dtype=torch.float64) / levels).log().abs()
    # Two contacts are so close to edges that the others do not predict them.
    assert int((off < 0.2).sum()) == 10
    assert levels_of(even) == []
    assert levels_of(uneven) == []
