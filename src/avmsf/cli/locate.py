"""`avmsf locate`: contacts of recorded impacts, as text and heat maps."""

import itertools
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import mean, median
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from avmsf._utils.text import counted, format_number
from avmsf.capture.settings import CaptureSettings, settings_of
from avmsf.cli.options import Common, Flag, Number, Unit
from avmsf.cli.output import command, doing, finish, note, say, show
from avmsf.cli.paths import Existing, FieldFile, OutputError, PictureFolder, SettingsFile, TruthTable, arg
from avmsf.errors import AvmsfError, CaptureError, LocationError

if TYPE_CHECKING:
    from jaxtyping import Float64
    from torch import Tensor

    from avmsf.cli.contacts import Contacts
    from avmsf.field.sound_field import SoundField
    from avmsf.localization.contact_map import ContactPosterior

    _Answer = tuple[dict[str, Any], ContactPosterior | None]
    """The values for an impact, and its map; None for one that could not be located."""

UNLOCATED = 2
"""The exit code where a recording could not be located."""
RECORDING = Existing("a recording", ("a recording",))


@dataclass(frozen=True)
class Options(Common):
    """Find where on the object the impact of a recording was, with a heat map and the uncertainty.

    Each recording holds one impact, of any force and polarity; with --several, any number of them.
    """

    field: FieldFile
    recordings: tyro.conf.Positional[Annotated[tuple[Path, ...], tyro.conf.arg(metavar="RECORDING.wav ...")]]
    """Recordings of impacts on the same object: wav, flac or another format that libsndfile reads."""
    settings: SettingsFile = None
    """Read the recordings by this capture.toml; by default like the recordings of the fit."""
    several: Flag = False
    """The recordings hold several impacts each; locate every one of them."""
    force: Number = None
    """Peak force of every impact, newtons (or relative to an average one), which tells contacts by loudness."""
    probability: float = 0.9
    """Probability that the contact lies within the region that is reported."""
    true_contact: Annotated[tuple[float, float, float] | None, arg("X Y Z")] = None
    """True contact of every impact, to print and mark its distance."""
    true_contact_table: TruthTable = None
    """True contacts of several recordings: columns file,x,y,z, such as impacts.csv."""
    unit: Unit = "m"
    """Unit of the true contacts; the field is in meters."""
    output: PictureFolder = None
    """Folder for a heat map of every impact, NAME.png: most of many recordings' time."""

    def _check(self) -> None:
        if not self.recordings:
            raise OutputError.expected("one or more after the field, such as HIT.wav", 0, name="recordings")
        if self.true_contact is not None and self.true_contact_table is not None:
            wanted = "true contacts by it, X Y Z, or by --true-contact-table TABLE.csv"
            raise OutputError.expected(wanted, list(self.true_contact), got="both", name="--true-contact")
        if not 0.0 < self.probability < 1.0:
            wanted = "a probability between 0 and 1, such as 0.9"
            raise OutputError.expected(wanted, self.probability, name="--probability")
        if len(self.recordings) == 1:
            RECORDING.check(self.recordings[0])


def run(options: Options) -> int:
    """Locate, print and draw; return 2 where a recording could not be located."""
    from avmsf.cli.contacts import contacts_on
    from avmsf.editing.modal_edit import EDITS
    from avmsf.field.store import load

    field = load(options.field)
    truths, table = None, options.true_contact_table
    if table is not None or options.true_contact is not None:
        given = [] if options.true_contact is None else [options.true_contact]
        truths = contacts_on(field, given, table, unit=options.unit, option="--true-contact", recordings=True)
    say("preparing the gains over the surface and their posterior, once a run (seconds to minutes)")
    verdict = field.origin.report.get("guess") if field.quality is None else field.quality.verdict
    if verdict is not None:
        show(verdict)
    taken, found, failures = set[str](), list[dict[str, Any]](), list[dict[str, str]]()
    locate = _locator(options, field)
    # What does not count comes last.
    recordings = sorted(options.recordings, key=lambda path: table is not None and _is_training(field, path))
    try:
        for path in recordings:
            doing(f"locating the impact of {path}")
            try:
                RECORDING.check(path)
                answers = locate(path)
            except AvmsfError as error:
                # One that cannot be read does not keep the others from being located.
                if len(options.recordings) == 1:
                    raise
                failures.append({"recording": str(path), "error": " ".join(str(error).split())})
                say(f"avmsf locate: {failures[-1]['error']}", always=True)
                continue
            truth = None if truths is None else _true_contact(truths, path)
            for values, contact in answers:
                if truth is not None and contact is not None:
                    values |= _error(contact, truth, options.probability)
                    values["training"] = _is_training(field, path)
                show(_words(values))
                found.append(values)
                if contact is not None and options.output is not None:
                    values |= _draw(contact, options.output, _name(path, taken), values, truth)
    finally:  # An interruption keeps the summary of what is located.
        summary = _summary(found)
        if summary is not None:
            show(_summary_line(summary, options.probability))
    results = {"impacts": found, "summary": summary, "failures": failures}
    located = [each["position"] is not None for each in found]
    suggests = any(located) and field.has_posterior and not field.origin.report.get(EDITS)
    steps = [command("avmsf suggest", options.field)] if suggests else []
    code = UNLOCATED if failures or not all(located) else 0
    return finish("", {"field": str(options.field), "quality": verdict, **results}, *steps, code=code)


