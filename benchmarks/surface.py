"""Shapes from masks and Gaussians' depth against the simulated objects' true meshes, and under degraded views."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import torch
import trimesh
from jaxtyping import Float64

from avmsf.errors import SceneError
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.rasterizer.rasterizers import choose_rasterizer
from avmsf.gaussians.visibility import depth_of_cloud
from avmsf.mesh.queries import ClosestPoints, RayCaster
from avmsf.mesh.surface import Surface
from avmsf.photographs import find_foreground
from avmsf.photographs.cameras import View
from avmsf.reconstruction import ObjectShape, object_surface
from avmsf.simulate.recipe import SET, SETS
from benchmarks.objects import simulated_folder, views_and_gaussians
from benchmarks.records import Measurement, Record, Settings, means, records

Points = Float64[np.ndarray, "points 3"]
SAMPLES, RAYS = 8000, 48
OPEN = 0.5
"""Part of the directions, weighted by the cosine, in which a point of the outer side sees no other part."""
DEGRADED = ("mug-ceramic", "bowl-glass", "skillet-iron", "platter-wood")
"""Objects of the degraded part: vessels with and without handles, and a body without a cavity."""


@dataclass(frozen=True, eq=False)
class _Truth:
    mesh: trimesh.Trimesh
    wall: float
    """Meters."""


def _objects(settings: Settings, of: str = SET) -> Iterator[Record]:
    """Distance of the body from the true mesh, and relative errors of its thickness and cavity.

    The body is shell(t) at the true wall's thickness t (median of the mesh's own along the inward normals) where a
    cavity was found, else as_seen(); where cavities are only supposed, the nearer of the two, which recordings would
    have to tell. mean, p95: in percent of the mesh's diagonal, from 8000 points on each to the other, of those that see
    no other part of their mesh in half of the directions or more. thickness: of twice the volume over the area. cavity:
    of its volume, which is what the body leaves of solid(). Neither says what wall the recordings find. seconds:
    process time of object_surface and one shell(t). Gaussians as SplatConfig has them, of 72 views of 256 pixels.
    """
    rows = []
    for name in settings.objects or settings.some(tuple(SETS[of]), 2):
        rows.append(_scores(*_material(name, settings)))
        yield from records(rows[-1], object=name)
    yield from records(means(rows), group="mean")


def _degraded(settings: Settings) -> Iterator[Record]:
    """The same under degraded masks and cameras, means over four objects, with the Gaussians of the undegraded views.

    upper: elevations of -6 degrees and more; twelve: each sixth view; eroded, dilated: masks by so many pixels; found:
    masks found before the pictures' plain background; wrong: 5 % of the masks turned by 180 degrees; turned: cameras by
    .3 degrees about random axes. failed: objects without a shape.
    """
    materials = [_material(name, settings) for name in settings.some(DEGRADED)]
    for name, change in CONDITIONS.items():
        rows, failures = [], []
        for views, cloud, truth in materials:
            try:
                rows.append(_scores(change(views), cloud, truth))
            except SceneError as error:
                failures.append(str(error))
        yield from records({**means(rows), "failed": len(failures)}, group=name, note="; ".join(failures))


def _material(name: str, settings: Settings) -> tuple[Sequence[View], GaussianCloud, _Truth]:
    views, cloud = views_and_gaussians(name, settings)
    mesh = _mesh(Surface.read(simulated_folder(name, settings) / "surface.ply"))
    points, normals = _sampled(mesh)
    outside = _openness(mesh, points, normals) >= OPEN
    hit = _rays(mesh, points[outside], -normals[outside])
    return views, cloud, _Truth(mesh, float(np.median(hit[np.isfinite(hit)])))


def _scores(views: Sequence[View], cloud: GaussianCloud, truth: _Truth) -> dict[str, float]:
    render, depths = depth_of_cloud(cloud, choose_rasterizer(cloud.centers.device)), {}
    for view in views:
        depths[id(view.camera)] = render(view.camera)
    start = time.process_time()
    shape = object_surface(views, lambda camera: depths[id(camera)])
    bodies = _bodies(shape, truth.wall)
    seconds = time.process_time() - start
    found, diagonal = [], float(np.linalg.norm(truth.mesh.extents))
    for mesh in map(_mesh, bodies):
        far = np.concatenate([_distances(mesh, truth.mesh), _distances(truth.mesh, mesh)]) / diagonal * 100
        found.append((float(far.mean()), float(np.quantile(far, 0.95)), mesh))
    mean, p95, mesh = min(found, key=lambda each: each[0])
    hollow = _mesh(shape.solid()).volume - truth.mesh.volume
    seen = shape.hollow.any() and not shape.supposed
    return {
        "mean_percent": mean,
        "p95_percent": p95,
        "thickness": abs(_thickness(mesh) / _thickness(truth.mesh) - 1),
        "cavity": abs(mesh.volume - truth.mesh.volume) / hollow if seen else float("nan"),
        "seconds": seconds,
    }


def _bodies(shape: ObjectShape, wall: float) -> list[Surface]:
    """Return the shell, what views show where there is no cavity, or both where it is only supposed."""
    try:
        shell = [shape.shell(wall)]
    except SceneError:
        return [shape.as_seen()]
    return [shape.as_seen(), *shell] if shape.supposed else shell


def _distances(mesh: trimesh.Trimesh, other: trimesh.Trimesh) -> Float64[np.ndarray, " points"]:
    """Return how far points on the outer side of one mesh lie from the other, meters."""
    points, normals = _sampled(mesh)
    outside = _openness(mesh, points, normals) >= OPEN
    return ClosestPoints(np.asarray(other.triangles))(points[outside]).distances


def _thickness(mesh: trimesh.Trimesh) -> float:
    return 2 * float(mesh.volume) / float(mesh.area)


def _mesh(surface: Surface) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.vertices.double().numpy(), surface.faces.numpy(), process=False)


def _sampled(mesh: trimesh.Trimesh) -> tuple[Points, Points]:
    points, rows = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)
    return np.asarray(points, dtype=np.float64), np.asarray(mesh.face_normals[rows], dtype=np.float64)


def _openness(mesh: trimesh.Trimesh, points: Points, normals: Points) -> Float64[np.ndarray, " points"]:
    """Return the part of the directions from each point in which nothing of the mesh lies, weighted by the cosine."""
    generator, free = np.random.default_rng(1), np.zeros(len(points))
    for _ in range(RAYS):
        aside = generator.standard_normal(points.shape)
        toward = aside / np.linalg.norm(aside, axis=1, keepdims=True) + normals
        free += ~np.isfinite(_rays(mesh, points, toward / np.linalg.norm(toward, axis=1, keepdims=True), normals))
    return free / RAYS


def _rays(
    mesh: trimesh.Trimesh, points: Points, directions: Points, normals: Points | None = None
) -> Float64[np.ndarray, " points"]:
    """Return the distance to what lies in a direction, meters; rays start a little along the normals."""
    offset = 1e-4 * float(np.linalg.norm(mesh.extents))
    starts = points + offset * (directions if normals is None else normals)
    return RayCaster(np.asarray(mesh.triangles))(starts, directions, lead=0.0)[1]


def _grown(pixels: int) -> Callable[[Sequence[View]], Sequence[View]]:
    """Return what dilates masks by pixels, or erodes them by less than none."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(pixels) + 1,) * 2)
    change = cv2.dilate if pixels > 0 else cv2.erode

    def grow(views: Sequence[View]) -> Sequence[View]:
        masks = [change(view.mask.numpy(), kernel) for view in views if view.mask is not None]
        return [replace(view, mask=torch.from_numpy(mask)) for view, mask in zip(views, masks, strict=True)]

    return grow


