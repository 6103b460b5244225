"""From a capture to a field in one call: what `avmsf fit` and `SoundField.fit` do."""

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import Progress as Bar

from avmsf._utils.caching import discard
from avmsf._utils.progress import is_live, repeated
from avmsf._utils.wording import counted
from avmsf.capture import Capture, Impacts
from avmsf.capture.placement import surface_points
from avmsf.errors import FitError
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import AUTO, GainModel
from avmsf.field.fit import Progress, fit
from avmsf.field.gains.elastic import CandidateBodies
from avmsf.field.gains.estimator import estimator_for
from avmsf.field.sound_field import SoundField
from avmsf.modal.extraction.extract import Extraction, extract_modes, extract_once
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import PipelineConfig
from avmsf.pipeline.frame_check import expect_on_object
from avmsf.pipeline.record import finder_of, modes_words, supporting_poles, with_record
from avmsf.symmetry.find import find_symmetries
from avmsf.symmetry.symmetries import Symmetries

_FEW = 8
"""Recordings below which little is known of the gains between contacts."""


def fit_capture(
    capture: Capture,
    config: PipelineConfig | None = None,
    *,
    train: Impacts | None = None,
    features: FeatureField | None = None,
    features_report: Mapping[str, Any] | None = None,
    output: Path | None = None,
    log: Callable[[str], None] = lambda message: None,
    progress: Callable[[Progress], None] | None = None,
) -> tuple[SoundField, Extraction]:
    """Fit a field to all recordings of a capture, or to those of `train`; return it and the modes that it started from.

    The contacts of all recordings give the object's position. `features` describe the object's points, and
    `features_report` how they were made; by default they are positions on the mesh, or in the box of the contacts
    if there is no mesh. With the path of an `output`, files next to it hold the modes, the elastic modes and the
    state of the training: after an interruption the same call continues from them. Discard them once the field is
    saved (`discard_unfinished`).

    Raises as the stages do: CaptureError, ExtractionError, FitError, SimulationError, FieldFileError.
    """
    config = PipelineConfig() if config is None else config
    train = capture.impacts if train is None else train
    _expect_start(capture, config)
    points = _points_of(capture, config, features, log)
    if len(train) < _FEW:
        log(f"expected {_FEW} recordings or more to predict gains between contacts well, got {len(train)}")
    # Before the modes: what is wrong with the object's shape shows in less time than they take.
    cache = None if output is None else unfinished(output, "bodies")
    gains = estimator_for(
        config.gain_model,
        lambda: _bodies(capture, config, cache, log),
        symmetries=lambda: _symmetries(capture, config),
        log=None if capture.surface is None and features is None else log,
    )
    log(f"finding the modes of {counted(len(train), 'recording')}, {train.duration:.3g} s at {train.sample_rate:g} Hz")
    kept = None if output is None else unfinished(output, "modes")
    modes = extract_modes(train, finder_of(config)) if kept is None else extract_once(train, finder_of(config), kept)
    supporting = supporting_poles(modes, train)
    log(f"fitting a field of {modes_words(len(modes.bank), len(supporting))}")
    try:
        fitted = fit(
            train,
            points,
            modes,
            config.fit,
            gains=gains,
            capture=capture.name,
            settings=capture.settings,
            checkpoint=None if output is None else unfinished(output, "checkpoint"),
            progress=progress,
            device=config.device,
            supporting=supporting,
        )
    except FitError:
        if kept is not None:
            discard(kept)
        raise
    return with_record(fitted, config, features_report or {}), modes


def _expect_start(capture: Capture, config: PipelineConfig) -> None:
    """Raise FitError where the sounds of a folder were read with another start than the configuration has."""
    found = capture.settings.time_zero
    if config.time_zero not in (None, found):
        raise FitError.expected(
            f"sounds that start at the {config.time_zero}",
            found,
            name="time_zero",
            advice="read the capture with CaptureSettings of this time_zero, or set time_zero=None",
        )


def fit_with_progress(
    capture: Capture,
    gain_model: GainModel | None,
    *,
    features: FeatureField | None,
    config: PipelineConfig | None,
    seed: int | None,
    device: str | None,
    progress: bool,
) -> SoundField:
    """Return what `SoundField.fit` returns."""
    if not isinstance(capture, Capture):
        raise FitError(
            f"capture: expected a Capture, got {type(capture).__name__}; read a folder by avmsf.read(folder)",
            name="capture",
            value=type(capture).__name__,
        )
    config = PipelineConfig() if config is None else config
    if gain_model is not None:
        config = replace(config, gain_model=gain_model)
    if seed is not None:
        config = replace(config, fit=replace(config.fit, seed=seed))
    if device is not None:
        config = replace(config, device=device)
    if not progress:
        return fit_capture(capture, config, features=features)[0]
    console, doing = Console(stderr=True), ["fitting"]
    live = is_live(console)
    with (
        Bar(console=console, transient=True, disable=not live) as bar,
        nullcontext() if live else repeated(lambda: doing[0]),
    ):
        task = bar.add_task("fitting", total=None)

        def say(message: str) -> None:
            doing[0] = message
            console.print(message, markup=False, highlight=False, soft_wrap=True)

        def show(step: Progress) -> None:
            doing[0] = f"{step.stage}: step {step.step} of {step.steps}"
            bar.update(task, description=step.stage, completed=step.step, total=step.steps)

        return fit_capture(capture, config, features=features, log=say, progress=show)[0]


def unfinished(output: Path, ending: str) -> Path:
    """Return where a part of an unfinished fit is kept: next to the field's file."""
    return output.with_name(f"{output.name}.{ending}")


def discard_unfinished(output: Path) -> None:
    """Remove what an unfinished fit needed, after its field has been saved; elastic modes stay."""
    for ending in ("modes", "checkpoint"):
        discard(unfinished(output, ending))


def _no_shape(config: PipelineConfig) -> str:
    """Return the note on a capture without a shape, which says also what its gain model has to do without."""
    lacks = " and no elastic mode shapes" if config.gain_model == AUTO else ""
    return (
        f"the capture has no mesh: points that fill the bounding box of its contacts are used{lacks}. Add surface.obj; "
        "from photographs, a video or Gaussians, avmsf reconstruct makes the shape"
    )


def _points_of(
    capture: Capture, config: PipelineConfig, features: FeatureField | None, log: Callable[[str], None]
) -> FeatureField:
    """Return the object's points: the described ones, else of its surface, else those that fill the contacts' box."""
    if features is not None:
        expect_on_object(capture.impacts.contacts, features.points, names=capture.impacts.names)
        return features
    if config.gain_model == "network":
        log("no visual features were given: the network reads positions alone")
    if capture.surface is None:
        log(_no_shape(config))
        return FeatureField.from_contacts(capture.impacts.contacts)
    expect_on_object(capture.impacts.contacts, surface_points(capture.surface), names=capture.impacts.names)
    return FeatureField.from_mesh(capture.surface, seed=config.fit.seed)


def _bodies(
    capture: Capture, config: PipelineConfig, cache: Path | None, log: Callable[[str], None]
) -> CandidateBodies:
    if capture.surface is None:
        raise FitError("surface: expected a mesh in the capture, got none; add surface.obj to it", name="surface")
    return candidate_bodies(capture.surface, config.body, impacts=capture.impacts, cache=cache, log=log)


def _symmetries(capture: Capture, config: PipelineConfig) -> Symmetries | None:
    if capture.surface is None:
        return None
    generator = torch.Generator().manual_seed(config.fit.seed)
    points = FeatureField.from_mesh(capture.surface, seed=generator).points
    return find_symmetries(points, seed=generator)
