"""Candidate bodies that are known, in place of those of a surface."""

from collections.abc import Sequence

from avmsf.fem.candidate_bodies import PRESENT_UNIT, CandidateBodies, CandidateBody
from avmsf.fem.elastic_modes import HeldModes


class KnownBodies(CandidateBodies):
    """Bodies of which no finer, held or thicker ones can be had."""

    supports = "free"
    searches_thickness = False

    def __init__(self, bodies: Sequence[CandidateBody]) -> None:
        self.bodies = tuple(bodies)
        self.held_at, self.unit_ratios, self.dofs = (), PRESENT_UNIT, 0

    def refined(self, body: CandidateBody) -> CandidateBody:
        return body

    def held(self, body: CandidateBody) -> HeldModes | None:
        return None
