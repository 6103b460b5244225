"""Time to the body behind meshes as scanners make them, and how far its lowest frequencies are from the true ones."""

import math
import resource
from collections.abc import Callable

import numpy as np
import torch

import avmsf
from avmsf.capture import Capture, Impacts
from avmsf.errors import SimulationError
from avmsf.fem.candidate_bodies import SurfaceBodies
from avmsf.fem.elastic_modes import ElasticModes, elastic_modes
from avmsf.fem.material import NOMINAL
from avmsf.fem.solid import Solid
from avmsf.gaussians.points import farthest_points
from avmsf.mesh.surface import Surface, read_surface
from avmsf.modal.synthesis import synthesize
from benchmarks.material import shared_data
from benchmarks.report import Options, Report, Table, log

SPAN, CHORD, THINNEST, THICKEST, TWIST = 0.5, 0.18, 0.001, 0.006, math.radians(30.0)
"""Of the blade: meters, and the angle between the chords at its ends."""
LOWEST, CONTACTS, RATE = 10, 8, 8000
SCANS = ("mug", "blue_cup", "bowl", "spoon")
CONVENTIONS = (
    f"scans: a twisted blade, {SPAN:g} x {CHORD:g} m, {1000 * THINNEST:g} mm thick at its edges and "
    f"{1000 * THICKEST:g} mm in its middle; damaged: every tenth triangle split at a random place off its plane by "
    f"a tenth of its size. error: of the {LOWEST} lowest frequencies, against bricks of tetrahedra along the blade, "
    "largest and mean; of real scans, against four times the degrees of freedom. "
    f"body, fit: processor seconds to the modes, and of avmsf.fit to {CONTACTS} sounds of the true modes.",
)


