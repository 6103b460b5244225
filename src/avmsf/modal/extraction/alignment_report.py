"""How a capture's recordings were aligned with one another, as sentences and as plain values."""

from dataclasses import dataclass

from avmsf._utils.text import listed
from avmsf.capture import Impacts
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.recorder_faults import (
    inverted_recordings,
    noise_drop,
    rate_factors,
    uneven_decay,
)

_SHOWN = 8
"""Recordings that a sentence names."""


@dataclass(frozen=True)
class AlignmentReport:
    """How recordings were aligned, as plain values."""

    coherence_before: float
    coherence_after: float
    delays: dict[str, float]
    """Samples by which each recording starts later than it was read."""
    not_aligned: list[str]
    inverted: list[str]
    """Recordings of the opposite sign."""
    rate_factors: dict[str, float]
    """Recordings of another sample rate than their files give, and by how much their modes are higher."""
    uneven_decay_db: float | None
    """By how much a slice sounds fall more than vibrations do; None where they do not."""
    noise_drop_db: float | None
    """By how much noise is louder before the impacts than after; None where it is not."""

    @classmethod
    def of(cls, modes: Extraction, impacts: Impacts) -> "AlignmentReport | None":
        """Return the report on the recordings that the modes are of; None where nothing was aligned."""
        found = modes.alignment
        if found is None:
            return None
        left = [name for name, likely in zip(found.names, found.agreement.tolist(), strict=True) if likely < 0.5]
        delays = dict(zip(found.names, found.delays.tolist(), strict=True))
        aligned, inverted = modes.aligned(impacts), list(inverted_recordings(modes, impacts))
        faults = rate_factors(modes, aligned), uneven_decay(modes, aligned), noise_drop(modes, impacts)
        return cls(found.coherence_before, found.coherence_after, delays, left, inverted, *faults)

    @property
    def doubtful(self) -> set[str]:
        """The recordings that something is wrong with."""
        return {*self.not_aligned, *self.inverted, *self.rate_factors}

    def sentences(self) -> list[str]:
        """Return the faults of recordings, and how coherent the modes' phases are."""
        delays = self._moved
        if not delays:
            return self.warnings()
        how, after = "no delays make the modes' phases agree better than they do as read", ""
        if any(delays):
            how = f"delays of {min(delays):.2f} to {max(delays):.2f} samples align the recordings"
            after = f", {self.coherence_after:.2f} aligned"
        coherence = f"coherence {self.coherence_before:.2f} as read{after} (1 is one phase for each mode)"
        return [*self.warnings(), f"{how}: {coherence}"]

    def warnings(self) -> list[str]:
        """Return a sentence for each fault that recorders and editors make, and for recordings that are not aligned."""
        found = [
            f"{name}: all its modes are {factor:.4g} times the others': it was recorded at {1 / factor:.4g} times the "
            "sample rate that its file gives; convert it from that rate, or remove its row"
            for name, factor in self.rate_factors.items()
        ]
        if self.uneven_decay_db is not None:
            found.append(
                f"the sounds fall by {self.uneven_decay_db:.0f} dB more, within a twelfth of their length, than "
                "vibrations do: a fade-out or a noise gate; export them without it, or write fewer seconds in "
                "capture.toml"
            )
        if self.noise_drop_db is not None:
            found.append(
                f"the noise is {self.noise_drop_db:.0f} dB louder before the impacts than after: an automatic gain "
                "changes levels and decays; turn it off and record again"
            )
        if not self._moved:
            found.append(
                f"the modes have no common phase (coherence {self.coherence_before:.2f}, 1 is one phase for each "
                "mode): the recordings are not aligned. Check whether the sensor or the object was moved, and the "
                "response channel"
            )
            return found
        for names, words, remedy in (
            (self.not_aligned, "not aligned: {}", "the phases of their modes agree with those of no other recording"),
            (
                self.inverted,
                "inverted polarity: {} have the opposite sign of the recordings near them",
                "check the cable and the file, or the direction in impacts.csv",
            ),
        ):
            found += [f"{words.format(listed(names, most=_SHOWN))}; {remedy}"] if names else []
        return found

    @property
    def _moved(self) -> list[float]:
        """The delays of the recordings that are aligned, samples."""
        return [delay for name, delay in self.delays.items() if name not in self.not_aligned]
