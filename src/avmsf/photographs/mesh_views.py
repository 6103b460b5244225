"""Views of a mesh, rendered by casting rays: what stands for photographs where there is a scan."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avmsf.errors import CaptureError
from avmsf.mesh.io import check_area
from avmsf.mesh.queries import RayCaster
from avmsf.mesh.surface import Surface
from avmsf.mesh.textured_mesh import TexturedMesh
from avmsf.photographs.cameras import Camera, View

FOCAL = 886.81
"""Focal length of the usual renders of ObjectFolder's scans, pixels, for an image of `FOCAL_SIZE`."""
FOCAL_SIZE = 1024
RADIUS = 2.25
"""Object units from the middle of an object's bounding box to its corners: see `orbit_cameras`."""
DISTANCE = 5.0
"""Of the cameras of `orbit_cameras` from that middle, object units."""
MAX_RAYS = 1 << 19
"""Rays cast at once: about 100 bytes each."""
AMBIENT = 0.4
"""Part of the light on a matte surface that comes from everywhere. The rest comes from a sky, a half sphere of even
brightness: a face that leans by an angle t from the middle of the sky sees (1 + cos t) / 2 of it, so that no side of an
object is dark. Both are factors of the surface's color as displayed."""
SKY = np.array([0.36, 0.48, 0.8])
"""Unit vector towards the middle of the sky, in the object frame: the light stays with the object, so that a place has
one color in all views. Along none of the axes, so that the sides of a box differ."""


class _Hits(NamedTuple):
    """Rays that met the mesh."""

    rows: np.ndarray
    columns: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    """Of each of the face's corners, [hits, 3]."""
    directions: np.ndarray
    depth: np.ndarray
    """Meters along the optical axis."""


