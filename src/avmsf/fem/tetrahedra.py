"""Any mesh or scan as tetrahedra, by pytetwild, which allows holes and self-intersections.

pytetwild inserts the triangles in a random order, so two machines differ in their tetrahedra and somewhat in the body's
frequencies (docs/limitations.md). On one machine a mesh has the same tetrahedra each time: they are stored by its
digest. pytetwild runs in a process of its own, for it may crash, and never ends on some meshes.
"""

import hashlib
import importlib.util
import io
import os
import signal
import sys
import tempfile
import zipfile
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from trimesh import Trimesh

from avmsf._utils.caching import discard, keep_if_possible, source_digest
from avmsf._utils.files import write_whole
from avmsf._utils.processes import child_process
from avmsf.errors import SimulationError
from avmsf.fem import tetrahedra_worker
from avmsf.fem.meshing import principal_extents, weld
from avmsf.fem.remeshing import boundary_edges, coarsened, even_points
from avmsf.fem.solid import Solid
from avmsf.mesh.queries import ClosestPoints
from avmsf.mesh.surface import Surface

WORKER = Path(tetrahedra_worker.__file__)


@dataclass(frozen=True)
class Tolerances:
    """How near tetrahedra are to the mesh that they fill."""

    envelope: float = 0.04  # how far the solid's surface may lie from the mesh, over the length of tetrahedra's edges
    min_edge: float = 0.1  # shorter ones are taken out of the mesh beforehand, over the length of tetrahedra's edges
    min_turn_cosine: float = 0.7  # by which triangles may turn then: it makes a scan's filling ten times as quick
    max_lids: float = 0.25  # part of the solid's surface that may close holes
    max_lost: float = 0.1  # part of the mesh, or of the volume of its parts, that may be left out


TOLERANCES = Tolerances()
_MAX_STORED = 300
"""Fillings that are stored, some megabytes each; the oldest are removed."""


def fill(surface: Surface, *, detail: float = 0.05, timeout: float = 600.0) -> Solid:
    """Return what a mesh or scan encloses; holes are closed, and triangles inside and loose small parts left out.

    `detail` is the length of the tetrahedra's edges over the body's size, the diagonal of the box around it, where
    nothing asks for shorter ones; the solid's surface keeps within a 25th of that length of the mesh. Takes some
    seconds to a minute. Raises SimulationError where pytetwild fails or takes more than `timeout` seconds of the
    processor, and for what encloses no body: points, sheets, parts that do not touch and walls too thin for the detail.
    """
    mesh = weld(surface)
    size, opened = mesh.scale, len(boundary_edges(mesh))
    advice = f"give a wall thickness, such as {0.015 * size:.1g} m"
    # Of a sheet fTetWild makes a sliver as thin as its envelope, or nothing, as chance has it.
    if opened and principal_extents(mesh.triangles.reshape(-1, 3)).min() < 2.0 * TOLERANCES.envelope * detail * size:
        wanted, got = "a mesh that encloses a volume", "a flat sheet"
        raise SimulationError.expected(wanted, 0, got=got, name="volume", advice=advice)
    coarse = coarsened(mesh, TOLERANCES.min_edge * detail * size, turn=TOLERANCES.min_turn_cosine)
    points, cells = _stored(coarse, detail, timeout)
    if not len(cells):
        wanted, got = "a mesh that encloses a volume", f"{opened} open edges"
        raise SimulationError.expected(wanted, opened, got=got, name="volume", advice=advice)
    solid = Solid.build(torch.from_numpy(points), torch.from_numpy(cells))
    solid.expect_connected(loose=TOLERANCES.max_lost)
    solid = Solid.build(solid.points, solid.cells[solid.parts == 0])
    _expect_likeness(solid, mesh, tolerance=4.0 * TOLERANCES.envelope * detail * size, advice=advice)
    return solid


