"""From a capture to a field in one call: its shape, from a mesh or from views, its modes, and its gains."""

import operator
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from avmsf._utils.caching import once
from avmsf._utils.device import TRAINABLE, usable_device
from avmsf._utils.progress import ProgressDisplay, ProgressListener
from avmsf._utils.text import counted
from avmsf.capture import Capture, CaptureSettings, Impacts, read_capture
from avmsf.capture.audio import HIGHEST_RATE, LOWEST_RATE
from avmsf.capture.checks import find_surface
from avmsf.capture.settings import settings_of
from avmsf.errors import AvmsfError, FitError, SceneError
from avmsf.features.feature_field import FeatureField
from avmsf.fem.candidate_bodies import CandidateBodies
from avmsf.fem.material import Material, material_named
from avmsf.field.config import AUTO, NETWORK, GainModelName
from avmsf.field.fit import fit as fit_field
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.estimator import estimator_for
from avmsf.field.gains.kernels import Visual
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load, save
from avmsf.field.training import GainEstimator, Progress
from avmsf.mesh import Surface
from avmsf.modal.extraction.extract import FINDERS, Extraction, extract_once
from avmsf.modal.extraction.quality import measure_quality
from avmsf.pipeline.bodies import candidate_bodies, expect_no_recordings, guess_field
from avmsf.pipeline.config import CACHE, CACHED_FIELD, SURFACE, PipelineConfig
from avmsf.pipeline.scene import SceneStages
from avmsf.pipeline.shape import FitShape, is_mesh, object_shape, pipeline_of, shape_of
from avmsf.pipeline.stages import Kept, Pipeline, Stage, StageFolder
from avmsf.pipeline.visual_checks import expect_shape

MODES, FIELD = "modes.safetensors", CACHED_FIELD
"""What the last stages call their outputs."""
BODIES = "bodies"
"""Folder of elastic modes in the cache, kept by content."""
RECORD = "pipeline"
"""What a field's report calls the configuration that made it."""
_FEW = 8
"""Recordings below which little is known of the gains between contacts."""


@dataclass(frozen=True, eq=False)
class StagedFit:
    """A field that was made stage by stage."""

    field: Path
    """The field's file in the cache."""
    stages: Mapping[str, Kept]
    """The output of each stage, by its name, in order."""
    report: Mapping[str, Any]
    """What the features' file says of itself; empty where no features were made."""
    modes: Extraction
    """The modes that the field started from."""

    @property
    def surface(self) -> Path | None:
        """The object's surface in the cache; None where its shape is unknown or the gain model needs none."""
        return self.stages[SURFACE].path if SURFACE in self.stages else None


def fit(
    capture: Capture | Surface | str | Path,
    gain_model: GainModelName | None = None,
    *,
    material: Material | str | None = None,
    features: FeatureField | None = None,
    config: PipelineConfig | None = None,
    cache: str | Path | None = None,
    seed: int | None = None,
    device: str | torch.device | None = None,
    progress: bool = True,
) -> SoundField:
    """Fit a sound field to the recordings of a capture, as `avmsf fit` does.

    The recordings are aligned and their modes found. The object's shape is its mesh, otherwise what photographs, a
    video or Gaussians in the folder show; without any the field knows the contacts' positions alone. Elastic modes are
    computed, and the gain model is fitted and judged by leave-one-out (`SoundField.quality`), in seconds to minutes.

    Args:
        capture: A folder, or what `avmsf.read` made of it. With `material`, a mesh (a file or a Surface), or a folder
            with a mesh or with photographs whose cameras are in meters.
        gain_model: By default "auto", the Gaussian process over all kernel families. It, `seed` and `device` take the
            place of those of `config`.
        material: Give an approximate field without recordings, of this material, see `guess_field`.
        features: Image features of the object's points, for the gain models "visual" and "network"; by default those of
            what the folder shows, otherwise positions.
        config: Settings of all stages.
        cache: Folder that keeps what each stage makes, so that only what changed is computed again; by default `.avmsf`
            in the capture's folder where its views are used, and none otherwise.
        seed: Of all stages; by default 0.
        device: "cpu" or "cuda"; by default a CUDA GPU where there is one.
        progress: Whether the standard error says what is done.

    Returns:
        The field.

    Raises:
        AvmsfError: For a capture that no field can be fitted to.
    """
    config = _configured(PipelineConfig() if config is None else config, gain_model, seed, device)
    source = Path(capture) if isinstance(capture, str) else capture
    with ProgressDisplay() as display:
        listener = display.listener if progress else ProgressListener()
        if material is not None:
            if features is not None or config.gain_model not in (AUTO, Elastic.kind):
                name = "gain_model" if features is None else "features"
                raise FitError.expected("recordings", "material=, which needs none", name=name, advice="leave one out")
            return _guess(source, material, config, cache, listener)
        if isinstance(source, Path):
            if source.is_file():
                wanted = "a capture folder, or material=NAME with a mesh"
                raise FitError.expected(wanted, got="a file without", file=source, name="material")
            source = read_capture(source, settings_of(source).starting(config.time_zero))
        if not isinstance(source, Capture):
            raise FitError.expected("a folder or an avmsf.Capture", type(source).__name__, name="capture")
        if features is None and source.folder is not None:
            expect_shape(source)
        views = isinstance(pipeline_of(source, config, features, StageFolder(Path()), listener=listener), SceneStages)
        with _stage_folder(cache, source.folder if views else None) as stages:
            return load(fit_in_stages(source, config, stages, features=features, listener=listener).field)


