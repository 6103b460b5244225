"""The bodies that may lie behind an object's surface, as the elastic family takes them."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

from avmsf.fem.candidate_bodies import NominalBodies, NominalBody

Given = TypeVar("Given", contravariant=True)
Made = TypeVar("Made", covariant=True)


@runtime_checkable
class MakesBodies(Protocol[Given, Made]):
    """Computes more bodies of the same object."""

    def __call__(self, given: Given, /) -> Made:
        """Return what `CandidateBodies` says."""
        ...

    def digest(self) -> str:
        """Return what distinguishes its bodies from another's."""
        ...


@dataclass(frozen=True, eq=False)
class CandidateBodies:
    """Bodies of which each is a hypothesis."""

    bodies: NominalBodies
    """Coarse ones where there are several."""
    refine: MakesBodies[NominalBody, NominalBody] | None = None
    """Returns a body with finer elements, or itself where it is fine already or that fails."""
    hold: MakesBodies[NominalBody, Sequence[NominalBody]] | None = None
    """Returns a free body and, of the same elements, with each support; nothing where they cannot be computed."""
    always_hold: bool = False
    """Whether that is tried even if the free body's evidence is good."""
    thicken: MakesBodies[float, NominalBody | None] | None = None
    """Returns the body with a wall of a thickness in meters, None where that fails; None: no thickness is searched."""

    def digest(self) -> str:
        """Return a digest of the bodies."""
        makers = [None if each is None else each.digest() for each in (self.refine, self.hold, self.thicken)]
        digest = hashlib.sha256(f"{makers} {self.always_hold}".encode())
        for body in self.bodies.bodies:
            digest.update(body.name.encode())
            for tensor in (body.elastic.frequency, body.elastic.nodes, body.elastic.shapes):
                digest.update(tensor.contiguous().numpy().tobytes())
        return digest.hexdigest()
