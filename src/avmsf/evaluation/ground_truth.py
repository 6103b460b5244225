"""The truth of simulated objects, for those metrics that need one."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from scipy.optimize import minimize_scalar

from avmsf.capture.impacts import Impacts
from avmsf.datasets.dataset import Dataset
from avmsf.errors import EvaluationError
from avmsf.modal.extraction.least_squares import NormalEquations
from avmsf.modal.inner_products import poles_of
from avmsf.modal.modes import ModalBank
from avmsf.simulate.ground_truth import TRUTH, Truth, read_truth

LONGEST_DELAY = 0.005
"""Seconds by which the first sample of recordings may differ from the true impact. Onsets that a threshold finds are
off by up to three samples on measured objects, which is 3 ms at 1000 Hz, the lowest rate that is simulated."""


def truth_of(dataset: Dataset, identifier: str) -> Truth | None:
    """Return what is known of an object's modes; None for recorded objects. Raises as `read_truth`."""
    path = _path(dataset, identifier)
    return None if path is None else read_truth(path)


def simulated(dataset: Dataset, names: Sequence[str]) -> frozenset[str]:
    """Return which of the named objects the dataset has and were simulated."""
    return frozenset(each for each in dataset.objects() if each in names and _path(dataset, each) is not None)


def truth_at(truth: Truth, names: tuple[str, ...]) -> Truth:
    """Return the truth of the named recordings, row for row. Raises EvaluationError where it does not know one."""
    rows = {name: row for row, name in enumerate(truth.names)}
    unknown = [name for name in names if name not in rows]
    if unknown:
        raise EvaluationError.expected(
            "the ground truth of all recordings",
            tuple(unknown),
            got=f"none of {', '.join(unknown[:3])}",
            name="names",
            advice="simulate the object again",
        )
    taken = [rows[name] for name in names]
    return replace(
        truth,
        gains=truth.gains[taken],
        quadrature=truth.quadrature[taken],
        names=names,
        contacts=None if truth.contacts is None else truth.contacts[taken],
        starts=None if truth.starts is None else truth.starts[taken],
    )


def truth_from_first_sample(truth: Truth, impacts: Impacts) -> Truth:
    """Return the truth with time counted from the first sample of these recordings of it, row for row.

    Reading and aligning move that sample by one unknown time against the true impacts, the same for all recordings up
    to the errors of alignment, and what a method learns from the recordings counts from there. The time is measured by
    `common_delay`. Where a truth has no `starts`, recordings begin with their impacts and nothing is changed.
    """
    return truth if truth.starts is None else truth.after(common_delay(truth, impacts))


def common_delay(truth: Truth, impacts: Impacts) -> float:
    """Return the seconds from t = 0 of the truth to the first sample of these recordings of it, row for row.

    The one delay of all recordings for which the true modes come nearest to them, in the sum of squares, within
    `LONGEST_DELAY` on either side; so much of the sounds is left out, where they may not have started yet. Energies are
    summed mode by mode, as if modes were orthogonal: their overlaps change slowly with the delay and hardly move the
    minimum, which the modes' phases decide.
    """
    bank = ModalBank(truth.frequency, truth.damping)
    skipped = min(math.ceil(LONGEST_DELAY * impacts.sample_rate), impacts.sounds.shape[1] // 2)
    equations = NormalEquations.of(impacts.sounds[:, skipped:], poles_of(bank, impacts.sample_rate))
    sines, cosines = equations.products.chunk(2, dim=1)
    products = (truth.amplitudes * torch.complex(cosines, sines)).sum(dim=0)
    energies = truth.amplitudes.abs().square().sum(dim=0) * torch.diagonal(equations.gram).reshape(2, -1).mean(dim=0)
    poles = torch.complex(-truth.damping, 2 * math.pi * truth.frequency)

    def misfit(delays: torch.Tensor) -> torch.Tensor:
        turns = torch.exp((delays[:, None] + skipped / impacts.sample_rate) * poles)
        return turns.abs().square() @ energies - 2 * (turns @ products).real

    # Sixteen points in a period of the highest mode: one of them is near the lowest minimum.
    step = 1 / (16 * float(truth.frequency.max()))
    most = round(skipped / impacts.sample_rate / step)
    delays = torch.arange(-most, most + 1).double() * step
    # In parts, for the table of all delays and modes may be large.
    best = float(delays[int(torch.cat([misfit(part) for part in torch.split(delays, 4096)]).argmin())])
    found = minimize_scalar(
        lambda delay: float(misfit(torch.tensor([delay], dtype=torch.float64))),
        bounds=(best - step, best + step),
        method="bounded",
        options={"xatol": 1e-6 * step},
    )
    return float(found.x)


def _path(dataset: Dataset, identifier: str) -> Path | None:
    look = dataset.look(identifier)
    return look.folder / TRUTH if look is not None and (look.folder / TRUTH).is_file() else None
