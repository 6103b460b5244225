"""Where a hammer falls on an object, and what is written down of it."""

import math
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Float64
from torch import Tensor
from torch.nn.functional import normalize

from avmsf.errors import SimulationError
from avmsf.mesh.points import farthest_points
from avmsf.mesh.queries import ClosestPoints, RayCaster
from avmsf.mesh.surface import Surface
from avmsf.simulate.recipe import Imperfections
from avmsf.simulate.shapes.body import stream

MIN_NORMAL_HEIGHT = -0.35
"""Least height of a unit normal where a hammer gets beneath: 20 degrees of overhang above a table."""
_RAY_LEAD = 1e-4
"""How far off the surface rays start, in object diagonals."""
_CANDIDATE_RATIO = 4
"""Places drawn evenly from what can be reached, for each contact: more would push the contacts to the rims."""


@dataclass(frozen=True, eq=False)
class Strikes:
    """Impacts as they fell and as they were written down, row for row."""

    places: Float64[Tensor, "contacts 3"]
    """Where they fell, meters."""
    directions: Float64[Tensor, "contacts 3"]
    """Unit vectors along which the hammer moved."""
    written_places: Float64[Tensor, "contacts 3"]
    written_directions: Float64[Tensor, "contacts 3"]
    speeds: Float64[Tensor, " contacts"]
    """Relative to the hammer's."""
    contact_times: Float64[Tensor, " contacts"]
    """Relative to those that follow from the speeds."""
    force_errors: Float64[Tensor, " contacts"]
    """What the written peak forces are multiplied by."""


def draw_strikes(
    surface: Surface, count: int, *, up: Float64[Tensor, " 3"], imperfections: Imperfections, seed: int
) -> Strikes:
    """Draw impacts spread over all of a surface that a hammer reaches from above or from the side, straight into it.

    A place is reached where its outward normal hits nothing of the object and does not point down. Raises
    SimulationError where there are no such places.
    """
    places, normals = _reached(surface, count, up=up, seed=seed)
    chosen = farthest_points(places, count, start=int(stream(seed, "first contact").integers(len(places))))
    places, normals = places[chosen], normals[chosen]
    inward = -normals
    offsets = _across(normals, imperfections.contact, generator=stream(seed, "contact jitter"))
    tilts = _across(normals, math.radians(imperfections.direction), generator=stream(seed, "direction jitter"))
    directions = inward + torch.tan(tilts.norm(dim=1, keepdim=True)) * normalize(tilts, eps=1e-300)
    speeds = stream(seed, "speeds").standard_normal(count)
    times = stream(seed, "contact times").standard_normal(count)
    errors = stream(seed, "force errors").standard_normal(count)
    return Strikes(
        places=places,
        directions=normalize(directions, eps=1e-300),
        written_places=nearest_on(surface, places + offsets) if imperfections.contact > 0.0 else places,
        written_directions=inward,
        speeds=torch.from_numpy(np.exp(imperfections.speed * speeds)),
        contact_times=torch.from_numpy(np.exp(imperfections.contact_time * times)),
        # Bounded, for a written force is never negative.
        force_errors=torch.from_numpy(np.exp(imperfections.force * errors)),
    )


def nearest_on(surface: Surface, places: Float64[Tensor, "contacts 3"]) -> Float64[Tensor, "contacts 3"]:
    """Return the surface's points nearest to the places."""
    triangles = surface.vertices.double().numpy()[surface.faces.numpy()]
    triangles = triangles[np.ptp(triangles, axis=1).max(axis=1) > 0]
    found = ClosestPoints(triangles)(places.numpy())
    return torch.from_numpy(np.einsum("pc,pca->pa", found.weights, triangles[found.rows]))


def _reached(
    surface: Surface, count: int, *, up: Float64[Tensor, " 3"], seed: int
) -> tuple[Float64[Tensor, "places 3"], Float64[Tensor, "places 3"]]:
    """Return `_CANDIDATE_RATIO` times `count` places that a hammer reaches, drawn evenly by area, and their normals."""
    mesh = trimesh.Trimesh(surface.vertices.double().numpy(), surface.faces.numpy(), process=False)
    generator, cast = stream(seed, "contacts"), RayCaster(mesh.triangles)
    wanted = _CANDIDATE_RATIO * count
    places, normals, drawn = np.zeros((0, 3)), np.zeros((0, 3)), 0
    while len(places) < wanted and drawn < 200 * wanted:
        points, rows = trimesh.sample.sample_surface(mesh, 8 * wanted, seed=int(generator.integers(2**31)))
        outward = np.asarray(mesh.face_normals[rows])
        # A ray along the normal leaves the object without meeting it again.
        free = cast(np.asarray(points), outward, lead=_RAY_LEAD)[0] < 0
        reached = free & (outward @ up.numpy() >= MIN_NORMAL_HEIGHT)
        places, normals = np.concatenate([places, points[reached]]), np.concatenate([normals, outward[reached]])
        drawn += 8 * wanted
    if len(places) < count:
        reachable = f"{count} positions that a hammer reaches from above or the side"
        advice = "choose another upward axis, or make the mesh's triangles face outwards"
        got = f"{len(places)} of {drawn}"
        raise SimulationError.expected(reachable, len(places), got=got, name="up", advice=advice)
    return torch.from_numpy(places[:wanted]), torch.from_numpy(normals[:wanted])


def _across(
    normals: Float64[Tensor, "contacts 3"], spread: float, *, generator: np.random.Generator
) -> Float64[Tensor, "contacts 3"]:
    """Return Gaussian vectors across the normals whose lengths have this root mean square."""
    drawn = torch.from_numpy(generator.standard_normal(tuple(normals.shape)))
    return spread / math.sqrt(2.0) * (drawn - (drawn * normals).sum(dim=1, keepdim=True) * normals)
