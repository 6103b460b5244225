"""Bodies that an object's surface may enclose, and the field of one of a known material, without any recording."""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from avmsf.capture.checks import NARROWEST, WIDEST, expect_held
from avmsf.capture.impacts import Impacts
from avmsf.capture.placement import expect_on_body
from avmsf.capture.settings import TABLE, CaptureSettings
from avmsf.capture.table import read_cells
from avmsf.errors import FitError, SimulationError
from avmsf.features.feature_field import FeatureField
from avmsf.fem.body_meshes import HollowShape
from avmsf.fem.candidate_bodies import CandidateBodies
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.material import NOMINAL, Material, material_named
from avmsf.fem.vibration import damped, radiated_pressure, rayleigh
from avmsf.field.config import FitConfig
from avmsf.field.gains.scaled import BodyGains
from avmsf.field.sound_field import Origin, SoundField
from avmsf.mesh.surface import Surface, surface_points
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from avmsf.pipeline.config import BodyConfig
from avmsf.simulate.hammer import contact_times, pulse_spectrum
from avmsf.simulate.recipe import Hammer

_SAMPLE_RATE = 44_100.0
"""Hz: that of most recordings."""
_HIGHEST = 0.499
"""Highest frequency of a mode over the sample rate."""
_BINS = 1025
"""Of the residual, which is zero: as many as that of a fit has."""


def candidate_bodies(
    surface: Surface | HollowShape,
    config: BodyConfig | None = None,
    *,
    impacts: Impacts | None = None,
    settings: CaptureSettings | None = None,
    material: Material = NOMINAL,
    cache: Path | None = None,
    log: Callable[[str], None] | None = None,
) -> CandidateBodies:
    """Return the bodies that a surface may enclose; their mode shapes are cached by content in `cache`.

    `settings` of the capture say where the object was held and which units the surface may be in. Raises
    SimulationError where no body can be computed, with the name `wall` where `config` states one, and before any is
    FitError where the contacts of the `impacts` that they are meant for do not lie on the surface, and CaptureError
    where the points do not at which the object was held.
    """
    config, settings = config or BodyConfig(), settings or CaptureSettings()
    held_at, seen = settings.held_at, surface if isinstance(surface, Surface) else surface.as_seen()
    extent = seen.vertices.amax(0) - seen.vertices.amin(0)
    if impacts is not None:
        expect_on_body(impacts.contacts, surface_points(seen), names=impacts.names)
    expect_held(held_at, seen)
    wall = config.wall
    try:
        bodies = CandidateBodies(
            surface, thicknesses=None if wall is None else [wall or None], supports=config.supports,
            held_at=held_at, unit_ratios=settings.unit_ratios(float(extent.norm())), count=config.shapes,
            dofs=config.dofs, material=material, cache=cache, log=log,
        )  # fmt: skip
        # What cannot be had shows now.
        _ = bodies.bodies
    except SimulationError as error:
        if wall is None or error.name != "surface":
            raise
        message = f"body.wall = {wall:g}, in meters (0: solid): {error}"
        raise SimulationError(message, name="wall", value=wall) from error
    return bodies


