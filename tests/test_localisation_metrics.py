"""Errors of estimated contacts on a box of known size, and places that cannot be compared."""

import math

import pytest
import torch

from avmsf.bench.localisation import contact_error, rmed
from avmsf.errors import EvaluationError

TRUTH = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], dtype=torch.float64)
PREDICTED = torch.tensor([[0.03, 0.04, 0.0], [0.1, 0.0, 0.0]], dtype=torch.float64)
CORNERS = torch.tensor([[-0.1, -0.1, 0.2], [0.2, 0.3, 0.2], [0.0, 0.0, 1.4]], dtype=torch.float64)


def test_errors_are_distances_over_the_objects_size():
    # 3-4-5, and the box is 0.3 x 0.4 x 1.2, whose diagonal is 1.3.
    assert rmed(PREDICTED, TRUTH, CORNERS).tolist() == pytest.approx([0.05 / 1.3, 0.0], rel=1e-12)
    assert contact_error(PREDICTED, TRUTH, scale=0.25).tolist() == pytest.approx([0.2, 0.0], rel=1e-12)


def test_units_and_places_in_the_frame_do_not_matter():
    expected = rmed(PREDICTED, TRUTH, CORNERS)
    moved = [1000 * (places + 0.7) for places in (PREDICTED, TRUTH, CORNERS)]
    assert torch.allclose(rmed(*moved), expected, atol=1e-12)
    assert rmed(PREDICTED.float(), TRUTH, CORNERS).dtype == torch.float64


def test_two_corners_of_a_box_are_one_apart():
    ends = CORNERS[[0]], torch.tensor([[0.2, 0.3, 1.4]], dtype=torch.float64)
    assert rmed(*ends, CORNERS).tolist() == pytest.approx([1.0], rel=1e-12)


def test_a_symmetric_counterpart_is_as_right_as_the_true_place():
    mirrored = TRUTH * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    counterparts = [torch.tensor([[0.03, 0.05, 0.0], [1.0, 0.0, 0.0]]), mirrored[:0]]
    # The nearest of three places for the first contact, and the true place for the second, which has no other.
    errors = contact_error(PREDICTED, TRUTH, scale=1.0, counterparts=counterparts)
    assert errors.tolist() == pytest.approx([0.01, 0.0], rel=1e-6)
    far = [torch.full((4, 3), 9.0), torch.full((1, 3), 9.0)]
    assert torch.equal(rmed(PREDICTED, TRUTH, CORNERS, counterparts=far), rmed(PREDICTED, TRUTH, CORNERS))


def test_places_that_cannot_be_compared_are_refused():
    with pytest.raises(EvaluationError, match="2 predicted contacts cannot be compared with 1 true ones"):
        rmed(PREDICTED, TRUTH[:1], CORNERS)
    with pytest.raises(EvaluationError, match=r"predicted contacts must be .* got the shape \(3,\); give a single"):
        contact_error(PREDICTED[0], TRUTH, scale=1.0)
    with pytest.raises(EvaluationError, match=r"true contacts must be .* got the shape \(0, 3\)"):
        contact_error(PREDICTED, TRUTH[:0], scale=1.0)
    with pytest.raises(EvaluationError, match=r"the predicted contacts: row 1 is \[nan, nan, nan\]"):
        rmed(PREDICTED * torch.tensor([[1.0], [math.nan]]), TRUTH, CORNERS)
    with pytest.raises(EvaluationError, match="points: row 2 is"):
        rmed(PREDICTED, TRUTH, CORNERS / torch.tensor([[1.0], [1.0], [0.0]]))


def test_objects_without_size_are_refused():
    with pytest.raises(EvaluationError, match="the object's 3 points are all at one place"):
        rmed(PREDICTED, TRUTH, torch.ones(3, 3))
    with pytest.raises(EvaluationError, match=r"must be \[points, 3\] and not empty, got \(0, 3\)"):
        rmed(PREDICTED, TRUTH, CORNERS[:0])
    for scale in (0.0, -1.0, math.nan):
        with pytest.raises(EvaluationError, match="an object's size must be a positive number"):
            contact_error(PREDICTED, TRUTH, scale=scale)


def test_counterparts_that_do_not_fit_are_refused():
    with pytest.raises(EvaluationError, match="counterparts of each of the 2 contacts, found those of 1"):
        rmed(PREDICTED, TRUTH, CORNERS, counterparts=[TRUTH])
    with pytest.raises(EvaluationError, match=r"counterparts of contact 1 must be \[equivalents, 3\], got .*\(3,\)"):
        rmed(PREDICTED, TRUTH, CORNERS, counterparts=[TRUTH, TRUTH[0]])
    with pytest.raises(EvaluationError, match="counterparts of contact 0: row 0 is"):
        rmed(PREDICTED, TRUTH, CORNERS, counterparts=[TRUTH / TRUTH[:, :1], TRUTH])
