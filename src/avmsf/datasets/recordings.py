"""From a dataset's recordings of one object to its capture, prepared as the files of a user's own folder are."""

import warnings
from collections.abc import Iterable, Sequence

from avmsf._utils.text import listed
from avmsf.capture.audio import Recording
from avmsf.capture.folder import Capture
from avmsf.capture.impacts import Impacts
from avmsf.capture.issues import Issues, shared_problems
from avmsf.capture.placement import check_placement
from avmsf.capture.preprocess import preprocess
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.table import Impact
from avmsf.errors import CaptureError, CaptureWarning, DatasetError
from avmsf.mesh.surface import Surface, surface_points

MIN_RECORDINGS = 2


def build_capture(
    recordings: Iterable[tuple[Impact, Recording]],
    *,
    name: str,
    origin: str,
    settings: CaptureSettings,
    surface: Surface | None = None,
    remarks: Sequence[str] = (),
    recorded: bool = True,
) -> Capture:
    """Prepare an object's recordings one after the other, as `read_capture` does, and return the object's capture.

    `recordings` may be read as they are asked for: only what is kept stays in memory. One that cannot be used (silent,
    too short after its impact) is left out. A `CaptureWarning` lists these, suspicious recordings, contacts off the
    surface or with several impacts, and the `remarks`. Computed sounds, not `recorded`, are not searched for clipping,
    noise and second impacts. Raises DatasetError, which names the `origin`, where fewer than two recordings
    remain or they do not fit together, and where contacts and surface count different units.
    """
    try:
        impacts, issues = preprocess(recordings, settings, Issues(collect=True), measured=recorded)
        left_out = [each for each in issues.reports if not each.readable]
        remarks = [*remarks, *(f"left out: {problem}" for each in left_out for problem in each.problems)]
        remarks += shared_problems([each for each in issues.reports if each.readable])
        for error in issues.errors:
            raise error
        refuse_few(0 if impacts is None else len(impacts), origin=origin, reasons=remarks)
    except CaptureError as error:
        raise DatasetError(f"{origin}: {error}", **error.attributes) from error
    assert impacts is not None
    remarks += map(str, issues.warnings)
    remarks += _repeated(impacts) + _misplaced(impacts, surface, origin=origin)
    if remarks:
        message = f"{origin}: {listed(remarks, separator='; ')}"
        warnings.warn(CaptureWarning(message, name=origin, value=tuple(remarks)), stacklevel=3)
    return Capture(name, impacts, surface, settings)


def refuse_few(count: int, *, origin: str, reasons: Sequence[str]) -> None:
    """Raise DatasetError with the reasons where fewer than two recordings can be used."""
    if count < MIN_RECORDINGS:
        wanted, advice = f"at least {MIN_RECORDINGS} usable recordings with contacts", listed(reasons, separator="; ")
        raise DatasetError.expected(wanted, count, name=origin, advice=advice)


def _repeated(impacts: Impacts) -> list[str]:
    places: dict[tuple[float, ...], list[str]] = {}
    for name, contact in zip(impacts.names, impacts.contacts.tolist(), strict=True):
        places.setdefault(tuple(round(value, 6) for value in contact), []).append(name)
    repeated = [", ".join(names) for names in places.values() if len(names) > 1]
    return [f"impacts at the same contact: {listed(repeated, separator='; ')}"] if repeated else []


def _misplaced(impacts: Impacts, surface: Surface | None, *, origin: str) -> list[str]:
    if surface is None:
        return []
    placement = check_placement(impacts.contacts, surface_points(surface))
    found = placement.describe(impacts.names)
    if placement.fault == "unit":
        factor = placement.mismatch.factor if placement.mismatch else None
        raise DatasetError.expected("contacts and surface in one unit", factor, got=found, name=origin)
    return [found] if found else []
