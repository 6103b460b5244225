"""`avmsf suggest`: where to record next, as a table, a list and a figure."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import tyro

from avmsf._utils.text import counted, format_number
from avmsf.cli.common import Flag, Printing, expect_capture
from avmsf.cli.paths import FieldFile, OtherCapture, OutputFolder, SettingsFile
from avmsf.cli.printing import doing, next_step, print_json, say, show, table
from avmsf.errors import FitError

if TYPE_CHECKING:
    from avmsf.field.next_contacts import Suggestions

TABLE, PICTURE = "suggested.csv", "suggested.png"
"""What the folder of results holds."""
_DRAWN_POINTS = 4000


@dataclass(frozen=True)
class Options(Printing):
    """Suggest where to record next: the contacts that reduce the expected error of the field most.

    Each suggestion assumes that those before it are recorded: record them in this order, fit again with all recordings,
    and repeat. Needs a field whose gains have a posterior, as all but `--gain-model network` have.
    """

    field: tyro.conf.Positional[FieldFile]
    """Field file, as `avmsf fit` writes it."""
    count: int = 5
    """Number of contacts."""
    candidates: OtherCapture = None
    """Suggest among the contacts of this capture. By default: all of the surface that a straight hammer of 10 mm
    reaches from outside, at most 45 degrees from perpendicular."""
    unseen: Flag = False
    """Suggest on all of the body's surface, also where no photograph shows it, such as the side that it stood on."""
    settings: SettingsFile = None
    """Use this capture.toml instead of the candidates' own."""
    output: OutputFolder = None
    """Folder for suggested.csv, the list of contacts, and suggested.png, the contacts on the object."""

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        if self.settings is not None and self.candidates is None:
            raise FitError.expected("--candidates with it", name="--settings", advice="leave it out")
        if self.unseen and self.candidates is not None:
            raise FitError.expected("no --candidates with it", got="both", name="--unseen", advice="leave one out")
        if self.candidates is not None:
            expect_capture(self.candidates, self.settings)


def run(options: Options) -> int:
    """Suggest, print and draw."""
    from avmsf._utils.files import write_whole
    from avmsf.capture import CaptureSettings, read_capture
    from avmsf.field.next_contacts import suggest
    from avmsf.field.posterior import relative_gain_std
    from avmsf.field.store import load
    from avmsf.plotting.pictures import save_picture
    from avmsf.plotting.uncertainty import draw_uncertainty

    paths = {} if options.output is None else {name: options.output / name for name in (TABLE, PICTURE)}
    field = load(options.field)
    gains = field.gain_field
    names: tuple[str, ...] | None = None
    given = False
    doing("choosing the contacts")
    if options.candidates is None:
        found = suggest(field, options.count, unseen=options.unseen, progress=False)
    else:
        settings = None if options.settings is None else CaptureSettings.read(options.settings)
        impacts = read_capture(options.candidates, settings).impacts
        found = suggest(
            field, options.count, candidates=impacts.contacts, directions=impacts.directions, progress=False
        )
        given = impacts.directions is not None
        names = tuple(impacts.names[row] for row in found.rows.tolist())
    rows = _rows(found, names)
    lines = _lines(found, rows)
    if found.directions is not None:
        straight = "" if given else ", as nearly perpendicular to the surface as can be reached"
        lines.append(f"nx, ny, nz: direction of the impact{straight}")
    show("\n".join(lines), json=options.json)
    if paths:
        write_whole(paths[TABLE], _list(rows))
        doing("drawing the uncertainty")
        step = max(1, len(gains.points) // _DRAWN_POINTS)
        points = gains.points[::step]
        picture = draw_uncertainty(
            points,
            relative_gain_std(field, points),
            title=f"{field.origin.capture or 'field'}: uncertainty, and where to record next",
            contacts=gains.contacts,
            suggested=found.contacts,
            directions=found.directions,
        )
        save_picture(picture, paths[PICTURE])
        for path in paths.values():
            say(f"wrote {path}")
    next_step("record these, then avmsf fit CAPTURE -o NEW.safetensors")
    if options.json:
        print_json(
            {
                "capture": field.origin.capture,
                "error_before": found.before,
                "unreachable": found.unreachable,
                "suggestions": rows,
            }
        )
    return 0


def _lines(found: "Suggestions", rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the suggested contacts with their errors, and how many positions were left out."""
    title = f"where to record next: uncertainty of the gains now {format_number(found.before)}"
    headings = {"order": "", "x": "x (m)", "y": "y (m)", "z": "z (m)", "error_after": "after"}
    columns = [headings.get(name, name) for name in rows[0]]
    cells = [[_cell(value) for value in row.values()] for row in rows]
    lines = [
        table(title, columns, cells, words=1 + ("recording" in columns)),
        "uncertainty: by the field's posterior, relative to the energy of the gains; 0 = certain, 1 = silence. The "
        "error of sounds is measured by leave-one-out, and that value is the one to rely on (avmsf info)",
    ]
    if found.unreachable:
        lines.append(f"left out: {counted(found.unreachable, 'position')} that no hammer reaches from outside")
    return lines


def _rows(found: "Suggestions", names: Sequence[str] | None) -> list[dict[str, Any]]:
    """Return a dictionary a contact, with the columns of tables of contacts."""
    rows = []
    for number, (contact, after) in enumerate(zip(found.contacts.tolist(), found.after, strict=True)):
        row: dict[str, Any] = {"order": number + 1}
        if names is not None:
            row["recording"] = names[number]
        row |= dict(zip("xyz", contact, strict=True))
        if found.directions is not None:
            row |= dict(zip(("nx", "ny", "nz"), found.directions[number].tolist(), strict=True))
        rows.append(row | {"error_after": after})
    return rows


def _cell(value: Any) -> str:
    # What rounds to zero from below would have a sign.
    return f"{round(value, 4) + 0.0:.4f}" if isinstance(value, float) else str(value)


def _list(rows: Sequence[dict[str, Any]]) -> str:
    words = io.StringIO()
    writer = csv.DictWriter(words, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: f"{each:.6g}" if isinstance(each, float) else each for name, each in row.items()})
    return words.getvalue()
