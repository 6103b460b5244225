"""The support of an object, found from the gains of its modes."""

from functools import cache

import pytest

from avmsf.fem.candidate_bodies import CandidateBodies, CandidateBody
from avmsf.fem.elastic_modes import HeldModes, elastic_modes
from avmsf.fem.material import NOMINAL, STEEL
from avmsf.fem.supports import EndPatch, Place, Support, patches_about
from avmsf.field.gains.estimator import MixtureEstimator
from oracles.block import block
from oracles.known_gains import known_gains

SIDES = (0.24, 0.16, 0.003)


class Plate(CandidateBodies):
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


LEFT, RIGHT = EndPatch("left", (-1.0, 0.0, 0.0)), EndPatch("right", (1.0, 0.0, 0.0))
AT = {LEFT: "its end at (0, 80, 2) mm", RIGHT: "its end at (240, 80, 2) mm"}


@pytest.mark.parametrize(("sides", "stiffness"), [((), 0.0), ((LEFT,), 2e5), ((LEFT,), 1e10), ((LEFT, RIGHT), 2e6)])
def test_the_support_of_a_plate_is_found(sides: tuple[EndPatch, ...], stiffness: float):
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


def test_a_plate_is_held_where_its_user_says():
    feet = ((0.04, 0.0267, 0.0), (0.2, 0.08, 0.0))
    support = Support(tuple(patches_about(feet)), 1e10)
    true = elastic_modes(block(SIDES, (13, 8, 1)), NOMINAL, count=12, support=support)
    report = MixtureEstimator(bodies=Plate(feet)).solve(known_gains(true)[0])[0].report
    assert report["support_evidence"]["held"] > report["support_evidence"]["free"]
    found = report["bodies"][0]
    assert found["support"] == "held at (40, 27, 0) mm and (200, 80, 0) mm"
    assert found["support_stiffness"] > 1e6
    assert found["frequency_factor"] == pytest.approx(1.0, abs=0.1)


def test_a_free_plate_that_is_said_to_be_held_fits_better_free():
    free = elastic_modes(block(SIDES, (13, 8, 1)), NOMINAL, count=12)
    report = MixtureEstimator(bodies=Plate(((0.12, 0.08, 0.0),))).solve(known_gains(free)[0])[0].report
    assert report["bodies"][0]["support"] == "held at (120, 80, 0) mm"
    assert report["support_evidence"]["held"] < report["support_evidence"]["free"]


def test_supports_are_not_tried_where_the_free_body_predicts_the_gains(monkeypatch: pytest.MonkeyPatch):
    asked = []
    monkeypatch.setattr(Plate, "held", lambda plate, body: asked.append(body))
    monkeypatch.setattr(Plate, "supports", "auto")
    case = known_gains(elastic_modes(block(SIDES, (9, 6, 1)), NOMINAL, count=12))[0]
    model, _ = MixtureEstimator(bodies=Plate()).solve(case)
    assert model.report["credibility"]["credible"]
    assert not model.report["supports_tried"]
    assert asked == []
