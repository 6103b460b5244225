"""The metrics of one method's sounds: the convention's, CDPAM, and those of its modes against the ground truth."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

from jaxtyping import Float
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.evaluation.metrics import PAPER, PaperConvention
from avmsf.evaluation.modal_metrics import ModalRenderer, judge_modes
from avmsf.evaluation.renderer import Renderer
from avmsf.evaluation.splits import score
from avmsf.simulate.ground_truth import Truth

if TYPE_CHECKING:
    from avmsf.evaluation.cdpam import Cdpam


@dataclass(frozen=True, eq=False)
class Judgement:
    """Metrics of one method's sounds at the test contacts."""

    values: dict[str, tuple[float | None, ...]]
    """Each metric's value for every test contact; None where it was not computed."""
    figures: dict[str, float | None]
    """Values over all test contacts."""


@dataclass(frozen=True)
class Judging:
    """Which metrics are computed."""

    convention: PaperConvention = PAPER
    level: Literal["full-scale", "raw"] = "full-scale"
    """full-scale: all sounds of an object times one factor, so that its loudest recording has a peak of one and L1, ENV
    and CDPAM of different objects can be averaged; methods do not depend on it. raw: in the unit of the recordings,
    such as pascals per newton."""
    cdpam: bool = True
    """Whether to compute CDPAM, the slowest metric."""
    cdpam_contacts: int = 8
    """Number of test contacts per case, evenly spaced, at which CDPAM is computed; 0 for all."""

    def __post_init__(self) -> None:
        if self.cdpam_contacts < 0:
            raise EvaluationError(
                f"expected cdpam_contacts of 0 (all) or more, got {self.cdpam_contacts}",
                name="cdpam_contacts",
                value=self.cdpam_contacts,
            )

    def prepare(self) -> None:
        """Raise EvaluationError where a required package is not installed, before hours of computation."""
        if self.cdpam:
            _cdpam()

    def judge(
        self,
        renderer: Renderer,
        sounds: Float[Tensor, "..."],
        test: Impacts,
        truth: Truth | None,
        *,
        loudest: float,
    ) -> Judgement:
        """Compute the metrics of `renderer` at the test contacts; `truth`, if known, has the rows of `test`.

        Its time counts from the first sample of the recordings, as the renderer's does (`truth_from_first_sample`).
        `loudest` is the peak of the object's loudest recording, in the unit of the recordings. Raises as `score`, and
        EvaluationError for sounds of another sample rate.
        """
        if renderer.sample_rate != test.sample_rate:
            raise EvaluationError(
                f"expected a renderer at the recordings' {test.sample_rate:g} Hz, got {renderer.sample_rate:g} Hz",
                name="sample_rate",
                value=renderer.sample_rate,
            )
        if self.level == "full-scale" and loudest > 0:
            sounds, test = sounds / loudest, replace(test, sounds=test.sounds / loudest)
        scores = score(sounds, test, convention=self.convention)
        values: dict[str, tuple[float | None, ...]] = {
            metric: tuple(figures.tolist()) for metric, figures in scores.values.items()
        }
        if self.cdpam:
            values["cdpam"] = self._cdpam_values(sounds, test)
        return Judgement(values, {} if truth is None else _modal_figures(renderer, test, truth))

    def _cdpam_values(self, sounds: Float[Tensor, "contacts samples"], test: Impacts) -> tuple[float | None, ...]:
        rows = spread(len(test), self.cdpam_contacts or len(test))
        taken = _cdpam().distance(sounds[rows], test.sounds[rows], sample_rate=test.sample_rate)
        found = dict(zip(rows, taken.tolist(), strict=True))
        return tuple(found.get(row) for row in range(len(test)))


def spread(count: int, wanted: int) -> list[int]:
    """Return at most `wanted` of the rows 0 to `count` - 1, evenly spread, in ascending order."""
    if wanted >= count:
        return list(range(count))
    return [(2 * place + 1) * count // (2 * wanted) for place in range(wanted)]


def _modal_figures(renderer: Renderer, test: Impacts, truth: Truth) -> dict[str, float | None]:
    """Return how near a method's modes and gains are to the truth; nothing of methods that have no modes."""
    if not isinstance(renderer, ModalRenderer):
        return {}
    figures = judge_modes(renderer, test.contacts, truth, directions=test.directions).figures()
    # Gains at a single contact agree with any others.
    return {name: value for name, value in figures.items() if name != "mac" or len(test) > 1}


@lru_cache(maxsize=1)
def _cdpam() -> "Cdpam":
    from avmsf.evaluation.cdpam import Cdpam

    return Cdpam.load()
