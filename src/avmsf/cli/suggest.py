"""`avmsf suggest`: where to record next, as a table, a list and a figure."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avmsf._utils.text import counted, csv_text, format_number
from avmsf.cli.options import Common, Flag, expect_capture
from avmsf.cli.output import doing, finish, say, show, table
from avmsf.cli.paths import FieldFile, OtherCapture, PictureFolder
from avmsf.errors import FitError

if TYPE_CHECKING:
    from avmsf.field.next_contacts import Suggestions
    from avmsf.field.sound_field import SoundField

TABLE, PICTURE = "suggested.csv", "suggested.png"
"""What the folder of results holds."""
_DRAWN_POINTS = 4000
_UPWARD = 0.5
"""Part of a direction that goes up, from which on an impact is from below: 30 degrees above the horizontal."""


@dataclass(frozen=True)
class Options(Common):
    """Suggest where to record next: the contacts that reduce the expected error of the field most.

    Each suggestion assumes that those before it are recorded: record them in this order, fit again with all recordings,
    and repeat. Needs a field whose gains have a posterior, as all but `--gain-model network` have.
    """

    field: FieldFile
    count: int = 5
    """Number of contacts."""
    candidates: OtherCapture = None
    """Suggest among the contacts of this capture. By default: all of the surface that a straight hammer of 10 mm
    reaches from outside, at most 45 degrees from perpendicular."""
    unseen: Flag = False
    """Suggest on all of the body's surface, also where no photograph shows it, such as the side that it stood on."""
    output: PictureFolder = None
    """Folder for suggested.csv, the list of contacts, and suggested.png, the contacts on the object."""

    def _check(self) -> None:
        if self.unseen and self.candidates is not None:
            raise FitError.expected("no --candidates with it", got="both", name="--unseen", advice="leave one out")
        if self.candidates is not None:
            expect_capture(self.candidates)


def run(options: Options) -> int:
    """Suggest, print and draw."""
    from avmsf.capture import read_capture
    from avmsf.field.next_contacts import suggest
    from avmsf.field.store import load

    field = load(options.field)
    names: tuple[str, ...] | None = None
    straight = ", as nearly perpendicular to the surface as can be reached"
    doing("choosing the contacts")
    if options.candidates is None:
        found = suggest(field, options.count, unseen=options.unseen, progress=False)
    else:
        impacts = read_capture(options.candidates).impacts
        found = suggest(
            field, options.count, candidates=impacts.contacts, directions=impacts.directions, progress=False
        )
        straight = straight if impacts.directions is None else ""
        names = tuple(impacts.names[row] for row in found.rows.tolist())
    columns: dict[str, Any] = {"order": range(1, len(found.contacts) + 1)}
    columns |= {} if names is None else {"recording": names}
    columns |= dict(zip("xyz", found.contacts.T.tolist(), strict=True))
    columns |= (
        {} if found.directions is None else dict(zip(("nx", "ny", "nz"), found.directions.T.tolist(), strict=True))
    )
    columns["error_after"] = found.after
    rows = list(zip(*columns.values(), strict=True))
    # What rounds to zero from below would have a sign.
    cells = [[f"{round(each, 4) + 0.0:.4f}" if isinstance(each, float) else each for each in row] for row in rows]
    headings = {"order": "", "x": "x (m)", "y": "y (m)", "z": "z (m)", "error_after": "after"}
    title = f"where to record next: uncertainty of the gains now {format_number(found.before)}"
    lines = [table(title, [headings.get(each, each) for each in columns], cells, words=1 + (names is not None))]
    error = "" if field.quality is None else f", {format_number(field.quality.error)}"
    lines.append(
        "uncertainty: by the field's posterior, relative to the energy of the gains (0 certain, 1 silence); it only "
        f"ranks contacts. What counts is the error of sounds by leave-one-out{error} (avmsf info)"
    )
    if len(rows) < options.count:
        lines.append(f"{options.count} asked for: no other candidate is without a recording")
    if found.unreachable:
        lines.append(f"left out: {counted(found.unreachable, 'position')} that no hammer reaches from outside")
    if found.directions is not None:
        lines.append(f"nx, ny, nz: direction of the impact{straight}")
        below = [str(order) for order, upward in enumerate(found.directions[:, 2].tolist(), 1) if upward > _UPWARD]
        if below:
            lines.append(f"from below, where z is up: {', '.join(below)}; turn the object, or leave these out")
    show("\n".join(lines))
    if options.output is not None:
        _write(options.output, field, found, [list(columns), *rows])
    suggestions = [dict(zip(columns, row, strict=True)) for row in rows]
    results = {"error_before": found.before, "unreachable": found.unreachable, "suggestions": suggestions}
    values = {"capture": field.origin.capture, **results}
    return finish("", values, "record these, then avmsf fit CAPTURE -o NEW.safetensors")


def _write(folder: Path, field: "SoundField", found: "Suggestions", rows: Sequence[Sequence[Any]]) -> None:
    """Write the list of contacts, and draw them on the object with the uncertainty of its gains."""
    from avmsf._utils.files import write_whole
    from avmsf.plotting.pictures import save_picture
    from avmsf.plotting.uncertainty import draw_uncertainty

    digits = [[f"{each:.6g}" if isinstance(each, float) else each for each in row] for row in rows]
    write_whole(folder / TABLE, csv_text(digits))
    points = field.gain_field.points[:: max(1, len(field.gain_field.points) // _DRAWN_POINTS)]
    picture = draw_uncertainty(
        points,
        field.relative_gain_std(points),
        title=f"{field.origin.capture or 'field'}: uncertainty, and where to record next",
        contacts=field.gain_field.contacts,
        suggested=found.contacts,
        directions=found.directions,
    )
    save_picture(picture, folder / PICTURE)
    say(f"wrote {TABLE} and {PICTURE} in {folder}")
