"""The object's shape as a fit reads it: from a mesh, from views, or from positions alone."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from avmsf._utils.caching import once
from avmsf._utils.files import write_whole
from avmsf._utils.progress import ProgressListener
from avmsf.capture import Capture
from avmsf.capture.placement import expect_placed
from avmsf.errors import FitError, SceneError
from avmsf.features.feature_field import FeatureField, load_features, read_report
from avmsf.field.config import AUTO, NETWORK
from avmsf.field.gains.kernels import Visual
from avmsf.gaussians.ply import read_splats
from avmsf.mesh import Surface
from avmsf.mesh.queries import ClosestPoints
from avmsf.mesh.surface import surface_points
from avmsf.photographs import read_views
from avmsf.pipeline.config import DESCRIPTORS, PRESETS, SURFACE, PipelineConfig
from avmsf.pipeline.scene import CLOUD, FEATURES, SceneStages
from avmsf.pipeline.stages import Kept, Pipeline, Stage, StageFolder
from avmsf.pipeline.views import VIEWS
from avmsf.pipeline.visual_checks import WITHOUT_SHAPE, expect_contacts_in_views, expect_mesh_in_views
from avmsf.reconstruction import ObjectShape
from avmsf.symmetry.find import find_symmetries
from avmsf.symmetry.symmetries import Symmetries

POINTS = "points.safetensors"
"""What the stage of the features is called where the gain model reads none: their points are the object's."""
OFF_MESH = 0.02
"""Distance of a Gaussian from a mesh, over its size, up to which it is of its surface: three pixels of a photograph in
which the object is 150 pixels wide."""


@dataclass(frozen=True, eq=False)
class FitShape:
    """What a field may read of an object's points, and its surface."""

    points: FeatureField
    """The object's points with their positions as features, or with those that were given."""
    features: FeatureField
    """What the network reads: image features, or positions where there are none."""
    symmetries: Callable[[], Symmetries | None]
    """Finds the symmetries of the object's shape."""
    surface: Callable[[], Surface | ObjectShape]
    """Makes the object's mesh, or the shape that its views show. Raises SceneError without either."""
    surface_digest: str
    """Of what the surface is made of."""
    report: Mapping[str, Any]
    """How the features were made."""
    known: bool = True
    """Whether anything shows the shape."""


def pipeline_of(
    capture: Capture,
    config: PipelineConfig,
    features: FeatureField | None,
    folder: StageFolder,
    *,
    listener: ProgressListener,
) -> Pipeline:
    """Return the stages of the views that a fit needs: for a shape without a mesh, and for features.

    None of these, but a pipeline for the later stages, where the folder shows nothing but points.
    """
    reads = features is None and config.gain_model in (NETWORK, Visual.kind)
    # The network needs no surface.
    needed = reads or (config.gain_model != NETWORK and not is_mesh(capture.surface))
    if needed and capture.folder is not None:
        scene, name = config.scene, FEATURES
        if not reads:
            # Of the features only the points and their symmetries are read, which are the same for any encoder.
            scene, name = replace(scene, lift=replace(scene.lift, encoder=DESCRIPTORS)), POINTS
        made = SceneStages(
            capture.folder, folder, scene, settings=capture.settings, listener=listener, name=name, device=config.device
        )
        points = capture.surface is not None and not is_mesh(capture.surface)
        if made and not (points and made.source is not None and made.source.kind == "mesh"):
            return made
    return Pipeline(folder, listener=listener)


def shape_of(
    capture: Capture,
    config: PipelineConfig,
    features: FeatureField | None,
    report: Mapping[str, Any],
    pipeline: Pipeline,
) -> FitShape:
    """Return what shows a capture's object, made by `pipeline_of`; `features` with their report replace the views'.

    Raises SceneError for views, and CaptureError for contacts, that do not fit each other.
    """
    log, found, impacts, seed = pipeline.listener.note, capture.surface, capture.impacts, config.fit.seed
    if features is None and found is not None:
        advice = "" if capture.folder is None else WITHOUT_SHAPE
        expect_placed(impacts.contacts, surface_points(found), names=impacts.names, advice=advice)
    if isinstance(pipeline, SceneStages):
        return _shape_of_views(capture, config, pipeline, features, report)
    if config.scene != PRESETS["default"].scene and is_mesh(found):
        log("the object's shape is its mesh: settings of views, Gaussians and features are not used")
    if features is None and config.gain_model == NETWORK:
        if not config.allow_missing_features:
            advice = "name a file by --features, or fit without visual features by --allow-missing-features"
            wanted = "visual features, of what the folder shows or of a file"
            raise FitError.expected(wanted, got="none", name="features", advice=advice)
        log("without visual features: the network reads positions alone")
    if features is not None:
        points = features
        expect_placed(impacts.contacts, features.points, names=impacts.names)
    elif found is not None:
        points = FeatureField.from_mesh(found, seed=seed)
    else:
        lacks = " and no elastic mode shapes" if config.gain_model == AUTO else ""
        log(
            f"nothing shows the object's shape: points that fill the bounding box of its contacts are used{lacks}. Add "
            "a mesh (surface.obj), photographs, a video or Gaussians"
        )
        points = FeatureField.from_contacts(impacts.contacts)

    surface, digest = object_shape(found, None)
    if config.gain_model != NETWORK and is_mesh(found):
        keep_surface(pipeline, surface, digest)
    known = found is not None or features is not None
    return FitShape(points, points, partial(mesh_symmetries, found, seed), surface, digest, report, known)


