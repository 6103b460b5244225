"""All the way: what a capture folder holds of an object's look and sound becomes a field, stage by stage."""

import hashlib
import json
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from avmsf.capture import Capture, Impacts
from avmsf.capture.placement import judge_placement
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.warning import CaptureWarning
from avmsf.errors import CaptureError
from avmsf.field.config import FitConfig
from avmsf.field.fit import Progress, fit
from avmsf.field.store import save
from avmsf.modal.extract import ModeFinder
from avmsf.modal.extraction import Extraction
from avmsf.pipeline.choice import choose_features
from avmsf.pipeline.keptmodes import extract_once
from avmsf.pipeline.scene import Listener, SceneConfig, SceneStages
from avmsf.pipeline.stages import StageFolder
from avmsf.scene.features import FeatureField
from avmsf.scene.featurestore import load_features, read_report

CACHE = ".avmsf"
"""Folder inside the capture's that keeps what each stage made."""
MODES, FIELD = "modes.safetensors", "field.safetensors"
"""What the last stages call their outputs."""


@dataclass(frozen=True)
class StageTime:
    """What one stage took."""

    stage: str
    seconds: float
    """Of the run that made it, which may have been an earlier one."""
    fresh: bool
    """Whether it ran now."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A field that was made stage by stage."""

    field: Path
    """The field's file in the cache."""
    stages: tuple[StageTime, ...]
    report: dict[str, Any]
    """What the features' file says of itself; empty where the folder shows nothing of the object."""
    modes: Extraction
    """The modes that the field started from."""


@dataclass(frozen=True)
class ReconstructConfig:
    """Settings of all stages."""

    features: Literal["validated", "visual", "positions"] = "validated"
    """What the field reads of the object's points: their looks, their positions alone, or whichever of the two does
    better on training contacts that are left out in turn."""
    scene: SceneConfig = field(default_factory=SceneConfig)
    fit: FitConfig = field(default_factory=FitConfig)


def reconstruct(
    folder: Path,
    capture: Capture,
    train: Impacts,
    config: ReconstructConfig,
    *,
    method: ModeFinder,
    cache: Path,
    settings: CaptureSettings,
    listener: Listener,
    fitting: Callable[[Progress], None] | None = None,
) -> Reconstruction:
    """Make views, Gaussians, features, modes and a field of a capture, or what of these has to be made anew.

    `train` are the recordings to fit to; `cache` keeps what each stage makes, and an interrupted stage goes on from
    where it was. Raises as the stages do.
    """
    stages = StageFolder(cache)
    scene = SceneStages(folder, stages, config.scene, settings=settings, listener=listener)
    report: dict[str, Any] = {}
    times = []
    if scene:
        features_kept = scene.features
        features = load_features(features_kept.path)
        report = read_report(features_kept.path)
        shape = features_kept.digest
        times = [StageTime(name, each.seconds, each.fresh) for name, each in scene.made().items()]
    else:
        listener.tell(f"{folder} shows nothing of the object: points that fill the box of its contacts stand for it")
        features = FeatureField.from_contacts(capture.impacts.contacts)
        shape = "contacts"
    expect_on_object(capture.impacts, features)
    candidates = {}
    if config.features != "visual" or not scene:
        candidates["positions"] = FeatureField.from_points(features.points)
    if config.features != "positions" and scene:
        candidates["visual"] = features
    heard = {"impacts": digest_of_impacts(train), "method": repr(method)}
    listener.tell(f"modes: of {len(train)} recordings, {train.duration:.3g} s at {train.sample_rate:g} Hz")
    found = stages.keep(MODES, heard, lambda path: extract_once(train, method, path))
    modes = extract_once(train, method, found.path)
    times.append(StageTime("modes", found.seconds, found.fresh))

    def make(path: Path) -> None:
        listener.tell(f"fit: a field of {len(modes.bank)} modes")
        choice = choose_features(train, modes, candidates, config.fit)
        if choice.errors:
            listener.tell("fit: " + ", ".join(f"{name} {error:.3f}" for name, error in choice.errors.items()))
        fitted = fit(
            train,
            candidates[choice.name],
            modes,
            config.fit,
            capture=capture.name,
            checkpoint=stages.checkpoint(FIELD),
            progress=fitting,
        )
        told = {"features": choice.name, "features_errors": dict(choice.errors)}
        origin = replace(fitted.origin, report={**fitted.origin.report, **told})
        save(replace(fitted, origin=origin), path)

    recipe = {
        "features": shape,
        **heard,
        "candidates": list(candidates),
        "fit": asdict(config.fit),
        "name": capture.name,
    }
    kept = stages.keep(FIELD, recipe, make)
    times.append(StageTime("fit", kept.seconds, kept.fresh))
    return Reconstruction(kept.path, tuple(times), report, modes)


def expect_on_object(impacts: Impacts, features: FeatureField) -> None:
    """Say with `CaptureWarning` how far contacts lie off the object's points, and what mistake may explain it.

    Raises `CaptureError` where one lies farther off than the object is large.
    """
    placement = judge_placement(impacts.contacts, features.points)
    words = placement.describe(impacts.names)
    if float(placement.distances.max()) > placement.diagonal:
        raise CaptureError(words)
    if words:
        warnings.warn(words, CaptureWarning, stacklevel=2)


def digest_of_impacts(impacts: Impacts) -> str:
    """Return a digest of all that a fit reads of recordings."""
    words = [impacts.names, impacts.sample_rate]
    digest = hashlib.sha256(json.dumps(words).encode())
    for tensor in (impacts.contacts, impacts.sounds, impacts.directions, impacts.forces):
        digest.update(b"none" if tensor is None else tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()
