"""How a capture's recordings were aligned with one another, as sentences and as plain values."""

from typing import Any

from avmsf.capture import Impacts
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.polarity import inverted_recordings

_SHOWN = 8
"""Recordings that a sentence names."""


def alignment_values(modes: Extraction, impacts: Impacts) -> dict[str, Any] | None:
    """Return coherences, delays in samples, and the recordings that are named; None where nothing was aligned.

    `modes` are those of `impacts`.
    """
    found = modes.alignment
    if found is None:
        return None
    pairs = list(zip(found.names, found.delays.tolist(), found.agrees.tolist(), strict=True))
    return {
        "coherence_before": found.coherence_before,
        "coherence_after": found.coherence_after,
        "delays": {name: delay for name, delay, _ in pairs},
        "not_aligned": [name for name, _, agrees in pairs if not agrees],
        "inverted": list(inverted_recordings(modes, modes.aligned(impacts))),
    }


def describe_alignment(modes: Extraction, impacts: Impacts) -> list[str]:
    """Say how coherent the phases of the modes of `impacts` are, and name what is not aligned or has the opposite sign.

    Empty where nothing was aligned.
    """
    found = modes.alignment
    if found is None:
        return []
    inverted = list(inverted_recordings(modes, modes.aligned(impacts)))
    if not bool(found.agrees.any()):
        return [
            f"the modes have no common phase (coherence {found.coherence_before:.2f}, 1 is one phase a mode): each "
            "recording keeps its own start. Was the sensor or the object moved, or the response channel another?"
        ]
    moved = found.delays[found.agrees]
    how = "no delays make the modes' phases agree better than they do as read"
    if bool((moved != 0).any()):
        how = f"delays of {float(moved.min()):.2f} to {float(moved.max()):.2f} samples align the recordings"
    coherence = f"coherence {found.coherence_before:.2f} as read"
    if bool((moved != 0).any()):
        coherence += f", {found.coherence_after:.2f} aligned"
    sentences = [f"{how}: {coherence} (1 is one phase for each mode)"]
    left = [name for name, agrees in zip(found.names, found.agrees.tolist(), strict=True) if not agrees]
    if left:
        sentences.append(
            f"not aligned, for their modes' phases agree with no others': {_listed(left)}; they keep their own start"
        )
    if inverted:
        sentences.append(
            f"inverted polarity: {_listed(inverted)} have the opposite sign of the recordings near them; check the "
            "cable and the file, or the direction in impacts.csv"
        )
    return sentences


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more
