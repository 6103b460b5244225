"""All the way: what a capture folder holds of an object's look and sound becomes a field, stage by stage."""

import hashlib
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from avmsf._utils.caching import once
from avmsf._utils.files import write_whole
from avmsf._utils.wording import counted
from avmsf.capture import Capture, Impacts
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.together import find_surface
from avmsf.errors import AvmsfError, SceneError
from avmsf.features.feature_field import FeatureField
from avmsf.features.store import load_features, read_report
from avmsf.field.config import NETWORK
from avmsf.field.fit import Progress, fit
from avmsf.field.gains.elastic import CandidateBodies, Elastic
from avmsf.field.gains.estimator import estimator_for
from avmsf.field.gains.positional import Visual
from avmsf.field.store import load, save
from avmsf.gaussians.ply import read_splats
from avmsf.mesh import Surface
from avmsf.mesh.closest_point import ClosestPoints
from avmsf.mesh.surface import read_surface, write_surface
from avmsf.modal.extraction.extract import Extraction, extract_once
from avmsf.photographs import read_views
from avmsf.photographs.nerf_json import stated_moves
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import CACHED_FIELD, PipelineConfig
from avmsf.pipeline.frame_check import expect_contacts_in_views, expect_on_object, judge_outlines
from avmsf.pipeline.guess import expect_no_recordings, guess_field
from avmsf.pipeline.record import finder_of, modes_words, supporting_poles, with_record
from avmsf.pipeline.scene import ProgressListener, SceneStages
from avmsf.pipeline.stages import Kept, StageFolder
from avmsf.reconstruction import ObjectShape
from avmsf.symmetry.symmetries import Symmetries

SURFACE = "surface.ply"
"""What the stage of the object's surface calls its output, in meters."""
MODES, FIELD = "modes.safetensors", CACHED_FIELD
"""What the last stages call their outputs."""
OFF_MESH = 0.02
"""Distance of a Gaussian from a mesh, over its size, up to which it is of its surface: three pixels of a photograph in
which the object is 150 pixels wide."""
BODIES = "bodies"
"""Folder of elastic modes in the cache, kept by content."""


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
    surface: Path | None = None
    """The object's surface in the cache; None where its shape is unknown or the gain model needs none."""


def reconstruct(
    folder: Path,
    capture: Capture,
    train: Impacts,
    config: PipelineConfig,
    *,
    cache: Path,
    settings: CaptureSettings,
    listener: ProgressListener,
    fitting: Callable[[Progress], None] | None = None,
) -> Reconstruction:
    """Make views, Gaussians, features, modes and a field of a capture, or what of these has to be made anew.

    `train` are the recordings to fit to; `cache` keeps what each stage makes, and an interrupted stage goes on from
    where it was. Raises as the stages do, and FolderInUseError where another process makes stages in `cache`; who
    reads the field's file afterwards holds `StageFolder(cache).lock` around both.
    """
    with StageFolder(cache).lock("reconstruct"):
        return _reconstruct(
            folder,
            capture,
            train,
            config,
            stages=StageFolder(cache),
            settings=settings,
            listener=listener,
            fitting=fitting,
        )


def _reconstruct(
    folder: Path,
    capture: Capture,
    train: Impacts,
    config: PipelineConfig,
    *,
    stages: StageFolder,
    settings: CaptureSettings,
    listener: ProgressListener,
    fitting: Callable[[Progress], None] | None,
) -> Reconstruction:
    shape = _shape(folder, capture, config, stages, settings=settings, listener=listener)
    method = finder_of(config)
    heard = {"impacts": train.digest(), "method": repr(method)}
    listener.log(f"modes: {counted(len(train), 'recording')}, {train.duration:.3g} s at {train.sample_rate:g} Hz")
    found = stages.keep(MODES, heard, lambda path: extract_once(train, method, path, needed=True))
    modes, cache = extract_once(train, method, found.path), stages.folder / BODIES

    def bodies() -> CandidateBodies:
        listener.log("bodies: finite-element models of the object")
        return candidate_bodies(shape.surface(), config.body, impacts=train, cache=cache, log=listener.log)

    def make(path: Path) -> None:
        gains = estimator_for(
            config.gain_model, bodies, symmetries=shape.symmetries, features=shape.features,
            log=listener.log,
        )  # fmt: skip
        supporting = supporting_poles(modes, train)
        listener.log(f"fit: a field of {modes_words(len(modes.bank), len(supporting))}")
        fitted = fit(
            train,
            shape.features if config.gain_model == Visual.kind else shape.points,
            modes,
            config.fit,
            gains=gains,
            capture=capture.name,
            settings=capture.settings,
            checkpoint=stages.checkpoint(FIELD),
            progress=fitting,
            device=config.device,
            supporting=supporting,
        )
        save(with_record(fitted, config, shape.report), path)

    def is_final(path: Path) -> bool:
        """Whether a kept field has the elastic family, or there is still none, as for want of memory."""
        if config.gain_model == NETWORK or Elastic.kind not in load(path).origin.report.get("unavailable", {}):
            return True
        try:
            bodies()
        except AvmsfError:
            return True
        return False

    recipe = {**heard, "features": shape.digest, "fit": asdict(config.fit), "modes": found.digest}
    recipe |= {"gain_model": config.gain_model, "name": capture.name}
    recipe |= {"body": asdict(config.body), "settings": asdict(capture.settings), "surface": shape.surface_digest}
    kept = stages.keep(FIELD, recipe, make, usable=is_final)
    made = {**shape.made, "modes": found, "fit": kept}
    times = tuple(StageTime(name, each.seconds, each.fresh) for name, each in made.items())
    return Reconstruction(kept.path, times, shape.report, modes, made["surface"].path if "surface" in made else None)


