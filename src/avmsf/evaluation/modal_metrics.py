"""How far a method's modes and gains are from an object's true ones, which only a simulation knows.

Conventions. A mode's amplitudes at the contacts are complex numbers. It weighs by its true
energy, the sum over contacts of |amplitude|^2 / (4 damping), which is what its damped sine has over all time. True
modes and a method's are matched one to one by frequency alone (`match_modes`); true ones that found no partner count
as silence in `gain_error` and as 0 in `mac`, so that no method gains by leaving modes out. Of one contact alone `mac`
tells nothing: it is 1 for all modes found.

Both count time from the same moment: the caller takes the truth to the first sample of the recordings that the method
learned from (`truth_from_first_sample`). A common delay by t would turn mode k by 2 pi f_k t, which is
free, and scale it by exp(-d_k t), which is not.

What is inaudible is free: a mode's phase, one for all contacts, since the paper's fields have sines only, and a
contact's polarity, one sign for all its modes, since fields flip the signs of impacts from opposite sides to agree.
Both are chosen so that `gain_error` is least.
"""

import math
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Complex128, Float, Float64, Int
from scipy.optimize import linear_sum_assignment, minimize_scalar
from torch import Tensor

from avmsf.capture.folder import Capture
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.evaluation.task import Amplitudes, Contacts
from avmsf.modal.extraction.least_squares import NormalEquations
from avmsf.modal.inner_products import poles_of
from avmsf.modal.modes import ModalBank
from avmsf.simulate.ground_truth import TRUTH, Truth, read_truth

MAX_DELAY_SECONDS = 0.005
"""By which the first sample of recordings may differ from the true impact. Onsets that a threshold finds are
off by up to three samples on measured objects, which is 3 ms at 1000 Hz, the lowest rate that is simulated."""


def truth_of(capture: Capture) -> Truth | None:
    """Return what is known of an object's modes; None for recorded objects. Raises as `read_truth`."""
    folder = capture.folder
    return None if folder is None or not (folder / TRUTH).is_file() else read_truth(folder)