def _stored(mesh: Trimesh, detail: float, timeout: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points and cells, stored in AVMSF_CACHE or ~/.cache/avmsf when they are first made."""
    given, faces = np.array(mesh.vertices), np.array(mesh.faces)
    folder = Path(os.environ.get("AVMSF_CACHE") or os.path.expanduser("~/.cache/avmsf")) / "tetrahedra"
    code = f"{version('pytetwild')} {source_digest(tetrahedra_worker.__name__)}"
    values = f"{code} {detail} {TOLERANCES.envelope} {given.shape} {given.dtype} {faces.dtype}"
    digest = hashlib.sha256(values.encode() + given.tobytes() + faces.tobytes()).hexdigest()
    path = folder / f"{digest[:24]}.npz"
    try:
        return _arrays(path.read_bytes())
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile):
        content = _tetrahedralize(given, faces, detail, timeout)
    keep_if_possible(lambda: write_whole(path, content), path)
    with suppress(OSError):
        for old in sorted(folder.glob("*.npz"), key=lambda each: each.stat().st_mtime)[:-_MAX_STORED]:
            discard(old)
    return _arrays(content)


def _arrays(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    with np.load(io.BytesIO(content)) as arrays:
        return arrays["points"], arrays["cells"]


def _tetrahedralize(points: np.ndarray, faces: np.ndarray, detail: float, timeout: float) -> bytes:
    """Return the file of points and cells that pytetwild's process writes."""
    found = importlib.util.find_spec("pytetwild")
    assert found is not None
    assert found.submodule_search_locations
    with tempfile.TemporaryDirectory(prefix="avmsf-fill-") as name:
        job, result, log = (Path(name) / file for file in ("job.npz", "result.npz", "log"))
        np.savez(
            job, points=points, faces=faces.astype(np.uint32), edge=detail, envelope=TOLERANCES.envelope * detail,
            library=found.submodule_search_locations[0], seconds=timeout,
        )  # fmt: skip
        # -P keeps this folder, whose modules have common names, from where the worker looks for libraries.
        command = [sys.executable, "-P", str(WORKER), str(job), str(result)]
        variables = os.environ | {"OMP_NUM_THREADS": "1"}
        # fTetWild leaves a file of its own where it runs.
        settings = {"env": variables, "cwd": name}
        with open(log, "wb") as output, child_process(command, stdout=output, stderr=output, **settings) as child:
            child.wait()
        if child.returncode == -signal.SIGPROF:
            raise SimulationError.expected(
                f"tetrahedra of {len(faces)} triangles within {timeout:g} s of the processor", timeout, got="none",
                name="timeout", advice="simplify the mesh, or use a larger detail or fewer degrees of freedom",
            )  # fmt: skip
        if child.returncode != 0 or not result.is_file():
            last = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:] or ["no message"]
            got, advice = f"{child.returncode} ({last[0][:200]})", "simplify the mesh, or change detail or its dofs"
            raise SimulationError.expected("exit status 0", child.returncode, got=got, name="pytetwild", advice=advice)
        return result.read_bytes()


def _expect_likeness(solid: Solid, mesh: Trimesh, *, tolerance: float, advice: str) -> None:
    """Raise SimulationError where much of the mesh is not the solid's surface, or much of that surface is no mesh."""
    outside = Trimesh(solid.points.numpy(), solid.boundary.numpy(), process=False)
    places, opened = even_points(mesh), len(boundary_edges(mesh))
    found = ClosestPoints(outside.triangles)(places)
    nearest = np.einsum("pc,pcd->pd", found.weights, outside.triangles[found.rows])
    behind = (outside.face_normals[found.rows] * (places - nearest)).sum(axis=1) < 0
    # Where bodies cross, the mesh runs inside; only what lies outside was lost.
    lost = float(((found.distances > tolerance) & ~behind).mean())
    if lost > TOLERANCES.max_lost:
        wanted = f"tetrahedra within {tolerance:.2g} m of the mesh"
        got = f"{lost:.0%} of it without ({opened} open edges, or thin walls)"
        advice = f"use a smaller detail or more degrees of freedom, close the mesh, or {advice}"
        raise SimulationError.expected(wanted, lost, got=got, name="detail", advice=advice)
    lids = float((ClosestPoints(mesh.triangles)(even_points(outside)).distances > tolerance).mean())
    if lids > TOLERANCES.max_lids:
        got = f"{opened} open edges whose holes are {lids:.0%} of the surface"
        advice = f"close the mesh, or {advice}"
        raise SimulationError.expected("a nearly closed mesh", lids, got=got, name="holes", advice=advice)