def reconstruct_guess(
    folder: Path,
    material: str,
    config: PipelineConfig,
    *,
    cache: Path,
    settings: CaptureSettings,
    listener: ProgressListener,
) -> Path:
    """Return the file of a field that is guessed for an object without recordings, made anew where something changed.

    The object's shape is its mesh, or what its photographs show where their cameras are known in meters. Raises as the
    stages and `guess_field` do, FitError for a folder with recordings, and SceneError where the size is not known.
    """
    expect_no_recordings(folder)
    stages = StageFolder(cache)
    with stages.lock("reconstruct"):
        mesh = find_surface(folder, settings)
        scene = None
        if mesh is None or not len(mesh.faces):
            scene = SceneStages(
                folder, stages, config.scene, settings=settings, listener=listener, device=config.device
            )
            scene.expect_any()
            if scene.source is not None and scene.source.kind in ("photographs", "video"):
                raise SceneError(
                    f"{folder}: expected a mesh, or photographs with cameras in meters (transforms.json, COLMAP), got "
                    f"{scene.source.kind} without the object's size",
                    file=folder,
                    value=scene.source.kind,
                )
        stages.count((*(() if scene is None else scene.outputs[:-1]), FIELD), listener.counting)
        shape, digest = object_shape(mesh, scene)

        def make(path: Path) -> None:
            guessed = guess_field(
                shape(),
                material,
                body=config.body,
                modes=config.modes,
                config=config.fit,
                settings=settings,
                name=settings.name or folder.resolve().name,
                cache=stages.folder / BODIES,
                log=listener.log,
            )
            save(with_record(guessed, config, {}), path)

        recipe = {"guess": material, "surface": digest, "modes": config.modes, "body": asdict(config.body)}
        recipe |= {"fit": asdict(config.fit), "settings": asdict(settings), "name": folder.resolve().name}
        return stages.keep(FIELD, recipe, make).path


