"""What the recordings and contacts of one capture must have in common, and what looks wrong when compared."""

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch

from avmsf._utils.text import counted
from avmsf.capture.filenames import find_surface_file
from avmsf.capture.placement import Placement, check_placement
from avmsf.capture.prepare import shortest_allowed
from avmsf.capture.settings import METRES, CaptureSettings
from avmsf.capture.table import TABLE, Strike, fitting_units, parse_row, read_rows
from avmsf.errors import CaptureError, CaptureWarning
from avmsf.mesh.surface import Surface, contacted_part, read_surface, surface_points

WIDEST = 10.0
"""Meters across beyond which contacts are more likely in another unit."""
NARROWEST = 1e-3
"""Meters across below which they are."""
USUAL_SIZE = 0.24
"""Meters across of an object whose impacts are recorded: the median of the 20 simulated objects (.14 to .55)."""
USUAL_RANGE_DB = 80.0
"""Level between a recording and the median beyond which its scale is doubtful: a contact near the nodes of most modes
takes 40 dB, a soft impact 30."""
MIN_EQUAL_PEAKS, SAME_PEAK_DB = 4, 0.05
"""Recordings, and how far their peaks may differ, that were scaled to one peak: struck ones differ by decibels."""
USUAL_GAP_DB = 12.0
"""Level between the loudest recording and the next beyond which its scale is doubtful, of six recordings or more: 24
measured and simulated captures have at most 7. One recording at ten times its level outweighs all others in a fit."""
MAX_RANGE_DB = 140.0
"""Level between the loudest and the faintest recording beyond which the faintest is less than the rounding of the
loudest in float32 (144 dB), in which they are fitted."""


def common_rate(rates: Sequence[float], names: Sequence[str]) -> float:
    """Return the one sample rate of the files, Hz; `CaptureError` where they differ."""
    counts = Counter(rates)
    if len(counts) > 1:
        found = [
            f"{rate:g} Hz ({counted(count, 'file')}, {names[list(rates).index(rate)]} the first)"
            for rate, count in counts.most_common()
        ]
        wanted, values = "recordings of one sample rate", [rate for rate, _ in counts.most_common()]
        advice = "nothing is resampled, so convert them to one rate"
        raise CaptureError.expected(wanted, values, got=", ".join(found), name="sample_rate", advice=advice)
    return rates[0]


def check_levels(peaks: Sequence[float], names: Sequence[str]) -> list[CaptureWarning]:
    """Return a warning where a prepared sound is far louder or fainter than the others, or all peaks are one.

    Raises `CaptureError` where the loudest is more than `MAX_RANGE_DB` above the faintest.
    """
    levels = 20 * np.log10(np.asarray(peaks))
    away = levels - np.median(levels)
    worst = int(np.abs(away).argmax())
    found = f"peak, {peaks[worst]:.3g}, is {away[worst]:+.0f} dB from that of most recordings ({np.median(peaks):.3g})"
    if np.ptp(levels) > MAX_RANGE_DB:
        raise CaptureError(
            f"{names[worst]}: its {found}; expected at most {MAX_RANGE_DB:g} dB between the loudest and the faintest, "
            f"got {np.ptp(levels):.0f}; export it at the scale of the others, or remove its row",
            file=names[worst],
            name="peak",
            value=peaks[worst],
        )
    ascending, row = np.sort(levels), worst
    above = ascending[-1] - ascending[-2] if len(levels) >= 6 else 0.0
    if len(levels) >= MIN_EQUAL_PEAKS and np.ptp(levels) < SAME_PEAK_DB:
        row = 0
        message = (
            f"all {len(levels)} recordings have the same peak, {peaks[0]:.3g}: expected the levels as recorded, got "
            "each scaled to one peak, which loses how strong the modes are at each contact; export them unscaled"
        )
    elif above > USUAL_GAP_DB:
        row = int(levels.argmax())
        message = (
            f"{names[row]}: its peak, {peaks[row]:.3g}, is {above:.0f} dB above that of the next loudest recording; "
            f"expected at most {USUAL_GAP_DB:g} dB; check its gain, its scale and its force"
        )
    elif abs(away[worst]) > USUAL_RANGE_DB:
        message = f"{names[worst]}: its {found}; expected at most {USUAL_RANGE_DB:g} dB; check its scale and its force"
    else:
        return []
    return [CaptureWarning(message, file=names[row], name="peak", value=peaks[row])]


def common_length(
    lengths: Sequence[int], names: Sequence[str], *, rate: float, settings: CaptureSettings
) -> tuple[int, list[CaptureWarning]]:
    """Return the common length of all sounds in samples from the onset, and a warning where one recording shortens all.

    That is `settings.kept_seconds`, or all of the shortest recording. `CaptureError` where the settings give too
    little.
    """
    seconds = settings.kept_seconds(rate)
    asked = round(seconds * rate)
    least = shortest_allowed(rate)
    if asked < least:
        wanted, got = f"at least {least} samples at {rate:g} Hz", f"{asked} ({seconds:g} s)"
        raise CaptureError.expected(wanted, seconds, got=got, name="seconds", advice="increase it in capture.toml")
    shortest = min(lengths)
    usual = min(asked, int(np.median(lengths)))
    if shortest >= 0.9 * usual:
        return min(asked, shortest), []
    name = names[list(lengths).index(shortest)]
    message = (
        f"{name}: {shortest / rate:.3g} s after its onset, most recordings have {usual / rate:.3g} s; all sounds are "
        "cut to this length; record it again or remove its row"
    )
    return min(asked, shortest), [CaptureWarning(message, file=name, value=shortest / rate)]


