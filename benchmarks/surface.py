"""Shapes from masks and Gaussians' depth against the simulated objects' true meshes, and under degraded views."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import torch
import trimesh
from jaxtyping import Float64

from avmsf.errors import SceneError
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.fit import splat
from avmsf.gaussians.ply import read_splats, write_splats
from avmsf.gaussians.rasterizer.devices import choose_rasterizer
from avmsf.gaussians.visibility import depth_of_cloud
from avmsf.mesh.closest_point import ClosestPoints
from avmsf.mesh.rays import RayCaster
from avmsf.mesh.surface import Surface, read_surface
from avmsf.photographs import find_foreground, read_views
from avmsf.photographs.cameras import View
from avmsf.reconstruction import ObjectShape, object_surface
from avmsf.simulate.recipe import SET, SETS
from benchmarks.material import MissingDataError
from benchmarks.report import Options, Report, Table, log

SAMPLES = 8000
RAYS = 48
OPEN = 0.5
"""Part of the directions, weighted by the cosine, in which a place of the outer side sees no other part."""
DEGRADED = ("mug-ceramic", "bowl-glass", "skillet-iron", "platter-wood")
"""Objects of the degraded part: vessels with and without handles, and a body without a cavity."""
CONVENTIONS = (
    "The body is shell(t) at the true wall's thickness t (median of the mesh's own along the inward normals) where a "
    "cavity was found, else as_seen(); where cavities are only supposed, the nearer of the two, "
    "which recordings would have to tell. mean, p95: distance between the body and the true mesh in percent "
    "of the mesh's diagonal, from 8000 places on each to the other, of those that see no other part of their mesh in "
    "half of the directions or more. thickness: relative difference of twice the volume over the area. cavity: "
    "relative error of the cavity's volume, which is what the body leaves of solid(). Neither says what wall the "
    "recordings find. seconds: process time of object_surface and one shell(t). Gaussians as SplatConfig has them, of "
    "72 views of 256 pixels, seed 0.",
    "Degraded: the masks and cameras that shapes are made of, with Gaussians of the undegraded views seen from the "
    "cameras at hand. upper: elevations of -6 degrees and more; twelve: each sixth view; eroded, dilated: masks by "
    "so many pixels; found: masks found before the pictures' plain background; wrong: 5 % of the masks turned by 180 "
    "degrees; turned: cameras by .3 degrees about random axes.",
)


@dataclass(frozen=True, eq=False)
class _Truth:
    surface: Surface
    diagonal: float
    wall: float
    """Meters."""


@dataclass(frozen=True)
class _Scores:
    mean: float
    p95: float
    thickness: float
    cavity: float
    seconds: float


def measure(options: Options) -> Report:
    """Return the figures of the chosen parts. Raises MissingDataError without the simulated objects' folder."""
    if options.sim20 is None or not options.sim20.is_dir():
        raise MissingDataError(
            "surface: expected --sim-20 FOLDER with the simulated objects and their pictures; `avmsf simulate sim-20` "
            "makes them"
        )
    report = Report(CONVENTIONS)
    with TemporaryDirectory() as temporary:
        clouds = Path(temporary) if options.clouds is None else options.clouds
        clouds.mkdir(parents=True, exist_ok=True)
        for part in options.parts:
            report += PARTS[part](options.sim20, clouds, options.quick_look)
    return report


def _objects(folder: Path, clouds: Path, quick: bool, *, of: str = SET) -> Report:
    rows: list[list[str | float]] = []
    found = []
    for name in tuple(SETS[of])[: 2 if quick else None]:
        views, truth, cloud = _material(folder / name, clouds, quick)
        scores = _scores(views, cloud, truth)
        found.append(scores)
        rows.append([name, *_cells(scores)])
        log(f"surface: {name}: {scores}")
    means = [_mean([getattr(each, key) for each in found]) for key in _KEYS]
    rows.append(["mean", *means])
    names = ("outer_mean", "outer_p95", "thickness_error", "cavity_error", "seconds")
    prefix = "surface" if of == SET else f"surface.{of}"
    figures = {f"{prefix}.{name}": value for name, value in zip(names, means, strict=True)}
    return Report(tables=(Table(f"simulated objects, {of}", ("object", *_KEYS), rows),), figures=figures)


def _degraded(folder: Path, clouds: Path, quick: bool) -> Report:
    rows: list[list[str | float]] = []
    figures: dict[str, float] = {}
    materials = [_material(folder / name, clouds, quick) for name in (DEGRADED[:1] if quick else DEGRADED)]
    for name, change in CONDITIONS.items():
        found = []
        for views, truth, cloud in materials:
            try:
                found.append(_scores(change(views), cloud, truth))
            except SceneError as error:
                log(f"surface: {name}: {error}")
        means = [_mean([getattr(each, key) for each in found]) for key in _KEYS]
        rows.append([name, *means, len(materials) - len(found)])
        figures |= {f"surface.{name}.{key}": value for key, value in zip(_KEYS, means, strict=True)}
        log(f"surface: {name}: {means}")
    return Report(tables=(Table("degraded views", ("condition", *_KEYS, "failed"), rows),), figures=figures)


def _mean(values: Sequence[float]) -> float:
    """Return the mean of what is known; NaN where nothing is."""
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")