def _guess(
    source: Capture | Surface | Path,
    material: Material | str,
    config: PipelineConfig,
    cache: str | Path | None,
    listener: ProgressListener,
) -> SoundField:
    if isinstance(source, Capture):
        raise FitError.expected("a mesh or a folder with material=", "Capture", name="capture")
    settings = settings_of(source) if isinstance(source, Path) else CaptureSettings()
    views = isinstance(source, Path) and source.is_dir() and not is_mesh(find_surface(source, settings))
    with _stage_folder(cache, source if views and isinstance(source, Path) else None) as stages:
        return load(guess_in_stages(source, material, config, stages, settings=settings, listener=listener))


def fit_in_stages(
    capture: Capture,
    config: PipelineConfig,
    stages: StageFolder,
    *,
    train: Impacts | None = None,
    features: FeatureField | None = None,
    features_report: Mapping[str, Any] | None = None,
    listener: ProgressListener | None = None,
) -> StagedFit:
    """Make views, Gaussians, features, modes and a field of a capture, or what of these has to be made anew.

    `train` are the recordings to fit to, by default all; the contacts of all give the object's position. `features`
    describe the object's points, and `features_report` how they were made. An interrupted stage goes on from where it
    was. Raises as the stages do: CaptureError, ExtractionError, FitError, SceneError, SimulationError, FieldFileError,
    and FolderInUseError where another process makes stages in the folder; who reads the field's file afterwards holds
    `stages.lock` around both.
    """
    listener = ProgressListener() if listener is None else listener
    train = capture.impacts if train is None else train
    _expect_start(capture, config)
    if not LOWEST_RATE <= train.sample_rate <= HIGHEST_RATE:
        wanted, advice = f"{LOWEST_RATE:g} to {HIGHEST_RATE:g} Hz", "give another rate: all frequencies scale with it"
        raise FitError.expected(wanted, train.sample_rate, name="sample_rate", advice=advice)
    with stages.lock("avmsf fit"):
        if len(train) < _FEW:
            listener.note(
                f"expected {_FEW} recordings or more to predict gains between contacts well, got {len(train)}"
            )
        pipeline = pipeline_of(capture, config, features, stages, listener=listener)
        # Before the modes: what is wrong with the object's shape shows in less time than they take.
        shape = shape_of(capture, config, features, features_report or {}, pipeline)
        return _fit_shape(capture, train, shape, config, pipeline)


