"""Modes as a table, as `avmsf modes` and `avmsf info` print them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.text import counted, format_number
from avmsf.cli.printing import decimals, table
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.quality import ModeQuality
from avmsf.modal.modes import ModalBank

_LISTED = 20
"""Modes in a table, those of most energy."""


@dataclass(frozen=True)
class ModeRow:
    """One mode, as plain values."""

    number: int
    """From 1, by frequency, among all poles of the model."""
    frequency_hertz: float
    damping_per_second: float
    t60_seconds: float
    """Time in which it falls by 60 dB, ln(1000) / damping."""
    level_db: float
    """Root mean square of its amplitude over recordings or points, against the strongest pole's."""

    @property
    def energy_db(self) -> float:
        """Its energy over time, which is proportional to the square of its amplitude and to its decay time."""
        return self.level_db + 10 * math.log10(self.t60_seconds)


@dataclass(frozen=True)
class QualityRow:
    """How well the recordings support one mode, as plain values."""

    frequency_spread_hertz: float
    damping_spread_per_second: float
    stable_orders: float
    """Part of the model orders that find it again, from 0 to 1."""
    phase_coherence: float
    """One if its phase is the same in all recordings, modulo pi."""
    energy_share: float
    """Part of the energy of all poles, from 0 to 1."""
    explained_left_out: float
    """What of its energy in a recording the other recordings' pole explains, from 0 to 1; .5 by chance."""


def quality_rows(quality: ModeQuality) -> list[QualityRow]:
    """Return the quality of each mode, in the bank's order."""
    columns = (
        quality.frequency_spread,
        quality.damping_spread,
        quality.stable_orders,
        quality.coherence,
        quality.energy_share,
        quality.explained_left_out,
    )
    return [QualityRow(*values) for values in zip(*(column.tolist() for column in columns), strict=True)]


def mode_rows(bank: ModalBank, level_db: Float[Tensor, " modes"]) -> list[ModeRow]:
    """Return the modes in the bank's order."""
    columns = (bank.frequency.tolist(), bank.damping.tolist(), level_db.tolist())
    return [
        ModeRow(number, frequency, damping, math.log(1000) / damping, level)
        for number, (frequency, damping, level) in enumerate(zip(*columns, strict=True), start=1)
    ]


def listed(of: str, rows: Sequence[ModeRow], supporting: int) -> tuple[str, list[ModeRow], str]:
    """Return a table's title, the modes of most energy that it lists, and what is to be said of the other poles."""
    most = sorted(rows, key=lambda row: row.energy_db, reverse=True)[:_LISTED]
    which = "by energy" if len(most) == len(rows) else f"the {_LISTED} of most energy"
    poles = counted(supporting, "supporting pole")
    title = f"{counted(len(rows), 'mode')}{of}, {which}"
    return title, most, f"{poles} in the model, but not modes (--json lists all)" if supporting else ""


def levels(amplitudes: Float[Tensor, "contacts modes"]) -> Float[Tensor, " modes"]:
    """Return each mode's root mean square amplitude against the strongest pole's, dB."""
    size = amplitudes.square().mean(0).sqrt()
    floor = torch.finfo(size.dtype).tiny
    return 20 * torch.log10((size / size.max().clamp_min(floor)).clamp_min(1e-10))


def amplitudes(extraction: Extraction) -> Float[Tensor, "contacts modes"]:
    """Return the modes' amplitudes in each recording, whatever their phase."""
    return extraction.gains.abs()


def mode_table(title: str, rows: Sequence[ModeRow], quality: Mapping[int, QualityRow] | None = None) -> object:
    """Return modes for printing, with their quality by their numbers where it is known."""
    columns = ["", "frequency Hz", "damping 1/s", "T60 s", "level dB"]
    columns += [] if quality is None else ["energy", "phase", "orders", "left out"]
    cells = []
    for row in rows:
        frequency, damping = decimals(row.frequency_hertz, 2), format_number(row.damping_per_second)
        cell = [str(row.number), frequency, damping, format_number(row.t60_seconds), decimals(row.level_db, 1)]
        if quality is not None:
            how = quality[row.number]
            cell[1] += f" ± {format_number(how.frequency_spread_hertz, 2)}"
            cell[2] += f" ± {format_number(how.damping_spread_per_second, 2)}"
            cell += [f"{100 * how.energy_share:.2f} %", decimals(how.phase_coherence, 2)]
            cell += [f"{100 * how.stable_orders:.0f} %", f"{100 * how.explained_left_out:.0f} %"]
        cells.append(cell)
    return table(title, columns, cells)
