"""The bodies that may lie behind an object's surface, as the elastic family takes them."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from avmsf.simulate.nominal import NominalBodies, NominalBody


@runtime_checkable
class Refine(Protocol):
    """Computes a body anew with finer elements."""

    def __call__(self, body: NominalBody) -> NominalBody:
        """Return the body with finer elements, or itself where it is fine already or that fails."""
        ...

    def digest(self) -> str:
        """Return what tells its bodies from another's."""
        ...


@runtime_checkable
class Hold(Protocol):
    """Computes the modes of a free body where it is held."""

    def __call__(self, body: NominalBody) -> Sequence[NominalBody]:
        """Return the free body and, of the same elements, with each support; none where it cannot be computed."""
        ...

    def digest(self) -> str:
        """Return what tells its bodies from another's."""
        ...


@runtime_checkable
class Thicken(Protocol):
    """Computes a body with a wall of another thickness."""

    def __call__(self, wall: float) -> NominalBody | None:
        """Return the body with a wall of this thickness, meters; None where that fails."""
        ...

    def digest(self) -> str:
        """Return what tells its bodies from another's."""
        ...


@dataclass(frozen=True, eq=False)
class CandidateBodies:
    """Bodies of which each is a hypothesis."""

    bodies: NominalBodies
    """Coarse ones where there are several."""
    refine: Refine | None = None
    """Makes the elements of the most probable one finer."""
    hold: Hold | None = None
    """Holds the most probable free one."""
    always_hold: bool = False
    """Whether that is tried even if the free body's evidence is good."""

    thicken: Thicken | None = None
    """Gives a body another wall; None where no thickness is searched for."""

    def digest(self) -> str:
        """Return a digest of the bodies."""
        digest = hashlib.sha256(("" if self.refine is None else self.refine.digest()).encode())
        digest.update(("" if self.thicken is None else f"thicken {self.thicken.digest()}").encode())
        if self.hold is not None:
            digest.update(f"{self.hold.digest()} {self.always_hold}".encode())
        for body in self.bodies.bodies:
            digest.update(body.name.encode())
            for tensor in (body.elastic.frequency, body.elastic.nodes, body.elastic.shapes):
                digest.update(tensor.contiguous().numpy().tobytes())
        return digest.hexdigest()