def _locator(options: Options, field: "SoundField") -> "Callable[[Path], list[_Answer]]":
    """Return what locates the impacts of a recording; what it needs of the field is computed with the first one."""
    from avmsf.capture.audio import read_recording
    from avmsf.localization.contact_map import not_located
    from avmsf.localization.likelihood import Force
    from avmsf.localization.locate import locate, locate_impacts
    from avmsf.localization.locator import Locator

    settings = None if options.settings is None else CaptureSettings.read(options.settings)
    force, level = None if options.force is None else Force(options.force), options.probability
    locator = cache(lambda: Locator.of(field))

    def describe(path: Path, seconds: float | None, contact: "ContactPosterior") -> "_Answer":
        values = contact.describe(level)
        return {"recording": str(path), "seconds": seconds, **values}, None if contact.refusal else contact

    def answers(path: Path) -> "list[_Answer]":
        recording = read_recording(path)
        given: dict[str, Any] = {"settings": settings, "force": force, "locator": locator()}
        try:
            if options.several:
                return [describe(path, *each) for each in locate_impacts(field, recording, **given)]
            return [describe(path, None, locate(field, recording, progress=False, **given))]
        except LocationError as error:
            return [({"recording": str(path), "seconds": None, **not_located(str(error))}, None)]

    return answers


def _true_contact(contacts: "Contacts", recording: Path) -> "Float64[Tensor, ' 3'] | None":
    """Return a recording's true contact; where a table does not have one row for it, note that."""
    from avmsf.cli.contacts import rows_of

    rows = [0] if contacts.table is None else rows_of(contacts, recording)
    if len(rows) != 1:
        got = len(rows) or "none"
        note(f"{contacts.table}: expected one row for {recording}, got {got}; its distance is not known")
        return None
    return contacts.places[rows[0]]


def _error(contact: "ContactPosterior", truth: "Float64[Tensor, ' 3']", level: float) -> dict[str, Any]:
    """Return how far the most probable contact is from the true one, and both estimates as `evaluate localize`."""
    diagonal = float((contact.points.amax(0) - contact.points.amin(0)).norm())
    places = (contact.points[int(contact.distance.argmin())], contact.position)
    cosine, likely = (float((place.double() - truth).norm()) for place in places)
    relative = {"rmed": cosine / diagonal, "rmed_posterior": likely / diagonal}
    return {"true_contact": truth.tolist(), "error": likely, **relative, "in_region": contact.contains(truth, level)}


def _is_training(field: "SoundField", path: Path) -> bool:
    """Return whether a field was fitted to a file: a recording of its capture, the folder of that name around it."""
    path, origin = path.resolve(), field.origin
    owners = [each for each in path.parents if path.relative_to(each).as_posix() in origin.trained_on]
    return any(_capture_name(each) == origin.capture for each in owners)


def _capture_name(folder: Path) -> str:
    """Return what a folder's settings call it, or its own name, also where the settings cannot be read."""
    with suppress(CaptureError):
        return settings_of(folder).name or folder.name
    return folder.name


def _summary(impacts: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """Return values over the located impacts of known contacts, without training recordings; None of fewer than two."""
    known = [each for each in impacts if "error" in each]
    scored = [each for each in known if not each["training"]]
    if len(scored) < 2:
        return None
    means = {name: mean(each[name] for each in scored) for name in ("rmed", "rmed_posterior", "in_region")}
    counts = {"impacts": len(scored), "training": sum(each["training"] for each in known)}
    return {**counts, "median_error": median(each["error"] for each in scored), **means}


def _summary_line(summary: dict[str, Any], level: float) -> str:
    count, training = summary["impacts"], counted(summary["training"], "training recording")
    return (
        f"{count} located impacts of known contacts: median distance {1000 * summary['median_error']:.1f} mm, mean "
        f"distance over the object's diagonal (RMED) {100 * summary['rmed_posterior']:.1f} % "
        f"({100 * summary['rmed']:.1f} % by cosine distance), {round(count * summary['in_region'])} of {count} true "
        f"contacts within the {100 * level:g} % region{f'; {training} not counted' if summary['training'] else ''}"
    )


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
        side = "within" if values["in_region"] else "outside"
        lines.append(
            f"  {1000 * values['error']:.1f} mm from the true contact ({100 * values['rmed_posterior']:.1f} % of the "
            f"diagonal), which is {side} the {100 * region['probability']:g} % region"
            f"{'; a training recording' * values['training']}"
        )
    if values["multimodal"]:
        lines.append("  ambiguous: there are other possible positions")
    for other in values["equivalent_points"]:
        place = ", ".join(f"{value + 0.0:.4f}" for value in other["position"])
        lines.append(f"  also at ({place}) m, with {100 * other['probability']:.0f} %")
    return "\n".join([*lines, *(f"  note: {each}" for each in values["notes"])])


def _name(path: Path, taken: set[str]) -> str:
    """Return the name of an impact's files: the recording's, numbered where that is taken."""
    numbered = (f"{path.stem}-{number}" for number in itertools.count(2))
    name = next(each for each in itertools.chain([path.stem], numbered) if each not in taken)
    taken.add(name)
    return name


def _draw(
    contact: "ContactPosterior", folder: Path, name: str, values: dict[str, Any], truth: "Float64[Tensor, ' 3'] | None"
) -> dict[str, str]:
    import torch

    from avmsf.plotting.pictures import save_picture
    from avmsf.plotting.uncertainty import draw_contact

    picture = folder / f"{name}.png"
    others = [other["position"] for other in values["equivalent_points"]]
    marks = torch.tensor(others) if others else None
    title = f"{values['recording']}: contact"
    save_picture(draw_contact(contact, title=title, others=marks, truth=truth), picture)
    say(f"wrote {picture}")
    return {"picture": str(picture)}
