"""Descriptions of the methods in reports."""

from collections.abc import Mapping
from types import MappingProxyType

TITLES: Mapping[str, str] = MappingProxyType(
    {
        "white-noise": "Gaussian noise at the level of the training recordings",
        "random-impact": "a recording of another object",
        "nearest": "the nearest training recording",
        "knn3": "mean waveform of the three nearest recordings (the paper's KNN)",
        "knn3-directions": "mean waveform of the three nearest recordings, by position and impact direction",
        "knn-gains": "modal gains averaged over the three nearest recordings",
        "spline-gains": "modal gains by thin-plate splines",
        "diffsound": "reimplementation of DiffSound, as in the paper",
        "diffsound-weighted": "DiffSound with a fitted weight for each mode",
        "sonicgauss": "SonicGauss with its published weights, trained on ObjectFolder Real, fine-tuned",
        "recorded": "sounds of another system, from files",
        "sonicgauss-small": "SonicGauss's objective at a small size, trained from scratch on simulated objects",
        "field": "attention network, quick settings, visual features",
        "field-auto": "Gaussian process over kernel families (the default of this package)",
        "field-elastic": "Gaussian process on elastic mode shapes only",
        "field-smooth": "Gaussian process on distances only",
        "field-thin-plate": "Gaussian process of thin-plate splines only",
        "field-positions": "attention network, quick settings, positions only",
        "field-unaligned": "attention network, quick settings, without symmetry pooling",
        "field-no-initialization": "attention network, quick settings, without extracted modes",
        "field-no-residual": "attention network, quick settings, without residual noise",
        "field-warmup": "attention network, quick settings, warm-up only",
        "field-grid": "attention network, settings chosen from a small grid",
        "paper": "the paper's method with the preset `paper`, shared damping",
        "paper-per-contact": "the paper's method with damping per contact",
        "paper-positions": "the paper's method without visual features",
        "paper-no-initialization": "the paper's method without extracted modes",
        "paper-unaligned": "the paper's method without symmetry pooling",
        "paper-no-residual": "the paper's method without residual noise",
        "paper-grid": "the paper's method with settings chosen from its lists",
    }
)
"""By the names of `avmsf.evaluation.methods.METHODS`."""


def kind_of(method: str) -> str:
    """Return a method's name without the file or folder that it reads."""
    return method.partition(":")[0]
