"""How many of an object's known modes are found, and how many others are called modes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from avmsf.capture import Impacts
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.quality import measure_quality

AIRCRAFT = (18.85, 40.14, 87.81, 89.63, 97.07, 105.18, 117.99, 125.57, 125.96, 130.0, 135.3, 143.3, 166.23)
"""The modes of `aircraft_response` between 18.8 and 166 Hz, Hz. The published analysis gives their number and range
alone; these frequencies are of an estimator that shares no code with this project: least squares in the frequency
domain with a common denominator (p-LSCF) in the bands 10-60, 60-115, 115-140 and 140-175 Hz; medians of the poles that
are stable to .3 % of frequency and 20 % of damping from order to order, at more than half of the orders from 10 to 60.
Weaker companions at 39.7, 124.2 and 165.3 Hz are left out, as the published analysis has 13 modes.
"""
NEAR = 0.005
"""Part of its frequency by which a mode may be off and still be taken for it."""
LEAST_SHARE = 0.01
"""Part of the energy from which a mode that is not known counts, for the aircraft."""


@dataclass(frozen=True)
class ModeCount:
    """Modes found in recordings, compared with those that the object is known to have."""

    found: int
    """Known modes that are found."""
    extra: int
    """Other modes in the known ones' range."""


def count_modes(
    impacts: Impacts, extraction: Extraction, known: Sequence[float], *, least_share: float = 0.0
) -> ModeCount:
    """Match the modes of an extraction with the known frequencies (Hz), one to one, by the least sum of distances.

    Poles that are no modes by their quality do not count; of others than the known ones those do that lie in the known
    ones' range and have `least_share` of the energy of all poles. `impacts` is what the extraction is of.
    """
    quality = measure_quality(extraction.aligned(impacts).sounds, extraction, sample_rate=impacts.sample_rate)
    frequency, share = extraction.bank.frequency[quality.is_mode], quality.energy_share[quality.is_mode]
    truth = np.asarray(known)
    distance = np.abs(frequency.numpy()[:, None] / truth[None, :] - 1)
    # What is too far counts as just too far, so that it never takes a nearer partner from another.
    rows, columns = linear_sum_assignment(np.minimum(distance, NEAR))
    rows = rows[distance[rows, columns] < NEAR]
    other = torch.ones(len(frequency), dtype=torch.bool)
    other[torch.from_numpy(rows)] = False
    inside = (frequency > truth.min() * (1 - NEAR)) & (frequency < truth.max() * (1 + NEAR))
    return ModeCount(len(rows), int((other & inside & (share >= least_share)).sum()))


def tree_frequencies(data: Path) -> list[float]:
    """Return the 24 frequencies of `tree43` in a folder of measured data, Hz."""
    with np.load(data / "tree43" / "truth.npz") as truth:
        return [float(each) for each in truth["frequency"]]