@dataclass(frozen=True, eq=False)
class _Shape:
    """What a field may read of an object's points, and its surface."""

    candidates: Mapping[str, FeatureField]
    made: Mapping[str, Kept]
    """The stages that made it."""
    report: Mapping[str, Any]
    surface: Callable[[], Surface | ObjectShape]
    """Makes the object's mesh, or the shape that its views show. Raises SceneError without either."""
    surface_digest: str
    """Of what the surface is made of."""

    @property
    def points(self) -> FeatureField:
        """The object's points with their positions as features."""
        return self.candidates["positions"]

    @property
    def features(self) -> FeatureField:
        """What the network reads: what places look like, or their positions where nothing shows that."""
        return self.candidates.get("visual", self.points)

    def symmetries(self) -> Symmetries | None:
        """Return the symmetries that the features were pooled over, if any were looked for."""
        found = self.report.get("symmetries")
        return None if found is None else Symmetries.from_dict(found)

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
    config: PipelineConfig,
    stages: StageFolder,
    *,
    settings: CaptureSettings,
    listener: ProgressListener,
) -> _Shape:
    scene = SceneStages(folder, stages, config.scene, settings=settings, listener=listener, device=config.device)
    bare = capture.surface is not None and not len(capture.surface.faces)
    shows = bool(scene) and not (bare and scene.source is not None and scene.source.kind == "mesh")
    shaped = config.gain_model != NETWORK and (shows or (capture.surface is not None and not bare))
    stages.count((*(scene.outputs if shows else ()), *((SURFACE,) if shaped else ()), MODES, FIELD), listener.counting)
    if not shows:
        if capture.surface is None:
            listener.log(
                f"{folder}: expected views or a mesh, got none: points that fill the bounding box of the contacts are "
                "used"
            )
            features = FeatureField.from_contacts(capture.impacts.contacts)
        else:
            features = FeatureField.from_points(capture.surface.vertices)
        surface, digest = object_shape(capture.surface, None)
        made = _surface_stage(stages, config, surface, digest, listener)
        return _Shape({"positions": features}, made, {}, surface, digest)
    impacts, stated = capture.impacts, stated_moves(folder, meters=settings.views_meters)
    if scene.source is not None and scene.source.kind == "cameras":
        # Before Gaussians, which take minutes.
        views = read_views(scene.views.path)
        warning = None if capture.surface is None else judge_outlines(capture.surface, views, settings)
        if warning is not None:
            warnings.warn(warning, stacklevel=2)
        expect_contacts_in_views(impacts.contacts, views, settings, stated=stated)
    if scene.splats is not None:
        points = read_splats(scene.cloud.path).centers
        expect_on_object(impacts.contacts, points, names=impacts.names, what="Gaussians", stated=stated)
    features = load_features(scene.features.path)
    surface, digest = object_shape(capture.surface, scene)
    made = scene.made() | _surface_stage(stages, config, surface, digest, listener)
    seen = capture.surface
    if seen is None and "surface" in made:
        # Gaussians lie up to a wall's thickness below the surface, where a wall's other side may be nearer.
        seen = read_surface(made["surface"].path)
    # The paper's network reads the Gaussians' own centers.
    centers = config.gain_model == NETWORK and config.scene.lift.onto == "gaussians"
    if seen is not None and "cloud" in made and not centers:
        features = moved_onto(features, seen)
    candidates = {}
    candidates["positions"] = FeatureField.from_points(features.points)
    candidates["visual"] = features
    # Structure from motion knows nothing of the frame that the contacts are in.
    found_frame = scene.source is not None and scene.source.kind in ("photographs", "video")
    if scene.splats is None:
        expect_on_object(impacts.contacts, features.points, names=impacts.names, stated=stated, strict=found_frame)
    report = read_report(scene.features.path)
    return _Shape(candidates, made, report, surface, digest)


def _surface_stage(
    stages: StageFolder,
    config: PipelineConfig,
    surface: Callable[[], Surface | ObjectShape],
    digest: str,
    listener: ProgressListener,
) -> dict[str, Kept]:
    """Return the stage of the object's surface; none where its shape is unknown or the gain model needs none."""
    if config.gain_model == NETWORK:
        return {}
    try:
        return {"surface": keep_surface(stages, surface, digest)}
    except SceneError as error:
        listener.log(f"no surface is written: {error}")
        return {}


def moved_onto(features: FeatureField, surface: Surface) -> FeatureField:
    """Return features of Gaussians at the places of a mesh nearest to them, without those farther than `OFF_MESH`.

    As they are where most are farther, for the two are in different frames then, and where there are no triangles.
    """
    triangles = surface.vertices.double().numpy()[surface.faces.numpy()]
    sides = triangles[:, 1:] - triangles[:, :1]
    triangles = triangles[np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) > 0]
    if not len(triangles):
        return features
    found = ClosestPoints(triangles)(features.points.double().numpy())
    size = float((surface.vertices.amax(0) - surface.vertices.amin(0)).norm())
    near = found.distances <= OFF_MESH * size
    if 2 * near.sum() < len(near):
        return features
    places = (triangles[found.rows] * found.weights[:, :, None]).sum(axis=1)[near]
    rows = torch.from_numpy(near)
    return replace(features, points=torch.from_numpy(places).to(features.points), features=features.features[rows])


def object_shape(found: Surface | None, scene: SceneStages | None) -> tuple[Callable[[], Surface | ObjectShape], str]:
    """Return what makes the object's shape, and the digest of what it is made of: its mesh before its views.

    `found` is the surface that the folder holds. What is returned raises SceneError where the shape is unknown.
    """
    if found is not None and len(found.faces):
        digest = hashlib.sha256(found.vertices.contiguous().numpy().tobytes())
        digest.update(found.faces.contiguous().numpy().tobytes())
        return lambda: found, digest.hexdigest()
    if scene is None:

        def unknown() -> ObjectShape:
            raise SceneError("surface: expected a mesh or views of the object in the folder, got none", name="surface")

        return unknown, ""
    return once(scene.shape), f"{scene.cloud.digest} {scene.views.digest}"


def keep_surface(stages: StageFolder, make: Callable[[], Surface | ObjectShape], digest: str) -> Kept:
    """Return the file of the object's surface, made where what is kept is of something else. Raises as `make`."""

    def write(path: Path) -> None:
        shape = make()
        surface = shape if isinstance(shape, Surface) else shape.as_seen()
        write_whole(path, lambda place: write_surface(surface, place), raising=SceneError)

    return stages.keep(SURFACE, {"of": digest}, write)