def _wrong(views: Sequence[View]) -> Sequence[View]:
    chosen = set(np.random.default_rng(0).choice(len(views), max(1, len(views) // 20), replace=False).tolist())
    return [
        replace(view, mask=view.mask.flip((0, 1)).clone()) if row in chosen and view.mask is not None else view
        for row, view in enumerate(views)
    ]


def _turned(views: Sequence[View]) -> Sequence[View]:
    generator, turned = np.random.default_rng(0), []
    for view in views:
        axis = generator.standard_normal(3)
        rotation, _ = cv2.Rodrigues(axis / np.linalg.norm(axis) * np.radians(0.3))
        pose = view.camera.world_to_camera.clone()
        pose[:3] = torch.from_numpy(rotation) @ pose[:3]
        turned.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    return turned


def _upper(views: Sequence[View]) -> Sequence[View]:
    # The axis of a camera that looks up has a component along z.
    return [view for view in views if float(view.camera.world_to_camera[2, 2]) < 0.1]


def _found(views: Sequence[View]) -> Sequence[View]:
    return find_foreground([replace(view, mask=None) for view in views])


CONDITIONS: dict[str, Callable[[Sequence[View]], Sequence[View]]] = {
    "as_taken": lambda views: views,
    "upper": _upper,
    "twelve": lambda views: views[::6],
    "eroded_1": _grown(-1),
    "eroded_2": _grown(-2),
    "dilated_1": _grown(1),
    "dilated_2": _grown(2),
    "found": _found,
    "wrong": _wrong,
    "turned": _turned,
}
PARTS: dict[str, Measurement] = {
    "objects": _objects,
    "held-out": partial(_objects, of="held-out"),
    "degraded": _degraded,
}