def check_contacts(strikes: Sequence[Strike], settings: CaptureSettings) -> list[CaptureWarning]:
    """Return warnings of repeated contacts, and of contacts that together look like another unit's."""
    remarks = []
    places = defaultdict(list)
    for strike in strikes:
        # Impacts along other directions are no repetitions.
        label = (*strike.contact, *(strike.direction or ()))
        places[tuple(round(value, 6) for value in label)].append(strike.line)
    repeated = [lines for lines in places.values() if len(lines) > 1]
    if repeated:
        shown = "; ".join(", ".join(map(str, lines)) for lines in repeated[:5])
        message = (
            f"{TABLE}: rows at the same contact: {shown}{' and more' * (len(repeated) > 5)}; used as repeated impacts"
        )
        remarks.append(CaptureWarning(message, file=TABLE, row=repeated[0][1], value=repeated))
    across = _diagonal([strike.contact for strike in strikes])
    if across > WIDEST or 0 < across < NARROWEST:
        size = f"{across:.3g} m apart" if across > WIDEST else f"within {across * 1e3:.2g} mm"
        message = (
            f"{TABLE}: the contacts lie {size} (unit = {settings.unit!r}); if that is wrong, "
            f"{fitting_units(across / settings.meters)}"
        )
        remarks.append(CaptureWarning(message, file=TABLE, name="unit", value=across))
    return remarks


def check_surface(strikes: Sequence[Strike], surface: Surface, *, settings: CaptureSettings) -> list[CaptureWarning]:
    """Return a warning of contacts off the surface.

    `CaptureError` where surface and contacts are in different units, and where a contact lies farther off than the
    surface is large.
    """
    contacts = torch.tensor([strike.contact for strike in strikes], dtype=torch.float64)
    surface, areas = contacted_part(surface, contacts)
    placement = check_placement(contacts, surface_points(surface))
    if areas:
        sizes = " and ".join(f"{1e4 * area:.3g} cm2" for area in areas[1:3])
        message = f"the contacts lie on a part of {1e4 * areas[0]:.3g} cm2; larger ones ({sizes}) are left out"
        return [CaptureWarning(message, name="surface", value=areas)]
    if placement.on_surface:
        return []
    found = placement.describe([f"row {strike.line}" for strike in strikes]) + _advice(placement, settings)
    farthest = float(placement.distances.max())
    if placement.other_unit:
        message = f"{TABLE}: expected contacts and surface in one unit; {found}"
        raise CaptureError(message, file=TABLE, name="unit", value=farthest)
    worst = strikes[int(placement.distances.argmax())].line
    if farthest > placement.diagonal:
        got = f"one {farthest:.3g} m off it, more than its extent of {placement.diagonal:.3g} m: {found}"
        wanted = "a contact on the surface"
        raise CaptureError.expected(wanted, farthest, got=got, file=TABLE, row=worst, name="surface")
    return [CaptureWarning(f"{TABLE}: {found}", file=TABLE, row=worst, name="surface", value=farthest)]


def expect_one_unit(folder: Path, settings: CaptureSettings) -> None:
    """Raise `CaptureError` where a folder's surface and the contacts of its table are in different units.

    For callers that read only the surface. Rows that cannot be parsed are skipped.
    """
    if not (folder / TABLE).is_file():
        return
    strikes = []
    with suppress(CaptureError):
        for row in read_rows(folder)[0]:
            with suppress(CaptureError):
                strikes.append(parse_row(row, settings))
    surface = find_surface(folder, settings) if strikes else None
    if surface is not None:
        check_surface(strikes, surface, settings=settings)


def fitting_units_of(placement: Placement, settings: CaptureSettings) -> dict[str, str]:
    """Return the settings `unit` and `surface_unit` to change so that contacts and surface fit, as far as units do it.

    Where both count one unit, the surface's size says which: the one that gives an object of `NARROWEST` to `WIDEST`,
    the present one if it does, else the one that comes nearest to `USUAL_SIZE`. Empty where nothing is to change, or
    no units explain what is wrong.
    """
    mistake = placement.mistake
    if placement.mostly_off if mistake is None else not mistake.unit_only:
        return {}
    ratio = settings.meters * (1.0 if mistake is None else mistake.factor) / settings.surface_meters
    prices = list[tuple[tuple[bool, bool, float], dict[str, str]]]()
    for (unit, meters), (surface_unit, surface_meters) in itertools.product(METRES.items(), repeat=2):
        if math.isclose(meters / surface_meters, ratio, rel_tol=1e-6):
            changes = {} if unit == settings.unit else {"unit": unit}
            changes |= {} if surface_unit == (settings.surface_unit or unit) else {"surface_unit": surface_unit}
            size = placement.diagonal * surface_meters / settings.surface_meters
            unusual = not NARROWEST <= size <= WIDEST
            prices.append(((unusual, bool(changes), abs(math.log(size / USUAL_SIZE))), changes))
    return min(prices, key=lambda each: each[0])[1] if prices else {}


def _advice(placement: Placement, settings: CaptureSettings) -> str:
    """Return what to write in capture.toml where units alone are wrong."""
    lines = [f'{key} = "{value}"' for key, value in fitting_units_of(placement, settings).items()]
    return f" If so, write {' and '.join(lines)} in capture.toml" if lines else ""


def _diagonal(points: Sequence[Sequence[float]]) -> float:
    return math.dist(*(tuple(edge(axis) for axis in zip(*points, strict=True)) for edge in (min, max)))


def find_surface(folder: Path, settings: CaptureSettings) -> Surface | None:
    """Read what `find_surface_file` finds; None where it finds nothing."""
    path = find_surface_file(folder, settings)
    return None if path is None else read_surface(path, meters=settings.surface_meters)
