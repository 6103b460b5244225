"""The contact of an impact in a request of the page."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from avmsf.capture.table import DIRECTION, FARTHEST, REQUIRED
from avmsf.studio.refusal import RefusedError, bad_request


@dataclass(frozen=True)
class Place:
    """Contact, direction and force of one impact."""

    contact: tuple[float, float, float]
    """Object frame, meters."""
    direction: tuple[float, float, float] | None = None
    """Along which the hammer moved, into the object; any length but zero."""
    newtons: float | None = None
    """Peak force, where it is known."""

    @classmethod
    def read(cls, query: Mapping[str, str]) -> "Place":
        """Return the contact of a query x, y, z and optionally nx, ny, nz, newtons. Raises RefusedError (400)."""
        contact = _vector(query, REQUIRED[1:])
        if contact is None:
            raise RefusedError(
                400, "expected the contact as x, y and z in meters, got none; click the object first", name="contact"
            )
        if max(map(abs, contact)) > FARTHEST:
            raise RefusedError(
                400,
                f"expected a contact within {FARTHEST:g} m of the origin, got {contact}",
                name="contact",
                value=contact,
            )
        direction = _vector(query, DIRECTION)
        if direction is not None and math.hypot(*direction) == 0:
            raise RefusedError(
                400, "nx, ny, nz: expected a direction, got the zero vector", name="direction", value=direction
            )
        newtons = None
        if "newtons" in query:
            newtons = _finite(query, "newtons")
            if newtons <= 0:
                raise bad_request("newtons", "a peak force above 0", newtons, got=f"{newtons:g}")
        return cls(contact, direction, newtons)


def _vector(query: Mapping[str, str], names: Sequence[str]) -> tuple[float, float, float] | None:
    if not any(name in query for name in names):
        return None
    x, y, z = (_finite(query, name) for name in names)
    return (x, y, z)


def _finite(query: Mapping[str, str], name: str) -> float:
    try:
        value = float(query[name])
    except (KeyError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        found = query.get(name)
        raise bad_request(name, "a number", found)
    return value