def mesh_symmetries(surface: Surface | None, seed: int) -> Symmetries | None:
    """Return the symmetries of points on a surface; None without one."""
    if surface is None:
        return None
    generator = torch.Generator().manual_seed(seed)
    return find_symmetries(FeatureField.from_mesh(surface, seed=generator).points, seed=generator)


def reported_symmetries(report: Mapping[str, Any]) -> Symmetries | None:
    """Return the symmetries that the report of a features' file has; None without any."""
    found = report.get("symmetries")
    return None if found is None else Symmetries.from_dict(found)


def _shape_of_views(
    capture: Capture, config: PipelineConfig, scene: SceneStages, given: FeatureField | None, report: Mapping[str, Any]
) -> FitShape:
    """Return the shape that views show; `given` features with their report are in place of those of the views."""
    impacts, settings = capture.impacts, capture.settings
    if given is None:
        # Loaded before Gaussians, which take minutes.
        _ = scene.encoder
    if scene.source is not None and scene.source.kind == "cameras":
        # Before Gaussians, which take minutes.
        views = read_views(scene[VIEWS].path)
        if capture.surface is not None:
            expect_mesh_in_views(capture.surface, views, settings)
        expect_contacts_in_views(impacts.contacts, views, settings)
    if scene.splats is not None:
        points = read_splats(scene[CLOUD].path).centers
        expect_placed(impacts.contacts, points, names=impacts.names, what="Gaussians")
    features = given
    if features is None:
        features, report = load_features(scene.features.path), read_report(scene.features.path)
    surface, digest = object_shape(capture.surface, scene)
    # The paper's network reads the Gaussians' own centers.
    centers = config.gain_model == NETWORK and config.scene.lift.onto == "gaussians"
    fitted = CLOUD in scene.made and not centers
    seen = capture.surface
    if config.gain_model != NETWORK:
        try:
            kept = keep_surface(scene, surface, digest)
        except SceneError as error:
            scene.listener.note(f"no surface is written: {error}")
        else:
            # Gaussians lie up to a wall's thickness below the surface, where a wall's other side may be nearer.
            seen = Surface.read(kept.path) if seen is None else seen
    if seen is not None and fitted:
        features = moved_onto(features, seen)
    # Structure from motion knows nothing of the frame that the contacts are in.
    found_frame = scene.source is not None and scene.source.kind in ("photographs", "video")
    if given is not None or (scene.splats is None and capture.surface is None):
        expect_placed(impacts.contacts, features.points, names=impacts.names, strict=found_frame)

    bare, symmetries = FeatureField.from_points(features.points), partial(reported_symmetries, report)
    return FitShape(bare, features, symmetries, surface, digest, report)


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
        return lambda: found, found.digest()
    if scene is None:

        def unknown() -> ObjectShape:
            wanted = "a mesh or views of the object in the folder"
            raise SceneError.expected(wanted, name="surface", advice="add surface.obj")

        return unknown, ""
    return once(scene.shape), f"{scene[CLOUD].digest} {scene[VIEWS].digest}"


def keep_surface(pipeline: Pipeline, make: Callable[[], Surface | ObjectShape], digest: str) -> Kept:
    """Return the file of the object's surface, made where what is kept is of something else. Raises as `make`."""

    def write(path: Path) -> None:
        shape = make()
        surface = shape if isinstance(shape, Surface) else shape.as_seen()
        write_whole(path, partial(surface.write, kind="ply"), raising=SceneError)

    return pipeline.add(Stage(SURFACE, write, recipe=lambda: {"of": digest}))


def is_mesh(surface: Surface | None) -> bool:
    """Return whether there is a surface with triangles."""
    return surface is not None and len(surface.faces) > 0
