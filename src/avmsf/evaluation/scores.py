"""Scores of a renderer on test recordings, by all metrics."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Literal

import torch

from avmsf._utils.arrays import ArrayLike, as_floats
from avmsf._utils.text import counted
from avmsf.capture.folder import Capture
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError, FitError, PositionWarning
from avmsf.evaluation.cdpam import Cdpam
from avmsf.evaluation.metrics import PerContact, validate
from avmsf.evaluation.modal_metrics import ModalRenderer, compare_modes
from avmsf.evaluation.registry import METRICS, resolve
from avmsf.evaluation.splits import align_split, evenly_spaced
from avmsf.evaluation.task import Renderer, Sounds, expect_renderer
from avmsf.field.sound_field import SoundField
from avmsf.simulate.ground_truth import Truth


@dataclass(frozen=True, eq=False)
class Scores:
    """How far rendered sounds are from recorded ones, by several metrics; lower is better."""

    def __repr__(self) -> str:
        means = ", ".join(f"{metric} {value:.3g}" for metric, value in self.mean().items())
        return f"Scores({counted(len(self.names), 'recording')}: {means})"

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


def evaluate(
    renderer: Renderer | Callable[[Impacts], Renderer],
    test: Capture | Impacts,
    *,
    train: Capture | Impacts | None = None,
    fft_sizes: Sequence[int] | None = None,
) -> Scores:
    """Score the sounds that `renderer` renders at the contacts of recordings against these recordings.

    With the training recordings as `train`, `renderer` is a class or function that makes one from them. It gets them,
    and is scored on `test`, as the methods of `avmsf evaluate` are: aligned with one another (`align_split`). Without
    them, recordings are taken as they are. For a SoundField, those that are not aligned yet are aligned as its fit
    aligned those it was fitted to, and its sounds are as long as the recordings. Raises as `score`, and EvaluationError
    for what is no renderer, and for one at another sample rate.
    """
    impacts = _impacts_of(test, "test")
    if train is not None:
        make = _expect_maker(renderer)
        aligned, impacts = align_split(_impacts_of(train, "train"), impacts)
        try:
            renderer = make(aligned)
        except FitError as error:
            if error.name != "capture":
                raise
            raise EvaluationError.expected(
                "a renderer made of recordings alone",
                "SoundField",
                got="a SoundField, whose fit needs the shape in a Capture",
                name="renderer",
                advice="give avmsf.fit(train), without `train`: it aligns the test recordings itself",
            ) from error
    made = expect_renderer(renderer)
    if isinstance(made, SoundField):
        impacts = made.aligned(impacts)
    if made.sample_rate != impacts.sample_rate:
        raise EvaluationError.expected(
            f"recordings at the renderer's {made.sample_rate:g} Hz",
            impacts.sample_rate,
            name="sample_rate",
            advice="resample them, or fit to recordings of their rate",
        )
    with torch.no_grad(), warnings.catch_warnings():
        # Reading the capture has warned of contacts off the object.
        warnings.simplefilter("ignore", PositionWarning)
        if isinstance(made, SoundField):
            samples = impacts.sounds.shape[1]
            sounds = made.render(impacts.contacts, impacts.directions, samples=samples)
        else:
            sounds = made.render(impacts.contacts, directions=impacts.directions)
    return score(sounds, impacts, fft_sizes=fft_sizes)


def _impacts_of(recordings: Capture | Impacts, name: str) -> Impacts:
    impacts = recordings.impacts if isinstance(recordings, Capture) else recordings
    if not isinstance(impacts, Impacts):
        raise EvaluationError.expected("a Capture or Impacts", type(impacts).__name__, name=name)
    return impacts


def _expect_maker(given: Any) -> Callable[[Impacts], Renderer]:
    if not callable(given) or (isinstance(given, Renderer) and not isinstance(given, type)):
        raise EvaluationError.expected(
            "a class or function that makes a renderer of the training recordings",
            type(given).__name__,
            got=f"an object of {type(given).__name__}",
            name="renderer",
            advice="leave out `train`, or give the class",
        )
    make: Callable[[Impacts], Renderer] = given
    return make


def score(sounds: ArrayLike, impacts: Impacts, *, fft_sizes: Sequence[int] | None = None) -> Scores:
    """Score sounds that were made otherwise than by a renderer, row for row of the impacts.

    By all of `METRICS` that are functions of sounds; `relative_stft` with `fft_sizes` in samples where they are given.
    Raises EvaluationError for sounds that do not fit the impacts or are not finite, with the name of the impact, and
    ArrayError for what are no numbers.
    """
    sounds = as_floats(sounds, "sounds")
    validate(sounds, impacts.sounds, names=impacts.names)
    functions = {name: resolve(each.function) for name, each in METRICS.items() if each.function is not None}
    if fft_sizes is not None:
        functions["relative_stft"] = partial(functions["relative_stft"], fft_sizes=fft_sizes)
    values = {}
    for name, function in functions.items():
        values[name] = function(sounds, impacts.sounds, sample_rate=impacts.sample_rate)
        if values[name].shape != (len(impacts),):
            raise EvaluationError.expected(f"{len(impacts)} values, a sound each", list(values[name].shape), name=name)
    return Scores(impacts.names, values)


Values = dict[str, tuple[float | None, ...]]
"""Each metric's value for every test contact; None where it was not computed."""


