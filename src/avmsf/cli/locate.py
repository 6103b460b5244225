"""`avmsf locate`: contacts of recorded impacts, as text, heat maps and point clouds."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import mean, median
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf._utils.text import format_number
from avmsf.capture import CaptureSettings
from avmsf.capture.audio import Recording, read_recording
from avmsf.capture.settings import METRES
from avmsf.cli.contacts import Contacts, read_contacts, refuse_far, rows_of
from avmsf.cli.heartbeat import doing
from avmsf.cli.options.locate import RECORDING, Options
from avmsf.cli.printing import console, next_command, print_json, say
from avmsf.editing.modal_edit import EDITS
from avmsf.errors import AvmsfError, LocationError
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load
from avmsf.localization.contact_map import ContactMap, not_located, symmetries_of
from avmsf.localization.likelihood import Force
from avmsf.localization.locate import locate, locate_impacts
from avmsf.localization.locator import Locator
from avmsf.symmetry.symmetries import Symmetries

UNLOCATED = 2
"""The exit code where a recording could not be located."""


def run(options: Options) -> int:
    """Locate, print and draw; return 2 where a recording could not be located."""
    settings = None if options.settings is None else CaptureSettings.read(options.settings)
    force = None if options.force is None else Force(options.force)
    known = _Known(load(options.field))
    truths = _true_contacts(options, known.field)
    say("preparing the gains over the surface and their posterior, once a run (seconds to minutes)")
    screen = console(errors=options.json)
    quality = known.field.quality
    verdict = known.field.origin.report.get("guess") if quality is None else quality.verdict
    if verdict is not None:
        screen.print(verdict, soft_wrap=True)
    taken, found, failures = set[str](), list[dict[str, Any]](), list[dict[str, str]]()
    for path in options.recordings:
        if found:
            doing(f"locating the impact of {path}")
        try:
            RECORDING.check(path)
            answers = _answers(known, read_recording(path), path, settings, force, options)
        except AvmsfError as error:
            if len(options.recordings) == 1:
                raise
            failures.append({"recording": str(path), "error": " ".join(str(error).split())})
            say(f"avmsf locate: {failures[-1]['error']}")
            continue
        truth = None if truths is None else _true_contact(truths, path)
        for values, contact in answers:
            if truth is not None and contact is not None:
                values |= _error(contact, truth, options.probability)
            screen.print(_words(values), soft_wrap=True)
            if contact is not None and options.output is not None:
                values |= _draw(contact, options.output, _name(path, taken), values, truth)
            found.append(values)
    summary = _summary(found)
    if summary is not None:
        screen.print(_summary_line(summary, options.probability), soft_wrap=True)
    if known.field.gain_field.contacts is not None and not known.field.origin.report.get(EDITS):
        next_command("avmsf suggest", options.field)
    if options.json:
        results = {"impacts": found, "summary": summary, "failures": failures}
        print_json({"field": str(options.field), "quality": verdict, **results})
    return UNLOCATED if failures or any(each["position"] is None for each in found) else 0


@dataclass(frozen=True, eq=False)
class _Known:
    """A field, and what is computed of it only where it is needed."""

    field: SoundField

    @cached_property
    def locator(self) -> Locator:
        return Locator.of(self.field)

    @cached_property
    def symmetries(self) -> Symmetries | None:
        """The symmetries of the field's points; None where these are too few to tell."""
        return symmetries_of(self.field)


def _answers(
    known: _Known,
    recording: Recording,
    path: Path,
    settings: CaptureSettings | None,
    force: Force | None,
    options: Options,
) -> list[tuple[dict[str, Any], ContactMap | None]]:
    """Return the values for each impact of a recording, and its map; None for one that could not be located."""
    try:
        impacts = _impacts(known, recording, settings, force, several=options.several)
    except LocationError as error:
        return [({"recording": str(path), "seconds": None, **not_located(str(error))}, None)]
    return [
        (_describe(str(path), seconds, contact, known, options.probability), None if contact.refusal else contact)
        for seconds, contact in impacts
    ]


def _impacts(
    known: _Known, recording: Recording, settings: CaptureSettings | None, force: Force | None, *, several: bool
) -> list[tuple[float | None, ContactMap]]:
    """Return the onsets of a recording's impacts, seconds, where there may be several, and their contacts."""
    if several:
        return [*locate_impacts(known.field, recording, settings=settings, force=force, locator=known.locator)]
    found = locate(known.field, recording, settings=settings, force=force, locator=known.locator, progress=False)
    return [(None, found)]


def _true_contacts(options: Options, field: SoundField) -> Contacts | None:
    """Return the true contacts, if any. Raises OutputError for one far from the object, as in another unit."""
    meters = METRES[options.unit]
    if options.true_contact_table is not None:
        contacts = read_contacts(options.true_contact_table, meters=meters, recordings=True)
    elif options.true_contact is not None:
        place = torch.tensor([options.true_contact], dtype=torch.float64) * meters
        contacts = Contacts(place, ("true",), option="--true-contact")
    else:
        return None
    refuse_far(contacts, field, advice=", see --unit")
    return contacts