def views_and_gaussians(folder: Path, clouds: Path, *, quick: bool) -> tuple[tuple[View, ...], GaussianCloud]:
    """Return an object's views and its Gaussians, which are kept in the folder `clouds`."""
    config = replace(SplatConfig(), steps=200) if quick else SplatConfig()
    views, path = read_views(folder), clouds / f"{folder.name}{'-200-steps' if quick else ''}.ply"
    if not path.exists():
        write_splats(splat(views, config), path)
    return tuple(views), read_splats(path)


def _material(folder: Path, clouds: Path, quick: bool) -> tuple[tuple[View, ...], _Truth, GaussianCloud]:
    views, cloud = views_and_gaussians(folder, clouds, quick=quick)
    return views, _truth(read_surface(folder / "surface.ply")), cloud


def _truth(surface: Surface) -> _Truth:
    mesh = _mesh(surface)
    places, normals = _sampled(mesh)
    outside = _openness(mesh, places, normals) >= OPEN
    diagonal = float(np.linalg.norm(mesh.extents))
    hit = _rays(mesh, places[outside], -normals[outside])
    return _Truth(surface, diagonal, float(np.median(hit[np.isfinite(hit)])))


def _scores(views: Sequence[View], cloud: GaussianCloud, truth: _Truth) -> _Scores:
    render, depths = depth_of_cloud(cloud, choose_rasterizer(cloud.centers.device)), {}
    for view in views:
        depths[id(view.camera)] = render(view.camera)
    start = time.process_time()
    shape = object_surface(views, lambda camera: depths[id(camera)])
    bodies = _bodies(shape, truth.wall)
    seconds = time.process_time() - start
    true = _mesh(truth.surface)
    found = []
    for mesh in map(_mesh, bodies):
        far = np.concatenate([_distances(mesh, true), _distances(true, mesh)]) / truth.diagonal * 100
        found.append((float(far.mean()), float(np.quantile(far, 0.95)), mesh))
    mean, p95, mesh = min(found, key=lambda each: each[0])
    thickness = abs(_thickness(mesh) / _thickness(true) - 1)
    hollow = _mesh(shape.solid()).volume - true.volume
    cavity = abs(mesh.volume - true.volume) / hollow if shape.hollow.any() and not shape.supposed else float("nan")
    return _Scores(mean, p95, float(thickness), float(cavity), seconds)


def _bodies(shape: ObjectShape, wall: float) -> list[Surface]:
    """Return the shell, what views show where there is no cavity, or both where it is only supposed."""
    try:
        shell = [shape.shell(wall)]
    except SceneError:
        return [shape.as_seen()]
    return [shape.as_seen(), *shell] if shape.supposed else shell


def _distances(mesh: trimesh.Trimesh, other: trimesh.Trimesh) -> Float64[np.ndarray, " places"]:
    """Return how far places on the outer side of one mesh lie from the other, meters."""
    places, normals = _sampled(mesh)
    outside = _openness(mesh, places, normals) >= OPEN
    return ClosestPoints(np.asarray(other.triangles))(places[outside]).distances


def _thickness(mesh: trimesh.Trimesh) -> float:
    return 2 * float(mesh.volume) / float(mesh.area)


def _mesh(surface: Surface) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.vertices.double().numpy(), surface.faces.numpy(), process=False)


def _sampled(
    mesh: trimesh.Trimesh,
) -> tuple[Float64[np.ndarray, "places 3"], Float64[np.ndarray, "places 3"]]:
    places, rows = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)
    return np.asarray(places, dtype=np.float64), np.asarray(mesh.face_normals[rows], dtype=np.float64)


def _openness(
    mesh: trimesh.Trimesh, places: Float64[np.ndarray, "places 3"], normals: Float64[np.ndarray, "places 3"]
) -> Float64[np.ndarray, " places"]:
    """Return the part of the directions from each place in which nothing of the mesh lies, weighted by the cosine."""
    generator, free = np.random.default_rng(1), np.zeros(len(places))
    for _ in range(RAYS):
        aside = generator.standard_normal(places.shape)
        toward = aside / np.linalg.norm(aside, axis=1, keepdims=True) + normals
        free += ~np.isfinite(_rays(mesh, places, toward / np.linalg.norm(toward, axis=1, keepdims=True), normals))
    return free / RAYS


def _rays(
    mesh: trimesh.Trimesh,
    places: Float64[np.ndarray, "places 3"],
    directions: Float64[np.ndarray, "places 3"],
    normals: Float64[np.ndarray, "places 3"] | None = None,
) -> Float64[np.ndarray, " places"]:
    """Return the distance to what lies in a direction, meters; rays start a little along the normals."""
    offset = 1e-4 * float(np.linalg.norm(mesh.extents))
    starts = places + offset * (directions if normals is None else normals)
    return RayCaster(np.asarray(mesh.triangles))(starts, directions, lead=0.0)[1]


def _cells(scores: _Scores) -> list[float]:
    return [getattr(scores, key) for key in _KEYS]


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


_KEYS = ("mean", "p95", "thickness", "cavity", "seconds")
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
PARTS: dict[str, Callable[[Path, Path, bool], Report]] = {
    "objects": _objects,
    "held-out": partial(_objects, of="held-out"),
    "degraded": _degraded,
}