@dataclass(frozen=True)
class MetricSettings:
    """Which metrics are computed."""

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
            raise EvaluationError.expected("0 (all) or more", self.cdpam_contacts, name="cdpam_contacts")

    def prepare(self) -> None:
        """Raise EvaluationError where a required package is not installed, before hours of computation."""
        if self.cdpam:
            _cdpam()

    def values(
        self, renderer: Renderer, sounds: Sounds, test: Impacts, truth: Truth | None, *, loudest: float
    ) -> tuple[Values, dict[str, float | None]]:
        """Return the metrics of `renderer` at the test contacts, and its figures over all of them.

        `truth`, if known, has the rows of `test`; its time counts from the first sample of the recordings, as the
        renderer's does (`truth_from_first_sample`). `loudest` is the peak of the object's loudest recording, in the
        unit of the recordings. Raises as `score`.
        """
        if renderer.sample_rate != test.sample_rate:
            raise EvaluationError.expected(
                f"sounds at the recordings' {test.sample_rate:g} Hz", renderer.sample_rate, name="sample_rate"
            )
        if self.level == "full-scale" and loudest > 0:
            sounds, test = sounds / loudest, replace(test, sounds=test.sounds / loudest)
        scores = score(sounds, test)
        values: Values = {metric: tuple(figures.tolist()) for metric, figures in scores.values.items()}
        if self.cdpam:
            values["cdpam"] = self._cdpam_values(sounds, test)
        return values, {} if truth is None else _modal_figures(renderer, test, truth)

    def _cdpam_values(self, sounds: Sounds, test: Impacts) -> tuple[float | None, ...]:
        rows = evenly_spaced(len(test), self.cdpam_contacts or len(test))
        taken = _cdpam().distance(sounds[rows], test.sounds[rows], sample_rate=test.sample_rate)
        found = dict(zip(rows, taken.tolist(), strict=True))
        return tuple(map(found.get, range(len(test))))


def _modal_figures(renderer: Renderer, test: Impacts, truth: Truth) -> dict[str, float | None]:
    """Return how near a method's modes and gains are to the truth; nothing of methods that have no modes."""
    if not isinstance(renderer, ModalRenderer):
        return {}
    figures = compare_modes(renderer, test.contacts, truth, directions=test.directions).figures()
    # Gains at a single contact agree with any others.
    return {name: value for name, value in figures.items() if name != "mac" or len(test) > 1}


_cdpam = lru_cache(maxsize=1)(Cdpam.load)
