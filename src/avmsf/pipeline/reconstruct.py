"""All the way: what a capture folder holds of an object's look and sound becomes a field, stage by stage."""

import hashlib
import json
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from jaxtyping import Float
from torch import Tensor

from avmsf.capture import Capture, Impacts
from avmsf.capture.placement import judge_placement
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.warning import CaptureWarning
from avmsf.errors import CaptureError, FitError
from avmsf.field.config import FitConfig
from avmsf.field.fit import Progress, fit
from avmsf.field.store import save
from avmsf.files import write_whole
from avmsf.modal.extract import ModeFinder
from avmsf.modal.extraction import Extraction
from avmsf.modal.keptmodes import extract_once
from avmsf.pipeline.choice import choose_features
from avmsf.pipeline.scene import Listener, SceneConfig, SceneStages
from avmsf.pipeline.stages import Kept, StageFolder
from avmsf.scene.features import FeatureField
from avmsf.scene.featurestore import load_features, read_report

CACHE = ".avmsf"
"""Folder inside the capture's that keeps what each stage made."""
MODES, CHOICE, FIELD = "modes.safetensors", "choice.json", "field.safetensors"
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
    report: Mapping[str, Any]
    """What the features' file says of itself; empty where the folder shows nothing of the object."""
    modes: Extraction
    """The modes that the field started from."""
    features: str
    """What the field reads of the object's points: positions or visual."""
    errors: Mapping[str, float]
    """What that was decided on: relative STFT errors at training contacts left out in turn; empty where it was set."""


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
    shape = _shape(folder, capture, config, stages, settings=settings, listener=listener)
    expect_on_object(capture.impacts, shape.points, strict=shape.found_frame)
    heard = {"impacts": train.digest(), "method": repr(method)}
    listener.tell(f"modes: of {len(train)} recordings, {train.duration:.3g} s at {train.sample_rate:g} Hz")
    found = stages.keep(MODES, heard, lambda path: extract_once(train, method, path))
    modes = extract_once(train, method, found.path)
    basis = {**heard, "features": shape.digest, "fit": asdict(config.fit)}

    def choose(path: Path) -> None:
        if len(shape.candidates) > 1:
            listener.tell("choice: positions or looks, by training contacts left out in turn")
        choice = choose_features(train, modes, shape.candidates, config.fit)
        words = json.dumps({"name": choice.name, "errors": dict(choice.errors)})
        write_whole(path, lambda place: place.write_text(words, encoding="utf-8"), raising=FitError)

    chosen = stages.keep(CHOICE, {**basis, "candidates": list(shape.candidates)}, choose)
    choice = json.loads(chosen.path.read_text(encoding="utf-8"))

    def make(path: Path) -> None:
        listener.tell(f"fit: a field of {len(modes.bank)} modes on {choice['name']}")
        fitted = fit(
            train,
            shape.candidates[choice["name"]],
            modes,
            config.fit,
            capture=capture.name,
            checkpoint=stages.checkpoint(FIELD),
            progress=fitting,
        )
        told = {"features": choice["name"], "features_errors": choice["errors"]}
        save(replace(fitted, origin=replace(fitted.origin, report={**fitted.origin.report, **told})), path)

    recipe = {**basis, "modes": found.digest, "chosen": choice["name"], "name": capture.name}
    kept = stages.keep(FIELD, recipe, make)
    made = {**shape.made, "modes": found, "choice": chosen, "fit": kept}
    times = tuple(StageTime(name, each.seconds, each.fresh) for name, each in made.items())
    return Reconstruction(kept.path, times, shape.report, modes, choice["name"], choice["errors"])


@dataclass(frozen=True, eq=False)
class _Shape:
    """The points of an object, and what a field may read of them."""

    points: Float[Tensor, "points 3"]
    candidates: Mapping[str, FeatureField]
    made: Mapping[str, Kept]
    """The stages that made it."""
    report: Mapping[str, Any]
    found_frame: bool
    """Whether the cameras' frame was found by structure from motion, which knows nothing of the contacts'."""

    @property
    def digest(self) -> str:
        """Of all candidates."""
        digest = hashlib.sha256()
        for name, each in self.candidates.items():
            digest.update(f"{name} {each.encoder}".encode())
            for tensor in (each.points, each.features):
                digest.update(tensor.contiguous().numpy().tobytes())
        return digest.hexdigest()


def _shape(
    folder: Path,
    capture: Capture,
    config: ReconstructConfig,
    stages: StageFolder,
    *,
    settings: CaptureSettings,
    listener: Listener,
) -> _Shape:
    scene = SceneStages(folder, stages, config.scene, settings=settings, listener=listener)
    bare = capture.surface is not None and not len(capture.surface.faces)
    if not scene or (bare and scene.source is not None and scene.source.kind == "mesh"):
        if capture.surface is None:
            listener.tell(
                f"{folder} shows nothing of the object: points that fill the box of its contacts stand for it"
            )
            features = FeatureField.from_contacts(capture.impacts.contacts)
        else:
            features = FeatureField.from_points(capture.surface.vertices)
        return _Shape(features.points, {"positions": features}, {}, {}, found_frame=False)
    features = load_features(scene.features.path)
    candidates = {}
    if config.features != "visual":
        candidates["positions"] = FeatureField.from_points(features.points)
    if config.features != "positions":
        candidates["visual"] = features
    found_frame = scene.source is not None and scene.source.kind in ("photographs", "video")
    return _Shape(features.points, candidates, scene.made(), read_report(scene.features.path), found_frame)


def expect_on_object(impacts: Impacts, points: Float[Tensor, "points 3"], *, strict: bool = False) -> None:
    """Say with `CaptureWarning` how far contacts lie off the object's points, and what mistake may explain it.

    Raises `CaptureError` where one lies farther off than the object is large, and, if `strict`, where any lies off.
    """
    placement = judge_placement(impacts.contacts, points)
    words = placement.describe(impacts.names)
    if words and (strict or float(placement.distances.max()) > placement.diagonal):
        raise CaptureError(words)
    if words:
        warnings.warn(words, CaptureWarning, stacklevel=2)
