"""The bodies that may lie behind an object's surface, as the elastic family takes them."""

import hashlib
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


@dataclass(frozen=True, eq=False)
class CandidateBodies:
    """Bodies of which each is a hypothesis."""

    bodies: NominalBodies
    """Coarse ones where there are several."""
    refine: Refine | None = None
    """Makes the elements of the most probable one finer."""

    def digest(self) -> str:
        """Return a digest of the bodies."""
        digest = hashlib.sha256(("" if self.refine is None else self.refine.digest()).encode())
        for body in self.bodies.bodies:
            digest.update(body.name.encode())
            for tensor in (body.elastic.frequency, body.elastic.nodes, body.elastic.shapes):
                digest.update(tensor.contiguous().numpy().tobytes())
        return digest.hexdigest()
