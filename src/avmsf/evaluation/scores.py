"""Scores of a renderer on test recordings, by all metrics."""

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import import_module
from typing import Any

import torch

from avmsf._utils.arrays import ArrayLike, as_floats
from avmsf._utils.text import counted
from avmsf.capture.folder import Capture
from avmsf.capture.impacts import Impacts
from avmsf.errors import AvmsfWarning, EvaluationError, PositionWarning
from avmsf.evaluation.cdpam import Cdpam
from avmsf.evaluation.metrics import PerContact, validate
from avmsf.evaluation.modal_metrics import ModalRenderer, compare_modes
from avmsf.evaluation.registry import METRICS, MetricSettings, resolve
from avmsf.evaluation.splits import align_split, evenly_spaced, impacts_of
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

    def to_frame(self) -> Any:
        """Return a pandas DataFrame of a row for each recording, by its name, and a column for each metric.

        Raises EvaluationError where pandas, which is no dependency, is not installed.
        """
        try:
            pandas = import_module("pandas")
        except ModuleNotFoundError as error:
            raise EvaluationError.expected("pandas", name="pandas", advice="pip install pandas") from error
        return pandas.DataFrame({name: each.numpy() for name, each in self.values.items()}, index=list(self.names))


def evaluate(
    renderer: Renderer | Callable[[Impacts], Renderer],
    test: Capture | Impacts,
    *,
    train: Capture | Impacts | None = None,
) -> Scores:
    """Score the sounds that a renderer renders at the contacts of recordings against these recordings.

    Args:
        renderer: A SoundField or another renderer; with `train`, a class or function that makes one from it.
        test: The recordings to score on. Without `train` they are taken as they are, but for a SoundField, which aligns
            them as its fit aligned those it was fitted to, and whose sounds are as long as the recordings.
        train: The training recordings, which are aligned with `test` as the methods of `avmsf evaluate` get them
            (`align_split`).

    Returns:
        A value for each metric and recording; `.mean()` and `.to_frame()` sum them up.

    Raises:
        EvaluationError: As `score`, for what is no renderer, and for one at another sample rate.
    """
    impacts = impacts_of(test, "test")
    if train is not None:
        aligned, impacts = align_split(impacts_of(train, "train"), impacts)
        renderer = _made(renderer, aligned)
    made = expect_renderer(renderer)
    lengths = {}
    if isinstance(made, SoundField):
        if made.origin.per_newton != (impacts.forces is not None):
            wanted, got = ("divided", "as recorded") if made.origin.per_newton else ("as recorded", "divided")
            message = f"expected recordings {wanted} by their forces, as the field's, got ones {got}: levels differ"
            warnings.warn(AvmsfWarning(f"test: {message}", name="test"), stacklevel=2)
        impacts = made.aligned(impacts)
        lengths = {"samples": impacts.sounds.shape[1]}
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
        sounds = made.render(impacts.contacts, directions=impacts.directions, **lengths)
    return score(sounds, impacts)


def _made(make: Any, train: Impacts) -> Any:
    """Return what a class or function makes of training recordings. Raises EvaluationError for other objects."""
    if not callable(make) or (isinstance(make, Renderer) and not isinstance(make, type)):
        wanted, kind = "a class or function that makes a renderer of the training recordings", type(make).__name__
        advice = "leave out `train`, or give the class"
        raise EvaluationError.expected(wanted, kind, got=f"an object of {kind}", name="renderer", advice=advice)
    return make(train)


def score(sounds: ArrayLike, impacts: Impacts) -> Scores:
    """Score sounds that were made otherwise than by a renderer, row for row of the impacts.

    By all of `METRICS` that are functions of sounds. Raises EvaluationError for sounds that do not fit the impacts or
    are not finite, with the name of the impact, and ArrayError for what are no numbers.
    """
    sounds = as_floats(sounds, "sounds")
    validate(sounds, impacts.sounds, names=impacts.names)
    values = {}
    for name, entry in METRICS.items():
        if entry.function is None:
            continue
        values[name] = resolve(entry.function)(sounds, impacts.sounds, sample_rate=impacts.sample_rate)
        if values[name].shape != (len(impacts),):
            raise EvaluationError.expected(f"{len(impacts)} values, a sound each", list(values[name].shape), name=name)
        # As missing values they would be left out of means, to the method's advantage.
        if len(bad := torch.nonzero(~torch.isfinite(values[name])).flatten()):
            row = int(bad[0])
            got = f"{float(values[name][row])} of {impacts.names[row]}"
            raise EvaluationError.expected("finite values", float(values[name][row]), got=got, row=row, name=name)
    return Scores(impacts.names, values)


Values = dict[str, tuple[float | None, ...]]
"""Each metric's value for every test contact; None where it was not computed."""
shared_cdpam = lru_cache(maxsize=1)(Cdpam.load)
"""Returns CDPAM, which is read once a process. Raises as `Cdpam.load`."""


def metric_values(
    settings: MetricSettings, renderer: Renderer, sounds: Sounds, test: Impacts, truth: Truth | None, *, loudest: float
) -> tuple[Values, dict[str, float | None]]:
    """Return the metrics of a renderer's sounds at the test contacts, and its figures over all of them.

    `truth`, if known, has the rows of `test`; its time counts from the first sample of the recordings, as the
    renderer's does (`truth_from_first_sample`). `loudest` is the peak of the object's loudest recording, in the unit of
    the recordings. Raises as `score`.
    """
    if renderer.sample_rate != test.sample_rate:
        wanted = f"sounds at the recordings' {test.sample_rate:g} Hz"
        raise EvaluationError.expected(wanted, renderer.sample_rate, name="sample_rate")
    # One factor brings the loudest recording to a peak of one, so that values of different objects can be averaged.
    unit = loudest if loudest > 0 else 1.0
    sounds, scored = sounds / unit, replace(test, sounds=test.sounds / unit)
    values: Values = {metric: tuple(figures.tolist()) for metric, figures in score(sounds, scored).values.items()}
    if settings.cdpam:
        rows = evenly_spaced(len(test), settings.cdpam_contacts or len(test))
        taken = shared_cdpam().distance(sounds[rows], scored.sounds[rows], sample_rate=test.sample_rate)
        found = dict(zip(rows, taken.tolist(), strict=True))
        values["cdpam"] = tuple(map(found.get, range(len(test))))
    if truth is None or not isinstance(renderer, ModalRenderer):
        return values, {}
    figures = compare_modes(renderer, test.contacts, truth, directions=test.directions)
    # Gains at a single contact agree with any others.
    return values, {name: value for name, value in figures.items() if name != "mac" or len(test) > 1}