def truth_at(truth: Truth, names: tuple[str, ...]) -> Truth:
    """Return the truth of the named recordings, row for row. Raises EvaluationError where it does not know one."""
    rows = {name: row for row, name in enumerate(truth.names)}
    unknown = [name for name in names if name not in rows]
    if unknown:
        wanted, got = "the ground truth of all recordings", f"none of {', '.join(unknown[:3])}"
        raise EvaluationError.expected(
            wanted, tuple(unknown), got=got, name="names", advice="simulate the object again"
        )
    taken = [rows[name] for name in names]
    tables: dict[str, Any] = {name: getattr(truth, name) for name in ("gains", "contacts", "starts", "shifts")}
    tables = {name: None if each is None else each[taken] for name, each in tables.items()}
    return replace(truth, names=names, **tables)


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
    `MAX_DELAY_SECONDS` on either side; so much of the sounds is left out, where they may not have started yet. Energies
    are summed mode by mode, as if modes were orthogonal: their overlaps change slowly with the delay and hardly move
    the minimum, which the modes' phases decide.
    """
    bank = ModalBank(truth.frequency, truth.damping)
    skipped = min(math.ceil(MAX_DELAY_SECONDS * impacts.sample_rate), impacts.sounds.shape[1] // 2)
    equations = NormalEquations.of(impacts.sounds[:, skipped:], poles_of(bank, impacts.sample_rate))
    sines, cosines = equations.products.chunk(2, dim=1)
    products = (truth.amplitudes * torch.complex(cosines, sines)).sum(dim=0)
    energies = truth.amplitudes.abs().square().sum(dim=0) * torch.diagonal(equations.gram).reshape(2, -1).mean(dim=0)
    poles = torch.complex(-truth.damping, 2 * math.pi * truth.frequency)

    def mismatch(delays: torch.Tensor) -> torch.Tensor:
        turns = torch.exp((delays[:, None] + skipped / impacts.sample_rate) * poles)
        return turns.abs().square() @ energies - 2 * (turns @ products).real

    # Sixteen points in a period of the highest mode: one of them is near the lowest minimum.
    step = 1 / (16 * float(truth.frequency.max()))
    most = round(skipped / impacts.sample_rate / step)
    delays = torch.arange(-most, most + 1).double() * step
    # In parts, for the table of all delays and modes may be large.
    best = float(delays[int(torch.cat([mismatch(part) for part in torch.split(delays, 4096)]).argmin())])
    found = minimize_scalar(
        lambda delay: float(mismatch(torch.tensor([delay], dtype=torch.float64))),
        bounds=(best - step, best + step),
        method="bounded",
        options={"xatol": 1e-6 * step},
    )
    return float(found.x)


_SAME_FREQUENCY_RATIO = 0.002
"""Difference of two frequencies of one mode, over the frequency, however narrow the mode is."""
_MAX_ROUNDS = 100
"""Most rounds in which phases and polarities are chosen in turn; a few suffice."""


@runtime_checkable
class ModalRenderer(Protocol):
    """A method whose sounds are modes times gains, with or without residual noise."""

    @property
    def bank(self) -> ModalBank:
        """The modes, the same at all contacts."""

    def complex_gains(self, contacts: Contacts, *, directions: Contacts | None = None) -> Amplitudes:
        """Return amplitudes A at the contacts: their sounds are the real part of the sum of A exp((-d + 2 pi i f) t).

        -i times `Extraction.gains`, in their unit. `directions` are the impacts' unit vectors, if a method uses them.
        """


def compare_modes(
    renderer: ModalRenderer, contacts: Contacts, truth: Truth, *, directions: Contacts | None = None
) -> dict[str, float]:
    """Compare a method's modes and its gains at the contacts with the true ones, row for row.

    Returns means over the true modes, each weighing by its part of the energy: `found` (part of the energy whose modes
    were found), `gain_error` (root of the mean square; of a mode the norm over contacts of the amplitudes' difference,
    over the true norm: 0 is perfect, 1 is silence) and `mac` (the squared correlation over contacts, 0 to 1).

    `directions` are the unit vectors of the impacts, which the true gains belong to. Raises EvaluationError where rows
    differ in number, for values that are not finite, and where the truth is silence at all contacts.
    """
    bank, true = renderer.bank, truth.amplitudes
    predicted = renderer.complex_gains(contacts, directions=directions).detach().cpu().to(torch.complex128)
    _expect_amplitudes(predicted, bank.frequency, "predicted")
    _expect_amplitudes(true, truth.frequency, "truth")
    if len(predicted) != len(true):
        advice = "take the ground truth of these recordings, in their order"
        raise EvaluationError.expected(f"gains at {len(predicted)} contacts", len(true), name="truth", advice=advice)
    energy = true.abs().square().sum(dim=0) / (4 * truth.damping)
    total = energy.sum()
    if not float(total) > 0.0:
        raise EvaluationError.expected("modes with energy", 0.0, got="zero gains at all contacts", name="truth")
    weight, match = energy / total, match_modes(bank, ModalBank(truth.frequency, truth.damping))
    found = match >= 0
    paired = torch.zeros_like(true)
    paired[:, found] = predicted[:, match[found]]
    cross = _free_agreement(paired.conj() * true, 1 / (4 * truth.damping))
    squares, true_squares = paired.abs().square().sum(dim=0), true.abs().square().sum(dim=0)
    # A mode that is silent at all contacts weighs nothing; any figure will do.
    tiny = torch.finfo(torch.float64).tiny
    errors = (squares + true_squares - 2 * cross).clamp(min=0.0) / true_squares.clamp(min=tiny)
    return {
        "found": float(weight[found].sum()),
        "gain_error": math.sqrt(float((weight * errors).sum())),
        "mac": float((weight * (cross.square() / (squares * true_squares).clamp(min=tiny))).sum()),
    }


def match_modes(found: ModalBank, true: ModalBank) -> Int[Tensor, " modes"]:
    """Return for each true mode the row of the found mode that is taken for it, or -1: one to one, by frequency alone.

    Two modes can be one where their frequencies differ by at most the half-power width of the true mode (damping / pi,
    Hz) or, if that is more, .2 % of its frequency. Of all ways to pair them that is taken in which the sum over pairs
    of 1 - (difference / allowed)^2 is largest: many pairs, and close ones rather than a chain of bad ones.
    """
    allowed = torch.maximum(true.damping / math.pi, _SAME_FREQUENCY_RATIO * true.frequency)
    distance = (found.frequency.detach()[None] - true.frequency[:, None]).abs() / allowed[:, None]
    possible = (distance <= 1.0).numpy()
    worth = np.where(possible, 1.0 - distance.square().numpy(), 0.0)
    match = torch.full((len(true),), -1)
    for row, column in zip(*linear_sum_assignment(worth, maximize=True), strict=True):
        if possible[row, column]:
            match[row] = int(column)
    return match


def _free_agreement(products: Amplitudes, weights: Float64[Tensor, " modes"]) -> Float64[Tensor, " modes"]:
    """Return |sum over contacts of polarity times conj(predicted) true| for each mode, by the best polarities.

    The best phase of a mode makes its sum real and positive. The polarities make the weighted total large: phases and
    polarities are chosen in turn until nothing changes, from two beginnings, no contact turned and the signs in the
    products' strongest pattern; of the two ends the larger.
    """
    weighted = products * weights
    pattern = torch.linalg.svd(torch.cat([weighted.real, weighted.imag], dim=1), full_matrices=False)[0][:, 0]
    ends = []
    for polarity in (torch.ones_like(pattern), _signs(pattern)):
        for _ in range(_MAX_ROUNDS):
            sums = polarity.to(weighted) @ weighted
            better = _signs((weighted * torch.sgn(sums).conj()).real.sum(dim=1))
            if torch.equal(better, polarity):
                break
            polarity = better
        ends.append((polarity.to(products) @ products).abs())
    return max(ends, key=lambda sums: float((sums * weights).sum()))


def _signs(values: Float64[Tensor, " contacts"]) -> Float64[Tensor, " contacts"]:
    return torch.where(values < 0.0, -1.0, 1.0).double()


def _expect_amplitudes(amplitudes: Complex128[Tensor, "..."], frequency: Float[Tensor, " modes"], what: str) -> None:
    shape = list(amplitudes.shape)
    if amplitudes.ndim != 2 or shape[1] != len(frequency) or not shape[0]:
        wanted = f"gains [contacts, {len(frequency)} modes] at one contact or more"
        raise EvaluationError.expected(wanted, shape, got=f"the shape {shape}", name=what)
    bad = torch.nonzero(~torch.isfinite(amplitudes.abs()))
    if len(bad):
        row, mode = bad[0].tolist()
        value = amplitudes[row, mode].item()
        raise EvaluationError.expected("finite gains", value, got=f"{value} of mode {mode}", row=row, name=what)