def guess_field(
    surface: Surface | HollowShape,
    material: Material | str,
    *,
    body: BodyConfig | None = None,
    modes: int = 128,
    config: FitConfig | None = None,
    settings: CaptureSettings | None = None,
    name: str = "",
    cache: Path | None = None,
    log: Callable[[str], None] | None = None,
) -> SoundField:
    """Return the field of a free body of a material, by finite elements, without any recording.

    `surface` is in meters. It is filled, unless `body.wall` states the thickness of a wall. At most `modes` modes are
    kept, those that sound below half of 44.1 kHz. Sounds are in pascals per newton of peak force of a small
    steel hammer (`Hammer`), at a distance of 1 m (`radiated_pressure`). There is no residual noise. Elastic modes are
    cached in the folder `cache`; `log` receives messages on the progress.

    Raises SimulationError for an unknown material, a surface without a body and a body that makes no sound, and
    FitError for a surface in another unit and a wall whose thickness has to be stated.
    """
    material = material_named(material) if isinstance(material, str) else material
    body, settings = body or BodyConfig(), settings or CaptureSettings()
    seen = _as_seen(surface, body.wall)
    free = replace(body, wall=body.wall or 0.0, shapes=modes, supports="free")
    found = candidate_bodies(surface, free, material=material, cache=cache, log=log).bodies[0]
    vibration = damped(
        found.elastic.frequency,
        torch.diag(rayleigh(found.elastic.frequency, material)),
        highest=_HIGHEST * _SAMPLE_RATE,
    )
    # Rayleigh damping does not couple modes: each damped one has one shape.
    rows = vibration.pushes.abs().argmax(dim=1)
    elastic = replace(
        found.elastic, frequency=found.elastic.frequency[rows], shapes=found.elastic.shapes[:, rows], perturbations=None
    )
    push = 2.0 * vibration.pushes.gather(1, rows[:, None])[:, 0].abs()
    loudness = push * radiated_pressure(found.elastic, vibration) * _pulse(elastic, vibration.poles)
    # As a file holds them, so that a field read back has the same sounds.
    shapes = (elastic.shapes * loudness[:, None]).float().double()
    points = FeatureField.from_mesh(seen, seed=0).points
    described = f"{len(elastic)} modes of a {material.name} body ({found.name})"
    report = {
        "gain_model": "mode shapes of a guessed body",
        "guess": f"No recordings: a guess of {described} from its shape and the material's constants alone.",
        "material": asdict(material),
        "body": found.name,
        "mass": elastic.mass,
    }
    return SoundField(
        ModalBank(vibration.frequency, vibration.damping),
        BodyGains(points, replace(elastic, shapes=shapes)),
        torch.zeros_like(vibration.frequency),
        Residual(torch.zeros(_BINS)),
        _SAMPLE_RATE,
        round(settings.kept_seconds(_SAMPLE_RATE) * _SAMPLE_RATE),
        Origin(name, (), True, config or FitConfig(), report, settings),
    )


def expect_no_recordings(folder: Path) -> None:
    """Raise FitError for a folder whose table of contacts has rows: a fit to them says more than a guess."""
    table = folder / TABLE
    if table.is_file() and len(read_cells(table)[0]) > 1:
        advice = "leave --material out, or name the mesh"
        raise FitError.expected(
            "no recordings with --material", got="some", file=table, name="--material", advice=advice
        )


def _as_seen(surface: Surface | HollowShape, wall: float | None) -> Surface:
    """Return what is seen. Raises FitError where it is no object in meters, or does not say how thick its wall is."""
    seen = surface if isinstance(surface, Surface) else surface.as_seen()
    extent = float((seen.vertices.amax(0) - seen.vertices.amin(0)).max())
    if not NARROWEST <= extent <= WIDEST:
        wanted, advice = f"a size of {NARROWEST:g} to {WIDEST:g} m", "state the mesh's unit in capture.toml"
        raise FitError.expected(wanted, extent, got=f"{extent:.3g} m", name="surface_unit", advice=advice)
    between = None if isinstance(surface, Surface) else surface.thickness_range
    if between is not None and wall is None:
        low, high = (1000 * each for each in between)
        advice = f"give it by --set body.wall=METERS (0: solid; by the views {low:.2g} to {high:.2g} mm)"
        wanted = "the wall thickness, which sets the frequencies"
        raise FitError.expected(wanted, between, got="none", name="wall", advice=advice)
    return seen


def _pulse(elastic: ElasticModes, poles: Complex128[Tensor, " modes"]) -> Float64[Tensor, " modes"]:
    """Return the size of the hammer's pulse at the modes' poles, newton seconds per newton of peak force."""
    hammer = Hammer()
    speed = torch.tensor([hammer.speed], dtype=torch.float64)
    times = contact_times(hammer, elastic.material, mass=elastic.mass, speeds=speed)
    return pulse_spectrum(hammer, poles, times)[0].abs()
