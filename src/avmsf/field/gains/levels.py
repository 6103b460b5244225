"""Recordings of two levels: those from one on were made with another gain, microphone place or force scale.

Where the recordings from the k-th on are g times too loud, the gains y of a series of n contacts are D z, D being
diagonal with 1 before the k-th contact and g from it on, and z gains as the kernels describe them. So

    log p(y | k, g) = log p_z(D^-1 y) - (n - k) log g

with the evidence of kernel families for p_z. Smooth families without a body are enough: a step of the level is seen in
contacts near each other. All series have k and g in common. It explains only what nothing else does: contacts in the
order of their places, as a roving hammer's, may be weaker from one on since the object is stiffer there.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from avmsf.field.gains.family import KernelFamily
from avmsf.field.gains.fitting import MeasuredGains, WeighedFamily, total_evidence
from avmsf.field.gains.mixture import NOISE_SHARES

_FEWEST = 3
"""Recordings of a group: of fewer, each is judged by itself."""
_COARSE = (-30, -24, -18, -12, -6, 6, 12, 18, 24, 30)
_FINE = (-3, -2, -1, 0, 1, 2, 3)
"""Levels tried, dB, and those about the best of them."""
_SURE = 0.5
"""Nats for each series by which the evidence has to rise, beside the logarithm of how many steps are tried."""


def two_levels(families: Sequence[KernelFamily], measured: MeasuredGains) -> tuple[int, float] | None:
    """Return the first of the last contacts that are of another level, and by how many dB they are louder.

    None where one level explains the gains about as well. `families` are those of the measured contacts, in the order
    in which they were recorded.
    """
    count, series = len(measured.values), float(measured.informative.sum())

    def evidence(first: int, level: float) -> float:
        values = measured.values.clone()
        values[first:] *= 10 ** (-level / 20)
        moved = replace(measured, values=values)
        jacobian = series * (count - first) * level / 20 * math.log(10)
        return total_evidence([WeighedFamily.of(each, moved, NOISE_SHARES) for each in families], moved) - jacobian

    tried = {
        (first, level): evidence(first, level) for first in range(_FEWEST, count - _FEWEST + 1) for level in _COARSE
    }
    if not tried:
        return None
    first, level = max(tried, key=tried.__getitem__)
    near = {(first, float(level + more)): evidence(first, level + more) for more in _FINE}
    best = max(near, key=near.__getitem__)
    rise = near[best] - evidence(0, 0.0)
    return best if rise > _SURE * series + math.log(len(tried)) else None
