"""Splits into training and test recordings, and the scores of any renderer on the test recordings."""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from avmsf._utils.arrays import ArrayLike, as_floats
from avmsf.bench.cases import Places
from avmsf.bench.conventions import PAPER, Convention
from avmsf.bench.metrics import PerContact, default_fft_sizes, relative_stft_error, validate
from avmsf.bench.renderer import Renderer
from avmsf.capture.folder import Capture
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError, PositionWarning
from avmsf.field.soundfield import SoundField
from avmsf.scene.points import farthest_points
from avmsf.wording import counted


@dataclass(frozen=True, eq=False)
class Scores:
    """How far rendered sounds are from recorded ones, by several metrics; lower is better."""

    def __repr__(self) -> str:
        means = ", ".join(f"{metric} {value:.3g}" for metric, value in self.mean().items())
        return f"Scores({counted(len(self.names), 'recording')}: {means})"

    convention: str
    """Name of the convention that the metrics follow, `relative_stft` apart, which is the same in all."""
    names: tuple[str, ...]
    """Name of each scored recording."""
    values: Mapping[str, PerContact]
    """For each metric, by name, one value a recording."""

    def mean(self) -> dict[str, float]:
        """Return each metric's mean over the impacts."""
        return {metric: float(values.mean()) for metric, values in self.values.items()}

    def standard_error(self) -> dict[str, float]:
        """Return the standard error of each mean, as if the impacts were independent; NaN for a single impact."""
        return {
            metric: float(values.std()) / math.sqrt(len(values)) if len(values) > 1 else math.nan
            for metric, values in self.values.items()
        }


def split(
    impacts: Impacts, *, fraction: float = 0.2, count: int | None = None, start: int = 0
) -> tuple[Impacts, Impacts]:
    """Return (train, test): all recordings at contacts chosen by farthest-point sampling, and all others.

    Contacts nearer to each other than 1 % of the bounding box's diagonal count as one (`places_of`). `count` contacts
    to train on, or else the nearest whole number to `fraction` of all contacts and at least 2. Training recordings are
    in the order of the choice, from the contact of row `start` on, one a contact, and then the repeated ones; so with
    more contacts the first ones stay the same. Raises EvaluationError where no contact would remain to train on, with a
    fraction fewer than 2, or none to test.
    """
    if count is None and not 0.0 < fraction < 1.0:
        raise EvaluationError(
            f"expected a fraction of training contacts between 0 and 1, got {fraction:g}",
            name="fraction",
            value=fraction,
        )
    places = Places.of(impacts)
    wanted = places.expect_part(fraction) if count is None else places.expect(count)
    case = places.case("", farthest_points(places.contacts, wanted, start=places.number_of(start)))
    return impacts.take(case.train), impacts.take(case.test)


def evaluate(
    renderer: Renderer,
    test: Capture | Impacts,
    *,
    convention: Convention = PAPER,
    fft_sizes: Sequence[int] | None = None,
) -> Scores:
    """Score the sounds that `renderer` renders at the contacts of recordings against these recordings.

    For a SoundField, recordings that are not aligned yet are aligned as its fit aligned those it was fitted to. Raises
    as `score`, and for a renderer at another sample rate.
    """
    impacts = test.impacts if isinstance(test, Capture) else test
    if not isinstance(impacts, Impacts):
        raise EvaluationError(
            f"test: expected a Capture or Impacts, got {type(test).__name__}", name="test", value=type(test).__name__
        )
    if isinstance(renderer, SoundField):
        impacts = renderer.aligned(impacts)
    if renderer.sample_rate != impacts.sample_rate:
        raise EvaluationError(
            f"expected recordings at the field's {renderer.sample_rate:g} Hz, got {impacts.sample_rate:g} Hz; resample "
            "them, or fit a field to recordings of their rate",
            name="sample_rate",
            value=impacts.sample_rate,
        )
    with torch.no_grad(), warnings.catch_warnings():
        # Reading the capture has warned of contacts off the object.
        warnings.simplefilter("ignore", PositionWarning)
        sounds = renderer.render(impacts.contacts, directions=impacts.directions)
    return score(sounds, impacts, convention=convention, fft_sizes=fft_sizes)


def score(
    sounds: ArrayLike,
    impacts: Impacts,
    *,
    convention: Convention = PAPER,
    fft_sizes: Sequence[int] | None = None,
) -> Scores:
    """Score sounds that were made otherwise than by a renderer, row for row of the impacts.

    `relative_stft` with `fft_sizes` in samples, or else with `default_fft_sizes`, and the convention's metrics. Raises
    EvaluationError for sounds that do not fit the impacts or are not finite, with the name of the impact, and
    ArrayError for what are no numbers.
    """
    sounds = as_floats(sounds, "sounds")
    validate(sounds, impacts.sounds, names=impacts.names)
    sizes = default_fft_sizes(impacts.sample_rate) if fft_sizes is None else tuple(fft_sizes)
    values = {"relative_stft": relative_stft_error(sounds, impacts.sounds, fft_sizes=sizes)}
    values |= convention.scores(sounds, impacts.sounds, sample_rate=impacts.sample_rate)
    return Scores(convention=convention.name, names=impacts.names, values=values)
