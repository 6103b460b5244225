"""A simulated object as a capture folder: what a user's own folder holds, and its truth beside that."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import trimesh

from avmsf._utils.files import new_folder
from avmsf.capture.folder import write_capture
from avmsf.errors import CaptureError, SimulationError
from avmsf.mesh.textured_mesh import TexturedMesh
from avmsf.photographs.folder import write_frames
from avmsf.photographs.mesh_views import orbit_cameras, render_views
from avmsf.simulate.ground_truth import TRUTH, read_truth, write_truth
from avmsf.simulate.recipe import AXES, EXAMPLE, ObjectRecipe
from avmsf.simulate.shapes import make_shape, textured
from avmsf.simulate.simulation import Simulation, simulate_object

_CIRCLES = 3
"""Circles of cameras around an object."""


def write_simulation(simulation: Simulation, folder: str | Path) -> None:
    """Write a folder that `read_capture`, `read_views` and `read_truth` read, and any tool that takes captures.

    It holds impacts.csv, the wav files, capture.toml, truth.safetensors, and where the recipe asks for them the surface
    with the colors at its vertices (surface.ply) and transforms.json with images and masks. The folder appears whole or
    not at all. Raises SimulationError where the folder exists and is not empty, and where it cannot be written.
    """
    folder, recipe, mesh = Path(folder), simulation.recipe, simulation.mesh
    try:
        with new_folder(folder, raising=SimulationError) as begun:
            # The whole recordings, and settings by which they are read as the simulation's own capture is.
            capture = simulation.capture
            impacts = replace(capture.impacts, sounds=simulation.recordings, before=None, after=None)
            seconds = capture.settings.seconds if capture.settings.align else None
            write_capture(replace(capture, surface=None, impacts=impacts), begun, onsets_within=seconds)
            if recipe.surface:
                write_painted(mesh, begun / "surface.ply")
            if recipe.views:
                cameras = orbit_cameras(
                    mesh.surface, size=recipe.view_size, azimuths=recipe.views // _CIRCLES, up=AXES[recipe.up]
                )
                write_frames(render_views(mesh, cameras), begun)
            write_truth(simulation.truth, begun / TRUTH)
    except CaptureError as error:
        advice = "choose another folder"
        raise SimulationError.expected("a writable folder", str(error), file=folder, advice=advice) from error


def is_written(recipe: ObjectRecipe, folder: str | Path) -> bool:
    """Return whether the folder holds the object of this recipe, made by this version of the package.

    Raises SimulationError where it holds something else, which nobody asked to lose.
    """
    folder = Path(folder)
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return False
    if not (folder / TRUTH).is_file():
        advice = "choose another name or remove it"
        raise SimulationError.expected(
            "a simulated object or no files", got=f"no {TRUTH}", file=folder, name=TRUTH, advice=advice
        )
    found, wanted = read_truth(folder).recipe, recipe.values()
    if found != wanted:
        differing = sorted(key for key in found.keys() | wanted.keys() if found.get(key) != wanted.get(key))
        got, advice = f"another {', '.join(differing)}", "remove it, or choose another folder"
        raise SimulationError.expected("an object of these settings", differing, got=got, file=folder, advice=advice)
    return True


def write_painted(mesh: TexturedMesh, path: Path) -> None:
    """Write colors at vertices; where a vertex has another color in each face, every face gets corners of its own."""
    vertices, faces = mesh.vertices.numpy(), mesh.faces.numpy()
    corners = (255.0 * mesh.corner_colors).round().to(torch.uint8).numpy()
    colors = np.zeros((len(vertices), 3), dtype=np.uint8)
    colors[faces.ravel()] = corners.reshape(-1, 3)
    if not np.array_equal(colors[faces], corners):
        vertices, colors = vertices[faces].reshape(-1, 3), corners.reshape(-1, 3)
        faces = np.arange(len(vertices)).reshape(-1, 3)
    trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False).export(path, file_type="ply")


def simulate_set(
    recipes: Mapping[str, ObjectRecipe],
    folder: str | Path,
    *,
    cache: Path | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> list[str]:
    """Simulate the objects that the folder does not hold yet, each into a folder of its name; return their names.

    An interrupted run goes on with the first object that is not whole. `progress` is called with the object's name and
    what is being computed, `exists` or `done` where it is whole, the number of whole objects and that of all. Raises
    SimulationError, before anything is made, where the folder of an object holds something else or an object of another
    recipe.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise SimulationError.expected("a folder", got="a file", file=folder, advice="choose another name")
    log = progress or (lambda message, done, total: None)
    whole = {name: is_written(recipe, folder / name) for name, recipe in recipes.items()}
    for done, (name, recipe) in enumerate(recipes.items()):

        def stage(message: str, name: str = name, done: int = done) -> None:
            log(f"{name}: {message}", done, len(recipes))

        if not whole[name]:
            simulation = simulate_object(recipe, name=name, cache=cache, progress=stage)
            stage(f"{recipe.views} views" if recipe.views else "files")
            write_simulation(simulation, folder / name)
        stage("exists" if whole[name] else "done", done=done + 1)
    return [name for name in recipes if not whole[name]]


def example_mesh() -> TexturedMesh:
    """Return the mesh, in its colors, that the example's recordings and photographs were computed from."""
    return textured(make_shape(EXAMPLE.kind, seed=EXAMPLE.seed, size=EXAMPLE.size, wall=EXAMPLE.thickness))