def _fit_shape(
    capture: Capture, train: Impacts, shape: FitShape, config: PipelineConfig, pipeline: Pipeline
) -> StagedFit:
    method, listener = FINDERS[config.extraction](modes=config.modes), pipeline.listener
    recorded = {"impacts": train.digest(), "method": repr(method)}

    @once
    def bodies() -> CandidateBodies:
        listener.log("bodies: finite-element models of the object")
        cache, begun = pipeline.folder.path(BODIES), time.monotonic()
        made = candidate_bodies(
            shape.surface(), config.body, impacts=train, settings=capture.settings, cache=cache, log=listener.log
        )
        listener.ready(BODIES, time.monotonic() - begun)
        return made

    @once
    def estimator() -> GainEstimator:
        return estimator_for(config.gain_model, bodies, shape.symmetries, log=listener.note if shape.known else None)

    def find_modes(path: Path) -> None:
        listener.log(f"modes: {counted(len(train), 'recording')}, {train.duration:.3g} s at {train.sample_rate:g} Hz")
        extract_once(train, method, path, needed=True)

    def train_field(path: Path, found: Path) -> None:
        fitted = fit_gains(
            train,
            shape.features if config.gain_model in (NETWORK, Visual.kind) else shape.points,
            extract_once(train, method, found),
            config,
            estimator(),
            name=capture.name,
            settings=capture.settings,
            checkpoint=pipeline.folder.checkpoint(FIELD),
            listener=listener,
        )
        save(with_record(fitted, config, shape.report), path)

    def recipe() -> dict[str, Any]:
        features = [shape.points.digest(), shape.features.digest()]
        values: dict[str, Any] = {"gain_model": config.gain_model, "name": capture.name, "features": features}
        values |= {"body": asdict(config.body), "fit": asdict(config.fit), "settings": asdict(capture.settings)}
        return {**recorded, **values, "surface": shape.surface_digest}

    if not pipeline.folder.path(MODES).exists():
        # What is wrong with the object's shape shows in less time than the modes take.
        estimator()
    found = pipeline.add(Stage(MODES, find_modes, recipe=lambda: recorded))
    field = pipeline.add(Stage(FIELD, train_field, (MODES,), recipe, lambda path: _is_final(path, config, bodies)))
    return StagedFit(field.path, pipeline.made, shape.report, extract_once(train, method, found.path))


def fit_gains(
    train: Impacts,
    features: FeatureField,
    modes: Extraction,
    config: PipelineConfig,
    gains: GainEstimator,
    *,
    name: str,
    settings: CaptureSettings,
    checkpoint: Path | None = None,
    listener: ProgressListener | None = None,
) -> SoundField:
    """Fit the field of a capture of this name and these settings, whose report has the supporting poles.

    Arguments and errors are those of `avmsf.field.fit`.
    """
    listener = ProgressListener() if listener is None else listener
    quality = measure_quality(modes.aligned(train).sounds, modes, sample_rate=train.sample_rate)
    supporting = torch.nonzero(~quality.is_mode).flatten().tolist()
    listener.log(f"fit: a field of {modes_words(len(modes.bank), len(supporting))}")
    return fit_field(
        train,
        features,
        modes,
        config.fit,
        gains=gains,
        capture=name,
        settings=settings,
        checkpoint=checkpoint,
        progress=lambda progress: _show_step(progress, listener),
        device=config.device,
        supporting=supporting,
    )


def _is_final(path: Path, config: PipelineConfig, bodies: Callable[[], object]) -> bool:
    """Return whether a kept field has the elastic family, or there are still no bodies."""
    if config.gain_model == NETWORK or Elastic.kind not in load(path).origin.report.get("unavailable", {}):
        return True
    try:
        bodies()
    except AvmsfError:
        return True
    return False