def blade(along: int, across: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the blade, [along, across, 2 sides, 3], and the number of each."""
    u, v = np.linspace(0.0, 1.0, along), np.linspace(-1.0, 1.0, across)
    u, v, side = np.meshgrid(u, v, (-0.5, 0.5), indexing="ij")
    height = side * (THINNEST + (THICKEST - THINNEST) * (1.0 - v**2))
    angle, chord = TWIST * u, 0.5 * CHORD * v
    y, z = chord * np.cos(angle) - height * np.sin(angle), chord * np.sin(angle) + height * np.cos(angle)
    return np.stack([SPAN * u, y, z], axis=-1), np.arange(u.size).reshape(u.shape)


def blade_surface(along: int = 200, across: int = 69) -> Surface:
    """Return the blade as triangles, counter-clockwise from outside."""
    points, number = blade(along, across)
    sheets = (number[:, ::-1, 0], number[:, :, 1], number[:, 0], number[::-1, -1], number[::-1, :, :][0], number[0])
    faces = []
    for sheet in sheets:
        a, b, c, d = sheet[:-1, :-1], sheet[1:, :-1], sheet[1:, 1:], sheet[:-1, 1:]
        faces += [np.stack(each, axis=-1).reshape(-1, 3) for each in ((a, b, c), (a, c, d))]
    return Surface(torch.from_numpy(points.reshape(-1, 3)).float(), torch.from_numpy(np.concatenate(faces)))


def blade_solid(along: int = 61, across: int = 25) -> Solid:
    """Return the blade as six tetrahedra a brick, one brick thick."""
    points, number = blade(along, across)
    corners = [number[i : len(number) - 1 + i, j : number.shape[1] - 1 + j, k] for i, j, k in np.ndindex(2, 2, 2)]
    # Kuhn's six: from corner 000 to 111 along the three axes in any order.
    steps = ((4, 6), (4, 5), (2, 6), (2, 3), (1, 5), (1, 3))
    cells = [np.stack([corners[each] for each in (0, *step, 7)], axis=-1).reshape(-1, 4) for step in steps]
    return Solid.build(torch.from_numpy(points.reshape(-1, 3)), torch.from_numpy(np.concatenate(cells)))


def damaged(surface: Surface) -> Surface:
    """Return a surface with every tenth triangle, at random, made three that meet at a random place off its plane."""
    random = np.random.default_rng(0)
    vertices, faces = surface.vertices.double().numpy(), surface.faces.numpy()
    hurt = random.random(len(faces)) < 0.1
    corners = vertices[faces[hurt]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.sqrt(np.linalg.norm(normal, axis=1, keepdims=True))
    middle = np.einsum("fc,fcd->fd", random.dirichlet(np.full(3, 0.3), len(corners)), corners)
    middle += 0.1 * random.standard_normal((len(corners), 1)) * normal / size
    added = len(vertices) + np.arange(len(corners))
    a, b, c = faces[hurt].T
    split = [np.stack(each, axis=1) for each in ((a, b, added), (b, c, added), (c, a, added))]
    whole = np.concatenate([vertices, middle]), np.concatenate([faces[~hurt], *split])
    return Surface(torch.from_numpy(whole[0]).float(), torch.from_numpy(whole[1]))


def scans(options: Options) -> Report:
    """Make the body behind each mesh, and fit fields to the blade."""
    true = elastic_modes(blade_solid(*((25, 9) if options.quick_look else (61, 25))), NOMINAL, count=24)
    meshes: dict[str, tuple[Surface, ElasticModes | None]] = {"blade": (blade_surface(), true)}
    meshes["blade, damaged"] = damaged(blade_surface()), true
    for name in () if options.quick_look else SCANS:
        meshes[name] = read_surface(shared_data() / "meshes" / name / "textured.obj"), None
    rows: list[list[str | float]] = []
    figures: dict[str, float] = {}
    for name, (surface, modes) in meshes.items():
        rows.append([name, len(surface.faces), *_measured(surface, modes)])
        key = f"scans.{name.replace(', ', '_')}"
        for column, value in zip(
            ("body_seconds", "largest_error", "mean_error", "fit_seconds"), rows[-1][2:6], strict=True
        ):
            if isinstance(value, float) and math.isfinite(value):
                figures[f"{key}.{column}"] = value
        log(f"physics.scans: {name}: {rows[-1][2:]}")
    columns = ("mesh", "triangles", "s for body", "largest error", "mean error", "s for fit", "last step")
    return Report(CONVENTIONS, (Table("bodies behind scanned meshes", columns, rows),), figures)


def _measured(surface: Surface, true: ElasticModes | None) -> list[str | float]:
    """Return the seconds of the body, its errors, the seconds of the fit, and what was said last."""
    heard: list[str] = []
    begun = processor_seconds()
    try:
        made = _body(surface, 40_000, heard.append)
        taken = processor_seconds() - begun
        finest = true.frequency if true is not None else _body(surface, 160_000, heard.append).frequency
    except SimulationError as error:
        return [processor_seconds() - begun, math.nan, math.nan, math.nan, str(error)]
    errors = (made.frequency[:LOWEST] / finest[:LOWEST] - 1.0).abs()
    fitted = math.nan if true is None else _fitted(surface, true)
    return [taken, float(errors.max()), float(errors.mean()), fitted, "; ".join(heard[-1:])]


def _body(surface: Surface, dofs: int, hear: Callable[[str], None]) -> ElasticModes:
    return SurfaceBodies(surface, thicknesses=[None], count=LOWEST, dofs=dofs, log=hear).bodies[0].elastic


def _fitted(surface: Surface, true: ElasticModes) -> float:
    """Return the seconds of a fit to the sounds of contacts on the surface, struck straight into it."""
    contacts = true.points[farthest_points(true.points.float(), CONTACTS)]
    gains = true.gains(contacts, -true.normals(contacts))
    damping = 3.0 + 1e-3 * true.frequency
    sounds = synthesize(gains, true.frequency, damping, samples=RATE, sample_rate=RATE)
    capture = Capture("blade", Impacts.of(contacts.numpy(), sounds.numpy(), RATE), surface)
    begun = processor_seconds()
    field = avmsf.fit(capture, progress=False)
    log(f"physics.scans: {field}")
    return processor_seconds() - begun


def processor_seconds() -> float:
    """Return the processor time of this process and of those that it started and that have ended."""
    own, others = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime
