"""From a recipe to a body: what it looks like, what it is made of, and its elastic modes, kept by content."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf._utils.caching import content_digest
from avmsf.errors import SimulationError
from avmsf.fem.elastic_modes import ElasticModes, elastic_modes, modes_once
from avmsf.fem.material import material_named
from avmsf.fem.solid import Solid
from avmsf.fem.tetrahedra import fill
from avmsf.fem.walls import shell
from avmsf.mesh.surface import Surface
from avmsf.mesh.textured_mesh import TexturedMesh, read_textured_mesh
from avmsf.simulate.imperfections import smooth_field, support_places, vary_thickness
from avmsf.simulate.recipe import AXES, ObjectRecipe
from avmsf.simulate.shapes import make_shape, textured
from avmsf.simulate.shapes.body import stream

_MAX_EXTENT_M = 10.0
"""Meters along its longest side beyond which a mesh is likelier to count millimeters."""


@dataclass(frozen=True, eq=False)
class Body:
    """An object before it is struck."""

    mesh: TexturedMesh
    """As it looks, with even walls: thickness varies unseen."""
    elastic: ElasticModes
    supports: Float64[Tensor, "legs 3"]
    """Places that it stands on."""

    @property
    def surface(self) -> Surface:
        """Its shape alone."""
        return self.mesh.surface


def make_body(recipe: ObjectRecipe, *, cache: Path | None, log: Callable[[str], None]) -> Body:
    """Make a recipe's body, its elastic modes read from the folder `cache` where they were computed before.

    A file that is damaged is made again. Raises SimulationError for an unknown shape and a mesh that cannot be made
    solid, and CaptureError for a mesh that cannot be read.
    """
    mesh, make_solid = _shape(recipe)
    legs = support_places(mesh.surface.vertices.double(), up_of(recipe), generator=stream(recipe.seed, "supports"))
    kept = None if cache is None else cache / f"modes-{content_digest(recipe.elastic_values())[:24]}.safetensors"

    def compute() -> ElasticModes:
        log("dividing the body into tetrahedra")
        part, generator = recipe.imperfections.thickness, stream(recipe.seed, "thickness")
        solid = vary_thickness(make_solid(), part, generator=generator)
        log(f"elastic modes of {len(solid.cells)} tetrahedra")
        return _elastic(recipe, solid, legs)

    return Body(mesh, modes_once(kept, compute, log=log), legs)


def up_of(recipe: ObjectRecipe) -> Float64[Tensor, " 3"]:
    """Return the unit vector that points to the sky."""
    return torch.tensor(AXES[recipe.up], dtype=torch.float64)


def _shape(recipe: ObjectRecipe) -> tuple[TexturedMesh, Callable[[], Solid]]:
    """Return what the object looks like, and what makes it solid."""
    if recipe.mesh is not None:
        mesh = read_textured_mesh(recipe.mesh)
        mesh = replace(mesh, vertices=mesh.vertices * _scale(recipe, mesh.vertices))
        return mesh, lambda: _made_solid(recipe, mesh.surface)
    shape = make_shape(recipe.kind, seed=recipe.seed, size=recipe.size, wall=recipe.thickness)
    return textured(shape), lambda: shape.solid


def _made_solid(recipe: ObjectRecipe, surface: Surface) -> Solid:
    """Return what a mesh encloses, or the wall beneath it."""
    try:
        if recipe.thickness is None:
            return fill(surface, detail=recipe.detail)
        return shell(surface, thickness=recipe.thickness, detail=recipe.detail)
    except SimulationError as error:
        advice = " (--thickness)" if recipe.thickness is None else ""
        raise SimulationError(
            f"{recipe.mesh}: {error}{advice}", file=recipe.mesh, row=error.row, name=error.name, value=error.value
        ) from error


def _elastic(recipe: ObjectRecipe, solid: Solid, legs: Float64[Tensor, "legs 3"]) -> ElasticModes:
    material, imperfections = material_named(recipe.material), recipe.imperfections
    middles = solid.points[solid.cells].mean(dim=1)
    stiffness, density = (
        smooth_field(middles, spread, diagonal=solid.size, generator=stream(recipe.seed, name))
        for name, spread in (("stiffness", imperfections.stiffness), ("density", imperfections.density))
    )
    mass = material.density * float((solid.volumes * density).sum())
    strength = mass * (2.0 * math.pi * imperfections.support) ** 2 / len(legs)
    return elastic_modes(
        solid,
        material,
        count=recipe.elastic_modes,
        stiffness_factor=stiffness,
        density_factor=density,
        springs=(legs, strength) if strength > 0.0 else None,
    )


def _scale(recipe: ObjectRecipe, vertices: Tensor) -> float:
    """Return what makes the longest side of the bounding box as long as the recipe has it."""
    longest = float((vertices.amax(0) - vertices.amin(0)).max())
    if recipe.size is None and longest > _MAX_EXTENT_M:
        advice = f"if it is in millimeters, give --size {longest / 1000:g}, else its length by --size"
        wanted, got = f"a mesh of at most {_MAX_EXTENT_M:g} m", f"{longest:g} m"
        raise SimulationError.expected(wanted, longest, got=got, file=recipe.mesh, name="size", advice=advice)
    return 1.0 if recipe.size is None else recipe.size / longest
