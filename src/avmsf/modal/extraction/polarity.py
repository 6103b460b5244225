"""Recordings whose sign is inverted: a cable or an editor that turned one file's polarity round.

Phases are aligned modulo pi, so they do not show it. What does is the gains over the object: near contacts, struck in
the same direction, have gains of the same sign. Each mode's gains along its phase are predicted at every contact from
all others by a Gaussian process whose length scale and noise have the greatest likelihood over all modes. The
correlation of predicted and measured gains over modes is about c for most recordings, and about -c for an inverted one.
"""

import itertools
import math
from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.modes import common_phase

_LENGTHS = (0.05, 0.1, 0.2, 0.4, 0.8)
"""Length scales over the diagonal of the contacts' bounding box."""
_NOISES = (0.01, 0.03, 0.1, 0.3, 1.0)
"""Variances of what neighbors do not predict, over the kernel's."""
_FALSE_ALARM = 1e-3
"""Probability that an inverted recording is named in a capture that has none, by normal correlations."""
_MIN_CORRELATION = 0.5
"""Median correlation below which neighbors explain less than a quarter of the gains' energy, and nothing is judged."""
_MIN_RECORDINGS = 6
"""Recordings below which the spread of their correlations is not known."""
_NORMAL = 1.4826
"""Standard deviation of normal numbers over the median distance from their median."""


def inverted_recordings(modes: Extraction, impacts: Impacts) -> tuple[str, ...]:
    """Return the names of recordings whose sign is the opposite of the others'; `modes` are those of `impacts`.

    Empty where contacts lie so far apart that neighbors do not determine a gain's sign. Recordings that could not be
    aligned are not judged.
    """
    if modes.alignment is not None and len(left := torch.nonzero(modes.alignment.agreement < 0.5)):
        rows = [row for row in range(len(impacts)) if row not in left]
        impacts = impacts.take(rows)
        modes = replace(modes.take(rows), alignment=None)
    signs, found = torch.ones(len(impacts), 1, dtype=torch.float64), list[int]()
    while len(impacts) >= _MIN_RECORDINGS and len(found) < len(impacts) // 3:
        # One at a time: an inverted recording spoils what is predicted at its neighbors.
        turned = replace(modes, gains=modes.gains * signs)
        correlation = _predicted(turned, impacts)
        usual, worst = float(correlation.median()), int(correlation.argmin())
        deviation = max(_NORMAL * float((correlation - usual).abs().median()), 1 / math.sqrt(len(modes.bank)))
        # The log odds of a correlation about -c to one about c, of so many recordings.
        odds = -2 * usual * float(correlation[worst]) / deviation**2
        if usual < _MIN_CORRELATION or odds < math.log(len(impacts) / _FALSE_ALARM) or worst in found:
            break
        found.append(worst)
        signs[worst] = -1.0
    return tuple(impacts.names[row] for row in sorted(found))


def _predicted(modes: Extraction, impacts: Impacts) -> Float64[Tensor, " contacts"]:
    """Return the correlation, over modes, of each recording's gains with those predicted from all others."""
    phase = common_phase(modes.gains)
    gains = modes.gains.to(torch.complex128)
    along = gains.real * phase.cos() + gains.imag * phase.sin()
    energy = (gains.real.square() + gains.imag.square()) / modes.bank.damping
    # Every recording counts alike, however loud, and every mode by its energy.
    along = along / modes.bank.damping.sqrt() / energy.sum(1, keepdim=True).sqrt().clamp_min(1e-300)
    contacts = impacts.contacts.double()
    distance = torch.cdist(contacts, contacts) / (contacts.amax(0) - contacts.amin(0)).norm().clamp_min(1e-300)
    facing = torch.ones_like(distance)
    if impacts.directions is not None:
        facing = impacts.directions.double() @ impacts.directions.double().T
    best, chosen, share = -math.inf, along, along.square().sum(0) / along.square().sum()
    for length, noise in itertools.product(_LENGTHS, _NOISES):
        kernel = facing * torch.exp(-0.5 * (distance / length).square())
        whole = kernel + noise * torch.eye(len(kernel), dtype=torch.float64)
        inverse = torch.linalg.inv(whole)
        solved = inverse @ along
        scale = (along * solved).sum(0).clamp_min(1e-300)
        # Each mode's own variance is integrated out.
        likelihood = -0.5 * len(along) * (scale.log() * share).sum() - 0.5 * torch.logdet(whole)
        if float(likelihood) > best:
            best, chosen = float(likelihood), along - solved / torch.diagonal(inverse)[:, None]
    sizes = (along.norm(dim=1) * chosen.norm(dim=1)).clamp_min(1e-300)
    return (along * chosen).sum(1) / sizes
