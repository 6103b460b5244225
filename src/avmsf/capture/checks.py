"""Whether the contacts of a table fit one another and the object's surface, and in which units they would."""

import itertools
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch

from avmsf._utils.text import listed
from avmsf.capture.filenames import find_surface_file
from avmsf.capture.issues import Issues
from avmsf.capture.placement import Placement, check_placement
from avmsf.capture.settings import METRES, SETTINGS, TABLE, CaptureSettings
from avmsf.capture.table import Impact, fitting_units, parse_rows, read_rows
from avmsf.errors import CaptureError, CaptureWarning
from avmsf.mesh.surface import Surface, contacted_part, surface_points

NARROWEST, WIDEST = 1e-3, 10.0
"""Meters across below or beyond which contacts are more likely in another unit."""
USUAL_SIZE = 0.24
"""Meters across of an object whose impacts are recorded: the median of the 20 simulated objects (.14 to .55)."""


def check_contacts(impacts: Sequence[Impact], settings: CaptureSettings) -> list[CaptureWarning]:
    """Return warnings of repeated contacts, and of contacts that together look like another unit's."""
    remarks = []
    places = defaultdict(list)
    for impact in impacts:
        # Impacts along other directions are no repetitions.
        label = (*impact.contact, *(impact.direction or ()))
        places[tuple(round(value, 6) for value in label)].append(impact.line)
    repeated = [lines for lines in places.values() if len(lines) > 1]
    if repeated:
        shown = listed([listed(list(map(str, lines))) for lines in repeated], separator="; ")
        message = f"{TABLE}: rows at the same contact: {shown}; used as repeated impacts"
        remarks.append(CaptureWarning(message, file=TABLE, row=repeated[0][1], value=repeated))
    across = float(np.linalg.norm(np.ptp([impact.contact for impact in impacts], axis=0))) if impacts else 0.0
    if across > WIDEST or 0 < across < NARROWEST:
        size = f"{across:.3g} m apart" if across > WIDEST else f"within {across * 1e3:.2g} mm"
        message = (
            f"{TABLE}: the contacts lie {size} (unit = {settings.unit!r}); if that is wrong, "
            f"{fitting_units(across / settings.meters)}"
        )
        remarks.append(CaptureWarning(message, file=TABLE, name="unit", value=across))
    return remarks


MAX_HELD_DISTANCE = 0.1
"""Distance from the surface, over its diagonal, of a point at which the object is held: a finger on a small object."""


def expect_held(held_at: Sequence[tuple[float, float, float]], surface: Surface) -> None:
    """Raise CaptureError for a point, meters, at which the object is said to be held and which is far from it."""
    if not held_at:
        return
    away = torch.cdist(torch.tensor(held_at, dtype=torch.float64), surface_points(surface).double()).amin(1)
    size, row = float((surface.vertices.amax(0) - surface.vertices.amin(0)).norm()), int(away.argmax())
    if float(away[row]) > MAX_HELD_DISTANCE * size:
        place = ", ".join(f"{each:.4g}" for each in held_at[row])
        got = f"({place}) m, {1000 * float(away[row]):.0f} mm away from it"
        advice = "give it in the unit and frame of the contacts"
        raise CaptureError.expected(
            "points on the object", float(away[row]), got=got, file=SETTINGS, name="held", advice=advice
        )


