"""Time to the body behind meshes as scanners make them, and how far its lowest frequencies are from the true ones."""

import math
from collections.abc import Callable, Iterator

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
from benchmarks.objects import shared_data
from benchmarks.processes import processor_seconds
from benchmarks.records import Record, Settings, records

SPAN, CHORD, THINNEST, THICKEST, TWIST = 0.5, 0.18, 0.001, 0.006, math.radians(30.0)
"""Of the blade: meters, and the angle between the chords at its ends."""
LOWEST, CONTACTS, RATE = 10, 8, 8000
SCANS = ("mug", "blue_cup", "bowl", "spoon")


def scans(settings: Settings) -> Iterator[Record]:
    """Errors of the 10 lowest frequencies of the body behind a mesh, and processor seconds to its modes.

    A twisted blade, .5 x .18 m, 1 mm thick at its edges and 6 mm in its middle, against bricks of tetrahedra along the
    blade; damaged: every tenth triangle split at a random point off its plane by a tenth of its size. Real scans are
    compared with four times the degrees of freedom. fit_seconds: of avmsf.fit to 8 sounds of the true modes.
    """
    true = elastic_modes(blade_solid(*((25, 9) if settings.quick else (61, 25))), NOMINAL, count=24)
    blades = {"blade": blade_surface(), "blade, damaged": damaged(blade_surface())}
    for name, surface in blades.items():
        yield from _measured(name, surface, true)
    for name in () if settings.quick else SCANS:
        yield from _measured(name, read_surface(shared_data() / "meshes" / name / "textured.obj"), None)


def _measured(name: str, surface: Surface, true: ElasticModes | None) -> Iterator[Record]:
    messages, begun = list[str](), processor_seconds()
    values = dict.fromkeys(("largest_error", "mean_error", "fit_seconds"), math.nan)
    try:
        made = _body(surface, 40_000, messages.append)
        taken = processor_seconds() - begun
        finest = true.frequency if true is not None else _body(surface, 160_000, messages.append).frequency
        errors = (made.frequency[:LOWEST] / finest[:LOWEST] - 1.0).abs()
        values |= {"largest_error": float(errors.max()), "mean_error": float(errors.mean())}
        if true is not None:
            values["fit_seconds"] = _fit_seconds(surface, true)
    except SimulationError as error:
        taken = processor_seconds() - begun
        messages.append(str(error))
    values |= {"body_seconds": taken, "triangles": len(surface.faces)}
    yield from records(values, object=name, note="; ".join(messages[-1:]))


def _body(surface: Surface, dofs: int, log: Callable[[str], None]) -> ElasticModes:
    return SurfaceBodies(surface, thicknesses=[None], count=LOWEST, dofs=dofs, log=log).bodies[0].elastic


def _fit_seconds(surface: Surface, true: ElasticModes) -> float:
    """Return the seconds of a fit to the sounds of contacts on the surface, struck straight into it."""
    contacts = true.points[farthest_points(true.points.float(), CONTACTS)]
    gains = true.gains(contacts, -true.normals(contacts))
    damping = 3.0 + 1e-3 * true.frequency
    sounds = synthesize(gains, true.frequency, damping, samples=RATE, sample_rate=RATE)
    capture = Capture("blade", Impacts.of(contacts.numpy(), sounds.numpy(), RATE), surface)
    begun = processor_seconds()
    avmsf.fit(capture, progress=False)
    return processor_seconds() - begun


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