def _true_contact(contacts: Contacts, recording: Path) -> Float64[Tensor, " 3"] | None:
    """Return a recording's true contact; where a table does not have one row for it, note that."""
    rows = [0] if contacts.table is None else rows_of(contacts, recording)
    if len(rows) != 1:
        got = len(rows) or "none"
        say(f"note: {contacts.table}: expected one row for {recording}, got {got}; its distance is not known")
        return None
    return contacts.places[rows[0]]


def _error(contact: ContactMap, truth: Float64[Tensor, " 3"], level: float) -> dict[str, Any]:
    """Return how far the most probable contact is from the true one, and both estimates relative to the diagonal.

    `rmed` is of the point of least cosine distance, as in `avmsf evaluate localize`; `in_region` says whether the
    credible region contains the true contact.
    """
    diagonal = float((contact.points.amax(0) - contact.points.amin(0)).norm())
    places = (contact.points[int(contact.distance.argmin())], contact.position)
    cosine, likely = (float((place.double() - truth).norm()) for place in places)
    relative = {"rmed": cosine / diagonal, "rmed_posterior": likely / diagonal}
    inside = {"in_region": contact.contains(truth, level)}
    return {"true_contact": truth.tolist(), "error": likely, **relative, **inside}


def _summary(impacts: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """Return values over the located impacts of known contacts; None where there are fewer than two.

    These are their number, the median error in meters, the mean of both relative errors, and the fraction of the true
    contacts that are within their credible region.
    """
    known = [each for each in impacts if "error" in each]
    if len(known) < 2:
        return None
    means = {name: mean(each[name] for each in known) for name in ("rmed", "rmed_posterior", "in_region")}
    return {"impacts": len(known), "median_error": median(each["error"] for each in known), **means}


def _summary_line(summary: dict[str, Any], level: float) -> str:
    count = summary["impacts"]
    return (
        f"{count} located impacts of known contacts: median distance {1000 * summary['median_error']:.1f} mm, mean "
        f"distance over the object's diagonal (RMED) {100 * summary['rmed_posterior']:.1f} % "
        f"({100 * summary['rmed']:.1f} % by cosine distance), {round(count * summary['in_region'])} of {count} true "
        f"contacts within the {100 * level:g} % region"
    )


def _describe(name: str, seconds: float | None, contact: ContactMap, known: _Known, level: float) -> dict[str, Any]:
    """Return the results for an impact, as plain values."""
    symmetries = known.symmetries if contact.refusal is None and len(contact.peaks(level)) > 1 else None
    return {"recording": name, "seconds": seconds, **contact.describe(symmetries, level)}


def _words(values: dict[str, Any]) -> str:
    """Return one line about an impact, and one for each further message."""
    when = "" if values["seconds"] is None else f" at {values['seconds']:.3f} s"
    if values["position"] is None:
        return f"{values['recording']}{when}: {values['status']}: {values['reason']}"
    region = values["credible_region"]
    where = ", ".join(f"{value + 0.0:.4f}" for value in values["position"])
    chance = f", with {100 * values['position_probability']:.0f} %" if values["multimodal"] else ""
    lines = [
        f"{values['recording']}{when}: impact at ({where}) m{chance}; {100 * region['probability']:g} % within "
        f"{format_number(1000 * region['radius'], 2)} mm, {format_number(100 * region['surface_fraction'], 2)} % of "
        f"the surface; an impact there explains {100 * values['explained_energy']:.0f} % of the sound"
    ]
    if "rmed" in values:
        error, share = 1000 * values["error"], 100 * values["rmed_posterior"]
        side = "within" if values["in_region"] else "outside"
        lines.append(
            f"  {error:.1f} mm from the true contact ({share:.1f} % of the diagonal), which is {side} the "
            f"{100 * region['probability']:g} % region"
        )
    if values["multimodal"]:
        lines.append("  ambiguous: there are other possible positions")
    lines += [f"  {other['message']}" for other in values["equivalent_points"]]
    return "\n".join([*lines, *(f"  note: {note}" for note in values["notes"])])


def _name(path: Path, taken: set[str]) -> str:
    """Return the name of an impact's files: the recording's, numbered where that is taken."""
    numbered = (f"{path.stem}-{number}" for number in itertools.count(2))
    name = next(each for each in itertools.chain([path.stem], numbered) if each not in taken)
    taken.add(name)
    return name


def _draw(
    contact: ContactMap, folder: Path, name: str, values: dict[str, Any], truth: Float64[Tensor, " 3"] | None
) -> dict[str, str]:
    # Drawing imports matplotlib, which text does without.
    from avmsf.plotting.contacts import draw_contact, write_contact_cloud
    from avmsf.plotting.pictures import save_picture

    picture, cloud = folder / f"{name}.png", folder / f"{name}.ply"
    others = [other["position"] for other in values["equivalent_points"]]
    marks = torch.tensor(others) if others else None
    title = f"{values['recording']}: contact"
    save_picture(draw_contact(contact, title=title, others=marks, truth=truth), picture)
    write_contact_cloud(contact, cloud)
    for path in (picture, cloud):
        say(f"wrote {path}")
    return {"picture": str(picture), "cloud": str(cloud)}
