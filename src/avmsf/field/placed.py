"""Whether contacts and a surface that physics is made of are in one frame and unit, before shapes are read off it."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from avmsf.capture.placement import Placement, judge_placement
from avmsf.errors import FitError


def expect_placed(
    places: Float[Tensor, "places 3"],
    points: Float[Tensor, "points 3"],
    *,
    names: Sequence[str] = (),
    what: str = "contacts",
) -> None:
    """Raise FitError where places are not on a surface, with the transform that would bring them onto it.

    `points` are all over the surface, as `surface_points` has them; both in metres. Places are not on it where a
    mistake made with all of them explains that, of unit, axes or origin, and where half of them lie farther off than
    `Placement.tolerance`, a twentieth of the object: rough surfaces, glue and single wrong rows pass. `what` they are,
    and their `names`, are for the message.
    """
    placement = judge_placement(places, points)
    if placement.mistake is None and float(placement.distances.median()) <= placement.tolerance:
        return
    found = placement.describe(names, what=what)
    raise FitError(f"physics needs {what} on the surface that its shapes are of, and {found}{_mend(placement)}")


def _mend(placement: Placement) -> str:
    """Say what to do, after what was found: a question where a mistake was."""
    if placement.mistake is None:
        return "; bring both into one frame, or let another way spread the gains"
    if placement.mistake.unit_only:
        return " State each one's unit, as unit and surface_unit in capture.toml do, or give both in metres"
    return " Undo this in one of the two, or let another way spread the gains"