def check_surface(
    impacts: Sequence[Impact], surface: Surface, *, settings: CaptureSettings
) -> tuple[Surface, list[CaptureWarning]]:
    """Return the part of a surface that the contacts lie on, and a warning of contacts off it.

    `CaptureError` where surface and contacts are in different units, and where a contact lies farther off than the
    surface is large.
    """
    expect_held(settings.held_at, surface)
    contacts = torch.tensor([impact.contact for impact in impacts], dtype=torch.float64)
    surface, areas = contacted_part(surface, contacts)
    warned = list[CaptureWarning]()
    if areas:
        sizes = " and ".join(f"{1e4 * area:.3g} cm2" for area in areas[1:3])
        message = f"the contacts lie on a part of {1e4 * areas[0]:.3g} cm2; larger ones ({sizes}) are left out"
        warned.append(CaptureWarning(message, name="surface", value=areas))
    placement = check_placement(contacts, surface_points(surface))
    if placement.fault == "none":
        return surface, warned
    advice = units_words(fitting_units_of(placement, settings))
    found = placement.describe([f"row {impact.line}" for impact in impacts]) + (advice and f". If so, {advice}")
    farthest = float(placement.distances.max())
    if placement.fault == "unit":
        message = f"{TABLE}: expected contacts and surface in one unit; {found}"
        raise CaptureError(message, file=TABLE, name="unit", value=farthest)
    worst = impacts[int(placement.distances.argmax())].line
    if farthest > placement.diagonal:
        got = f"one {farthest:.3g} m off it, more than its extent of {placement.diagonal:.3g} m: {found}"
        wanted = "a contact on the surface"
        raise CaptureError.expected(wanted, farthest, got=got, file=TABLE, row=worst, name="surface")
    warned.append(CaptureWarning(f"{TABLE}: {found}", file=TABLE, row=worst, name="surface", value=farthest))
    return surface, warned


def readable_impacts(folder: Path, settings: CaptureSettings) -> list[Impact]:
    """Return the rows of a folder's table that can be read: none where there is no table, or one that cannot."""
    with suppress(CaptureError):
        return parse_rows(read_rows(folder)[0], settings, Issues(collect=True))
    return []


def check_one_unit(folder: Path, settings: CaptureSettings) -> None:
    """Raise `CaptureError` where a folder's surface and the contacts of its table are in different units.

    For callers that read only the surface.
    """
    impacts = readable_impacts(folder, settings)
    surface = find_surface(folder, settings) if impacts else None
    if surface is not None:
        check_surface(impacts, surface, settings=settings)


def fitting_units_of(placement: Placement, settings: CaptureSettings) -> dict[str, str]:
    """Return the settings `unit` and `surface_unit` to change so that contacts and surface fit, as `units_by`."""
    mismatch = placement.mismatch
    if placement.mostly_off if mismatch is None else not mismatch.unit_only:
        return {}
    factor = 1.0 if mismatch is None else mismatch.factor
    return units_by(settings, placement.diagonal, {"unit": factor, "surface_unit": 1.0})


def units_by(settings: CaptureSettings, size: float, factors: Mapping[str, float]) -> dict[str, str]:
    """Return the units to change so that coordinates are multiplied by these factors, or by others in proportion.

    `factors` are those of contacts, surface and cameras, by their settings: `unit`, `surface_unit`, `views_unit`. The
    object, `size` meters across after these factors, says which: units that make it `NARROWEST` to `WIDEST` across, the
    present ones if they do, else those that come nearest to `USUAL_SIZE`. Empty where no unit is to change, or none
    does it.
    """
    present = {"unit": settings.meters, "surface_unit": settings.surface_meters, "views_unit": settings.views_meters}
    ranked = list[tuple[bool, bool, float, dict[str, str]]]()
    for names in itertools.product(METRES, repeat=len(factors)):
        units = dict(zip(factors, names, strict=True))
        scales = [METRES[unit] / (present[key] * factors[key]) for key, unit in units.items()]
        if math.isclose(min(scales), max(scales), rel_tol=1e-6):
            # The surface's is the contacts' where it is not stated.
            changes = {key: unit for key, unit in units.items() if unit != (getattr(settings, key) or units["unit"])}
            across = max(size * scales[0], 1e-9)
            unusual = not NARROWEST <= across <= WIDEST
            ranked.append((unusual, bool(changes), abs(math.log(across / USUAL_SIZE)), changes))
    return min(ranked, key=lambda each: each[:3])[3] if ranked else {}


def units_words(units: Mapping[str, str]) -> str:
    """Return what to write in capture.toml to change units; empty for none."""
    lines = [f'{key} = "{unit}"' for key, unit in units.items()]
    return f"write {' and '.join(lines)} in capture.toml" if lines else ""


def find_surface(folder: Path, settings: CaptureSettings) -> Surface | None:
    """Read what `find_surface_file` finds, without vertices of no triangle; None where it finds nothing."""
    path = find_surface_file(folder, settings)
    return None if path is None else Surface.read(path, meters=settings.surface_meters).used()