def guess_in_stages(
    source: Path | Surface,
    material: Material | str,
    config: PipelineConfig,
    stages: StageFolder,
    *,
    settings: CaptureSettings,
    listener: ProgressListener,
) -> Path:
    """Return the file of a field that is guessed for an object without recordings, made anew where something changed.

    `source` is a mesh, or a folder: the object's shape is then its mesh, or what its photographs show where their
    cameras are known in meters. Raises as the stages and `guess_field` do, FitError for a folder with recordings, and
    SceneError where the size is not known.
    """
    material = material_named(material) if isinstance(material, str) else material
    if settings.held:
        advice = "leave held out for the field of a free object, or record impacts"
        raise FitError.expected("recordings of an object that is held", got="none", name="held", advice=advice)
    with stages.lock("avmsf fit"):
        name, scene = settings.name or "", None
        if isinstance(source, Surface):
            mesh: Surface | None = source
        elif source.is_dir():
            expect_no_recordings(source)
            name = name or source.resolve().name
            mesh = find_surface(source, settings)
            if not is_mesh(mesh):
                scene = SceneStages(
                    source, stages, config.scene, settings=settings, listener=listener, device=config.device
                )
                scene.expect_any()
        else:
            name, mesh = name or source.resolve().stem, Surface.read(source, meters=settings.surface_meters).used()
        if scene is not None and scene.source is not None and scene.source.kind in ("photographs", "video"):
            raise SceneError.expected(
                "a mesh, or photographs with cameras in meters (transforms.json, COLMAP)",
                scene.source.kind,
                got=f"{scene.source.kind} without the object's size",
                file=source if isinstance(source, Path) else None,
            )
        shape, digest = object_shape(mesh, scene)

        def guess(path: Path) -> None:
            guessed = guess_field(
                shape(),
                material,
                body=config.body,
                modes=config.modes,
                config=config.fit,
                settings=settings,
                name=name,
                cache=stages.folder / BODIES,
                log=listener.log,
            )
            save(with_record(guessed, config, {}), path)

        recipe = {"guess": asdict(material), "surface": digest, "modes": config.modes, "body": asdict(config.body)}
        recipe |= {"fit": asdict(config.fit), "settings": asdict(settings), "name": name}
        return Pipeline(stages, listener=listener).add(Stage(FIELD, guess, recipe=lambda: recipe)).path


def with_record(made: SoundField, config: PipelineConfig, features: Mapping[str, Any]) -> SoundField:
    """Return a field whose report has the configuration that made it, but for the fit's own, which it has anyway.

    `features` is the report of the features' file: it names the encoder that was taken and how the features were made,
    which decide where `config.scene` does not, as for a file from elsewhere. Empty where there is none.
    """
    values = asdict(config)
    del values["fit"]
    values["scene"] = features.get("scene")
    values["encoder"] = features.get("encoder")
    return replace(made, origin=replace(made.origin, report={**made.origin.report, RECORD: values}))


def modes_words(poles: int, supporting: int) -> str:
    """Return how many of the poles of a model are modes of the object: "16 modes and 38 supporting poles"."""
    modes = counted(poles - supporting, "mode")
    return f"{modes} and {counted(supporting, 'supporting pole')}" if supporting else modes


def _configured(
    config: PipelineConfig, gain_model: GainModelName | None, seed: int | None, device: str | torch.device | None
) -> PipelineConfig:
    if gain_model is not None:
        config = replace(config, gain_model=gain_model)
    if seed is not None:
        seed = operator.index(seed) if hasattr(seed, "__index__") else seed
        config = replace(config, fit=replace(config.fit, seed=seed), scene=config.scene.with_seed(seed))
    device = config.device if device is None else device
    if device is None:
        return config
    return replace(config, device=str(usable_device(device, raising=FitError, kinds=TRAINABLE)))


@contextmanager
def _stage_folder(cache: str | Path | None, folder: Path | None) -> Iterator[StageFolder]:
    """Yield the stages of a cache, by default of a capture's folder; without either they are kept for this call."""
    if cache is not None or folder is not None:
        yield StageFolder(Path(cache) if cache is not None else Path(folder or ".") / CACHE)
        return
    with tempfile.TemporaryDirectory(prefix="avmsf-", ignore_cleanup_errors=True) as place:
        yield StageFolder(Path(place))


def _show_step(progress: Progress, listener: ProgressListener) -> None:
    """Pass a step of a fit on: its warm-up and its end-to-end training are two stages."""
    if progress.step <= progress.warmup:
        loss = f"squared gain error {progress.loss:.3g}"
        listener.step(f"{progress.stage}, warm-up", progress.step, progress.warmup, loss)
    else:
        done, total = progress.step - progress.warmup, progress.steps - progress.warmup
        listener.step(f"{progress.stage}, end to end", done, total, f"spectral loss {progress.loss:.3g}")


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
