"""`avmsf modes`: the modes that a capture's recordings have in common."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import tyro

from avmsf.bench.pictures import draw_modes, expect_format, save_picture
from avmsf.capture import CaptureSettings, read_capture
from avmsf.cli.modetable import ModeRow, amplitudes, heard_in, levels, mode_rows
from avmsf.cli.printing import console, decimals, figure, print_json, say, table
from avmsf.modal.extraction.extract import extract
from avmsf.modal.extraction.finders import HighResolution, ModeFinder, ShortTime

Method = Literal["high-resolution", "short-time"]


@dataclass(frozen=True)
class Options:
    """List the modes that a capture's recordings have in common."""

    capture: tyro.conf.Positional[Path]
    """Folder with impacts.csv and the wav files it names."""
    method: Method = "high-resolution"
    """high-resolution: matrix pencils in subbands, which part modes a few hertz apart. short-time: the paper's, bin by
    bin of a short-time spectrum."""
    modes: int = 128
    """Most modes to keep."""
    settings: Path | None = None
    """A capture.toml to use in place of the folder's own."""
    json: bool = False
    """Print one JSON object on the standard output, all else on the standard error."""
    picture: Path | None = None
    """Where to draw the modes as stems: a file that ends in .png, .pdf or .svg."""


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return tyro.cli(Options, prog="avmsf modes", args=words, config=(tyro.conf.FlagCreatePairsOff,))


def run(options: Options) -> int:
    """Print the modes."""
    if options.picture is not None:
        expect_format(options.picture)
    settings = None if options.settings is None else CaptureSettings.read(options.settings)
    capture = read_capture(options.capture, settings)
    impacts = capture.impacts
    say(f"finding the modes of {len(impacts)} recordings, {impacts.duration:.3g} s at {impacts.sample_rate:g} Hz")
    extraction = extract(impacts, finder(options.method, options.modes))
    level = levels(amplitudes(extraction))
    rows = mode_rows(extraction.bank, level)
    heard = heard_in(extraction, sample_rate=impacts.sample_rate, samples=impacts.sounds.shape[1])
    title = f"{len(rows)} modes of {capture.name}, {len(impacts)} recordings"
    console(errors=options.json).print(mode_table(title, rows, heard=[f"{count}/{len(impacts)}" for count in heard]))
    if options.picture is not None:
        save_picture(draw_modes(extraction.bank, level, title=title), options.picture)
        say(f"wrote {options.picture}")
    if options.json:
        print_json(
            {
                "capture": capture.name,
                "recordings": len(impacts),
                "sample_rate": impacts.sample_rate,
                "seconds": impacts.duration,
                "method": options.method,
                "modes": [asdict(row) | {"heard_in": count} for row, count in zip(rows, heard, strict=True)],
            }
        )
    return 0


def finder(method: Method, modes: int) -> ModeFinder:
    """Return the method of that name, which keeps at most so many modes."""
    return HighResolution(modes=modes) if method == "high-resolution" else ShortTime(modes=modes)


def mode_table(title: str, rows: Sequence[ModeRow], *, heard: Sequence[str] | None = None) -> object:
    """Return the modes for printing, with the numbers of recordings that `heard` gives."""
    columns = ["", "frequency Hz", "damping 1/s", "T60 s", "level dB"]
    cells = [
        [
            str(number),
            decimals(row.frequency_hertz, 2),
            figure(row.damping_per_second),
            figure(row.t60_seconds),
            decimals(row.level_db, 1),
        ]
        for number, row in enumerate(rows, start=1)
    ]
    if heard is not None:
        columns.append("heard in")
        cells = [[*cell, count] for cell, count in zip(cells, heard, strict=True)]
    return table(title, columns, cells)
