"""How far estimated contacts are from true ones, as part of the object's size.

Conventions. `predicted` and `truth` are contacts [contacts, 3] of one object frame, row for row the same blow; every
metric returns one figure a contact, in float64, lower is better, and their mean is the score. A symmetric object sounds
the same at several places, and no method can tell those apart by ear: `counterparts` has, for each contact, the places
that are as right as the true one, and the nearest of all of them counts.

- `rmed`: the paper's relative mean Euclidean distance, over the diagonal of the object's bounding box.
- `contact_error`: the ObjectFolder benchmark's, over the object's size as its `scale.json` has it.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.bench.metrics import PerContact
from avmsf.errors import EvaluationError

Places = Float[Tensor, "..."]
"""Shapes that differ are what `validate_places` explains, so the annotations leave them open."""


def validate_places(predicted: Places, truth: Places, *, counterparts: Sequence[Places] | None = None) -> None:
    """Raise EvaluationError unless both are [contacts, 3], as many, at least one, and finite throughout.

    `counterparts` need one [equivalents, 3] for each contact; there may be none of them in it.
    """
    for what, places in (("predicted", predicted), ("true", truth)):
        if places.ndim != 2 or places.shape[1] != 3 or not len(places):
            raise EvaluationError(
                f"{what} contacts must be [contacts, 3] and not empty, got the shape {tuple(places.shape)}; give a "
                "single contact as one row, contact[None]"
            )
        _expect_finite(places, f"the {what} contacts")
    if len(predicted) != len(truth):
        raise EvaluationError(f"{len(predicted)} predicted contacts cannot be compared with {len(truth)} true ones")
    if counterparts is None:
        return
    if len(counterparts) != len(truth):
        raise EvaluationError(
            f"expected counterparts of each of the {len(truth)} contacts, found those of {len(counterparts)}; give a "
            "contact that has none an empty [0, 3]"
        )
    for row, places in enumerate(counterparts):
        if places.ndim != 2 or places.shape[1] != 3:
            raise EvaluationError(
                f"the counterparts of contact {row} must be [equivalents, 3], got the shape {tuple(places.shape)}"
            )
        _expect_finite(places, f"the counterparts of contact {row}")


def rmed(
    predicted: Places, truth: Places, points: Places, *, counterparts: Sequence[Places] | None = None
) -> PerContact:
    """Return the distances over the diagonal of the bounding box of the object's points (all in one unit).

    The box is along the axes of the object's frame. Raises EvaluationError as `validate_places`, and for points that
    span nothing.
    """
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise EvaluationError(f"an object's points must be [points, 3] and not empty, got {tuple(points.shape)}")
    _expect_finite(points, "the object's points")
    places = points.detach().double().cpu()
    diagonal = float((places.amax(dim=0) - places.amin(dim=0)).norm())
    if diagonal == 0.0:
        raise EvaluationError(f"the object's {len(points)} points are all at one place, so that nothing has a size")
    return contact_distances(predicted, truth, counterparts=counterparts) / diagonal


def contact_error(
    predicted: Places, truth: Places, *, scale: float, counterparts: Sequence[Places] | None = None
) -> PerContact:
    """Return the distances over the object's size `scale`, in the contacts' unit.

    Raises EvaluationError as `validate_places`, and for a size that is not positive.
    """
    if not (math.isfinite(scale) and scale > 0.0):
        raise EvaluationError(f"an object's size must be a positive number in the contacts' unit, got {scale:g}")
    return contact_distances(predicted, truth, counterparts=counterparts) / scale


def contact_distances(predicted: Places, truth: Places, *, counterparts: Sequence[Places] | None = None) -> PerContact:
    """Return each contact's Euclidean distance from the nearest right place. Raises as `validate_places`."""
    validate_places(predicted, truth, counterparts=counterparts)
    found, right = (places.detach().double().cpu() for places in (predicted, truth))
    distances = (found - right).norm(dim=1)
    if counterparts is None:
        return distances
    nearest = [_nearest(place, others) for place, others in zip(found, counterparts, strict=True)]
    return torch.minimum(distances, torch.stack(nearest))


def _nearest(place: Float64[Tensor, " 3"], others: Float[Tensor, "equivalents 3"]) -> Float64[Tensor, ""]:
    if not len(others):
        return torch.tensor(math.inf, dtype=torch.float64)
    return (others.detach().double().cpu() - place).norm(dim=1).min()


def _expect_finite(places: Places, what: str) -> None:
    bad = torch.nonzero(~torch.isfinite(places).all(dim=1))
    if len(bad):
        row = int(bad[0])
        raise EvaluationError(f"{what}: row {row} is {places[row].tolist()}; all must be finite")
