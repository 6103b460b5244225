"""The sound field with settings chosen from a grid, on training contacts alone."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

from avmsf.capture.impacts import Impacts, rows_by_place
from avmsf.evaluation.field_methods import FieldVariant
from avmsf.evaluation.task import Task
from avmsf.field.config import FitConfig
from avmsf.field.fit import held_out
from avmsf.field.sound_field import SoundField
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.spectra import envelope

_FEWEST_TO_VALIDATE = 6
"""Training places from which on a part of them is held out to choose settings by, as in `fit` itself."""


@dataclass(frozen=True)
class Grid:
    """Values of the settings that a choice is made of; every combination is a candidate."""

    clusters: tuple[int, ...]
    learning_rate: tuple[float, ...]
    steps: tuple[int, ...]
    """Steps end to end; on a whole object's recordings a step is an epoch."""
    early_weight: tuple[float, ...]
    damping: tuple[Literal["shared", "per-contact"], ...] = ("shared", "per-contact")

    def candidates(self, base: FitConfig) -> Iterator[FitConfig]:
        """Yield `base` with every combination of the values, the last setting changing fastest."""
        names = ("clusters", "learning_rate", "steps", "early_weight", "damping")
        for values in itertools.product(*(getattr(self, name) for name in names)):
            yield replace(base, **dict(zip(names, values, strict=True)))


PAPER_GRID = Grid((128, 256, 512), (1e-2, 5e-3, 1e-3), (5000, 10000, 20000), (0.5, 1.0, 2.0))
"""The paper's lists (supplement, training setup): 162 fits an object, to run where there is time for them."""
QUICK_GRID = Grid((8, 16, 32), (3e-3, 1e-3), (150,), (1.0,))
"""What of it matters at the quick recipe's sizes: 12 fits an object."""


@dataclass(frozen=True)
class GridField(FieldVariant):
    """A field whose settings are chosen from a grid on validation contacts, a part of the training contacts alone.

    The quarter of the training places that farthest-point sampling takes last is held out; every candidate is fitted
    to the others and judged there by ENV (paper, supplement), the mean over contacts of the root mean square difference
    of envelopes. The best is fitted to all training contacts; of equals the first. With fewer than six places nothing
    is held out, and the method's own settings are taken. Modes are those of all training contacts.
    """

    grid: Grid

    def fit(self, task: Task) -> SoundField:
        """Choose and fit the field, whose report has what was chosen. Raises as FieldMethod."""
        features, modes, base = task.features(self.look), self.method.modes(task), self.method.pipeline.fit
        fitted = partial(self.method.fitted, task)
        held = held_out(task.train.contacts, base.validation)
        if len(rows_by_place(task.train.contacts)) < _FEWEST_TO_VALIDATE or not held:
            return _with_report(fitted(task.train, features, modes, base), {"validated": False})
        learnt = [row for row in range(len(task.train)) if row not in held]
        candidates = list(self.grid.candidates(base))
        errors = [
            _held_out_error(
                fitted(task.train.take(learnt), features, _take(modes, learnt), config), task.train.take(held)
            )
            for config in candidates
        ]
        best = min(range(len(candidates)), key=errors.__getitem__)
        chosen = candidates[best]
        report = {
            "validated": True,
            "validation_contacts": [task.train.names[row] for row in held],
            "validation_envelope": errors,
            "chosen": {
                name: getattr(chosen, name)
                for name in ("clusters", "learning_rate", "steps", "early_weight", "damping")
            },
        }
        return _with_report(fitted(task.train, features, modes, chosen), report)


def _take(modes: Extraction, rows: list[int]) -> Extraction:
    return replace(modes, gains=modes.gains[rows], quadrature=modes.quadrature[rows])


def _held_out_error(field: SoundField, held: Impacts) -> float:
    difference = envelope(field.render(held.contacts, directions=held.directions)) - envelope(held.sounds.float())
    return float(difference.square().mean(dim=1).sqrt().mean())


def _with_report(field: SoundField, grid: dict[str, Any]) -> SoundField:
    return replace(field, origin=replace(field.origin, report={**field.origin.report, "grid": grid}))