class MeshTracer:
    """A surface's triangles made ready for the rays of cameras (by Embree, on the CPU)."""

    def __init__(self, surface: Surface) -> None:
        """Raise CaptureError for a surface without area."""
        self.vertices, self.faces = surface.vertices.double().numpy(), surface.faces.numpy()
        corners = self.vertices[self.faces]
        check_area(corners)
        self.caster = RayCaster(corners)

    def depth(self, camera: Camera) -> Float[Tensor, "height width"]:
        """Return the depth of the face behind the center of each pixel, meters along the optical axis.

        Float64; 0 where there is no face.
        """
        depth = np.zeros((camera.height, camera.width))
        for hits in self.cast(camera):
            depth[hits.rows, hits.columns] = hits.depth
        return torch.from_numpy(depth)

    def cast(self, camera: Camera) -> Iterator[_Hits]:
        """Cast a ray through each pixel of the rectangle that the mesh fills, a band of rows at a time."""
        left, top, right, bottom = self._rectangle(camera)
        if right <= left:
            return
        # The distance of a float32 ray is coarse beside the corners' own depths, of which it is the mean.
        pose = camera.world_to_camera.numpy()
        depths = self.vertices @ pose[2, :3] + pose[2, 3]
        x, y = camera.principal
        width, height = right - left, max(1, MAX_RAYS // (right - left))
        for start in range(top, bottom, height):
            rows = min(height, bottom - start)
            band = replace(camera, principal=(x - left, y - start), width=width, height=rows)
            directions = band.rays().reshape(-1, 3).numpy()
            origins = np.broadcast_to(camera.position.numpy(), directions.shape)
            faces, _, weights = self.caster(origins, directions, lead=0.0)
            hit = np.flatnonzero(faces >= 0)
            faces, weights = faces[hit], weights[hit]
            depth = (depths[self.faces[faces]] * weights).sum(axis=1)
            yield _Hits(
                hit // width + start,
                hit % width + left,
                faces,
                weights.astype(np.float32),
                directions[hit].astype(np.float32),
                depth,
            )

    def _rectangle(self, camera: Camera) -> tuple[int, int, int, int]:
        """Return the left, top, right and bottom pixel edges around all that the mesh can fill."""
        pixels, depth = camera.project(torch.from_numpy(self.vertices))
        if not bool((depth > 0).any()):
            return 0, 0, 0, 0
        if bool((depth <= 0).any()):
            return 0, 0, camera.width, camera.height
        low, high = pixels.amin(0).tolist(), pixels.amax(0).tolist()
        left, top = (max(0, math.floor(value)) for value in low)
        right, bottom = min(camera.width, math.ceil(high[0])), min(camera.height, math.ceil(high[1]))
        return left, top, max(left, right), max(top, bottom)


class _Painter:
    """A mesh's colors, and the light on it, where rays meet it; of the settings of `render_views`."""

    def __init__(
        self, mesh: TexturedMesh, ambient: float, background: tuple[float, float, float], supersample: int
    ) -> None:
        self.ambient, self.background, self.supersample = ambient, np.asarray(background), supersample
        self.tracer = MeshTracer(mesh.surface)
        self.normals, self.colors = mesh.normals.numpy(), mesh.colors.numpy()
        self.coordinates, self.materials = mesh.coordinates.numpy(), mesh.materials.numpy()
        self.textures = [_mipmaps(texture.numpy()) for texture in mesh.textures]
        sizes = np.array([texture.shape[1::-1] for texture in mesh.textures], dtype=np.float64)
        corners = self.tracer.vertices[self.tracer.faces]
        pixels = self.coordinates * sizes[self.materials][:, None]
        across, down = pixels[:, 1] - pixels[:, 0], pixels[:, 2] - pixels[:, 0]
        texels = np.abs(across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0])
        doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        self.texels_per_meter = np.sqrt(texels / np.maximum(doubled, 1e-30))

    def view(self, camera: Camera, name: str) -> View:
        """Render one view."""
        fine = camera.resized(camera.width * self.supersample, camera.height * self.supersample)
        count = camera.width * camera.height
        sums = np.zeros((4, count))
        for hits in self.tracer.cast(fine):
            pixel = hits.rows // self.supersample * camera.width + hits.columns // self.supersample
            for total, weights in zip(sums, [*self._colors(hits, fine).T, None], strict=True):
                total += np.bincount(pixel, weights=weights, minlength=count)
        color, covered = sums[:3].T / self.supersample**2, sums[3:].T / self.supersample**2
        image = np.clip(color + (1 - covered) * self.background, 0, 1)
        pixels = np.rint(255 * np.hstack([image, covered])).astype(np.uint8).reshape(camera.height, camera.width, 4)
        color, mask = np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3])
        return View(name, torch.from_numpy(color), camera, torch.from_numpy(mask))

    def _colors(self, hits: _Hits, camera: Camera) -> np.ndarray:
        """Return the color of each hit, 0 to 1."""
        places = np.einsum("nca,nc->na", self.coordinates[hits.faces], hits.weights)
        # Size of a ray's neighborhood on a face that looks at the camera; one that leans shows more.
        spans = hits.depth / min(camera.focal) * self.texels_per_meter[hits.faces]
        colors, materials = np.empty((len(places), 3), dtype=np.float32), self.materials[hits.faces]
        for material, levels in enumerate(self.textures):
            chosen = np.flatnonzero(materials == material)
            # The copy of which one to two texels lie side by side under a ray's neighborhood.
            level = np.log2(np.maximum(spans[chosen], 1.0)).astype(np.intp).clip(max=len(levels) - 1)
            for number in np.unique(level):
                here = chosen[level == number]
                colors[here] = _bilinear(levels[number], places[here])
        colors /= np.float32(255)
        colors *= np.einsum("nca,nc->na", self.colors[hits.faces], hits.weights)
        if self.ambient < 1:
            normals = np.einsum("nca,nc->na", self.normals[hits.faces], hits.weights)
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
            # Both sides are lit as the one that is seen.
            facing = np.where((normals * hits.directions).sum(axis=1) > 0, -1, 1)
            colors *= (self.ambient + (1 - self.ambient) * (1 + facing * (normals @ SKY)) / 2)[:, None]
        return colors


