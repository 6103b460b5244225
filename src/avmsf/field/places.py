"""Recordings by the places where an object was struck, and those that are held out to choose settings by."""

from jaxtyping import Float
from torch import Tensor

from avmsf.field.thinplate import places_of
from avmsf.scene.points import farthest_points


def rows_by_place(contacts: Float[Tensor, "contacts 3"]) -> tuple[tuple[int, ...], ...]:
    """Return the rows of each place by `places_of`, ascending; places are in the order of their first rows."""
    found: dict[int, list[int]] = {}
    for row, place in enumerate(places_of(contacts.double()).tolist() if len(contacts) else ()):
        found.setdefault(place, []).append(row)
    return tuple(tuple(rows) for rows in found.values())


def held_out(contacts: Float[Tensor, "contacts 3"], fraction: float) -> list[int]:
    """Return all rows of the places, a fraction of all, that farthest-point sampling takes last.

    Of single rows it would take repeats last, whose places are trained on.
    """
    rows = rows_by_place(contacts)
    order = farthest_points(contacts[[each[0] for each in rows]], len(rows)).tolist()
    return [row for place in order[len(rows) - round(fraction * len(rows)) :] for row in rows[place]]