def _mipmaps(image: UInt8[np.ndarray, "_ _ 3"]) -> list[UInt8[np.ndarray, "_ _ 3"]]:
    """Return an image and its copies of half, a quarter, ... of its size."""
    levels = [image]
    while max(levels[-1].shape[:2]) > 1:
        height, width = levels[-1].shape[:2]
        half = (max(width // 2, 1), max(height // 2, 1))
        levels.append(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA))
    return levels


def _bilinear(
    image: UInt8[np.ndarray, "height width 3"], places: Float[np.ndarray, "samples 2"]
) -> Float[np.ndarray, "samples 3"]:
    """Return the colors, 0 to 255, at places u (right) and v (up) of an image that repeats without end."""
    height, width = image.shape[:2]
    if (height, width) == (1, 1):
        return np.broadcast_to(image[0].astype(np.float32), (len(places), 3))
    # A texel's color belongs to its center, half a texel from its edges; rows run down while v runs up.
    across, down = places[:, 0] * width - 0.5, (1 - places[:, 1]) * height - 0.5
    left, top = np.floor(across), np.floor(down)
    right_part, low_part = (across - left).astype(np.float32), (down - top).astype(np.float32)
    columns = (left.astype(np.intp) % width, (left.astype(np.intp) + 1) % width)
    rows = (top.astype(np.intp) % height, (top.astype(np.intp) + 1) % height)
    color = np.zeros((len(places), 3), dtype=np.float32)
    flat = image.reshape(-1, 3)
    for row, down_part in zip(rows, (1 - low_part, low_part), strict=True):
        for column, across_part in zip(columns, (1 - right_part, right_part), strict=True):
            color += flat[row * width + column] * (down_part * across_part)[:, None]
    return color


def render_views(
    mesh: TexturedMesh,
    cameras: Sequence[Camera],
    *,
    ambient: float = AMBIENT,
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    supersample: int = 3,
) -> tuple[View, ...]:
    """Return one view of the mesh from each camera, called view_000, view_001, ..., with masks.

    Each pixel is the mean of `supersample` x `supersample` rays on an even grid; the mask says how many met the mesh,
    and `background` (red, green, blue, 0 to 1) fills what they left. Both sides of every face are seen. `ambient` is
    the part of the light that comes from everywhere: with 1 the surface has its own colors (albedo). Raises
    CaptureError for no camera and for values out of range.
    """
    if not cameras:
        raise CaptureError.expected("cameras to render from", 0, name="cameras", advice="`orbit_cameras` makes some")
    if supersample < 1:
        raise CaptureError.expected("a supersample of at least 1", supersample, name="supersample")
    if not all(0 <= value <= 1 for value in background):
        raise CaptureError.expected("numbers from 0 to 1", background, name="background")
    painter = _Painter(mesh, ambient, background, supersample)
    return tuple(painter.view(camera, f"view_{number:03d}") for number, camera in enumerate(cameras))


def orbit_cameras(
    surface: Surface,
    *,
    size: int = FOCAL_SIZE,
    elevations: Sequence[float] = (0.0, 45.0, -45.0),
    azimuths: int = 24,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> tuple[Camera, ...]:
    """Return cameras on circles around an object that all look at the middle of its bounding box.

    As the defaults stand, the 72 views of ObjectFolder's scans: three elevations, degrees, of 24 azimuths each, square
    images of `size` pixels that span 60 degrees. The bounding box reaches `RADIUS` object units from its middle to its
    corners, and the cameras are `DISTANCE` units away: the sphere around the object spans 87 % of the image. Raises
    CaptureError for an object without extent, and for an elevation straight along `up`.
    """
    vertices = surface.vertices.double()
    low, high = vertices.amin(0), vertices.amax(0)
    middle, radius, focal = (low + high) / 2, float((high - low).norm()) / 2, FOCAL * size / FOCAL_SIZE
    if not (math.isfinite(radius) and radius > 0):
        raise CaptureError.expected("a positive extent", radius, name="surface", advice="check its points")
    reach = DISTANCE * radius / RADIUS
    vertical = torch.tensor(up, dtype=torch.float64)
    vertical = vertical / vertical.norm()
    # The axis least along `up` leads to azimuth zero: x for z-up and for y-up objects.
    start = torch.eye(3, dtype=torch.float64)[int(vertical.abs().argmin())]
    start = start - (start @ vertical) * vertical
    start = start / start.norm()
    side = torch.linalg.cross(vertical, start)
    cameras = []
    for elevation in map(math.radians, elevations):
        for number in range(azimuths):
            azimuth = 2 * math.pi * number / azimuths
            outward = math.cos(elevation) * (math.cos(azimuth) * start + math.sin(azimuth) * side)
            position = middle + reach * (outward + math.sin(elevation) * vertical)
            cameras.append(Camera.looking(position, middle, up=vertical, focal=focal, width=size, height=size))
    return tuple(cameras)
