"""`avmsf render`: the sounds of impacts anywhere on the object."""

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from avmsf.cli.options import Common, Flag, Number, Unit
from avmsf.cli.output import command, doing, finish, note
from avmsf.cli.paths import ContactTable, FieldFile, New, OutputError, PositionList, expect_free, expect_writable
from avmsf.errors import PositionWarning
from avmsf.modal.config import MAX_CONTACT_SECONDS, PulseShape

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

_LOW_LEVEL_DBFS = -20.0
"""Peak in decibels of full scale below which sounds are noted as quiet."""
Coding = Literal["float32", "int16"]


@dataclass(frozen=True)
class Options(Common):
    """Write the sounds of impacts anywhere on the object as wav files.

    Contacts come from --position, once per contact, or from a table with the columns x,y,z and optionally file and
    nx,ny,nz, such as a capture's impacts.csv. An impact without a direction is perpendicular to the surface.
    """

    field: FieldFile
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER|FILE.wav"), New((".wav",), or_folder=True)]
    """Folder for the sounds; for one contact also a wav file."""
    position: PositionList = ()
    """A contact in the object's frame; once for each."""
    direction: PositionList = ()
    """Direction of the impact at each --position, in the same order."""
    contact_table: ContactTable = None
    """Table of contacts, in which a direction may be empty."""
    unit: Unit = "m"
    """Unit of the coordinates; the field is in meters."""
    force: Number = None
    """Peak force, newtons; relative where the field knows no forces. Without it, as the recordings on average: divided
    by their forces where these are known."""
    contact_time: float = 0.0
    """Of a softer hammer of the same impulse, seconds: .002 for felt."""
    pulse: PulseShape = "half-sine"
    """Force over the contact time; hertz: of two round bodies."""
    no_noise: Flag = False
    """Write the modes without the residual noise."""
    seconds: Number = None
    """Length; by default that of the training sounds."""
    normalize: Literal["none", "peak"] = "none"
    """peak: all sounds times one factor, the loudest at full scale."""
    level_db: float = 0.0
    """Additional gain in dB."""
    coding: Coding = "float32"
    """Format of the samples; int16 rejects what would clip."""
    overwrite: Flag = False
    """Replace files."""

    def _check(self) -> None:
        if bool(self.position) == (self.contact_table is not None):
            wanted = "contacts by it, X Y Z, once or more, or by --contact-table TABLE.csv"
            raise OutputError.expected(wanted, len(self.position), name="--position")
        if self.direction and len(self.direction) != len(self.position):
            wanted = f"one for each of {len(self.position)} --position"
            raise OutputError.expected(wanted, len(self.direction), name="--direction")
        if self.force is not None and not 0 < self.force < math.inf:
            advice = "--direction says which way it acts"
            raise OutputError.expected("a finite force above 0", self.force, name="--force", advice=advice)
        if not 0 <= self.contact_time <= MAX_CONTACT_SECONDS:
            wanted = f"seconds from 0 to {MAX_CONTACT_SECONDS:g}"
            raise OutputError.expected(wanted, self.contact_time, name="--contact-time")
        if not abs(self.level_db) <= 200:
            raise OutputError.expected("decibels from -200 to 200", self.level_db, name="--level-db")


def run(options: Options) -> int:
    """Render and write."""
    from avmsf.cli.contacts import contacts_on
    from avmsf.field.store import load
    from avmsf.modal.modes import ForcePulse

    field, positions, table = load(options.field), options.position, options.contact_table
    contacts = contacts_on(field, positions, table, unit=options.unit, directions=options.direction)
    paths = _paths(options.output, contacts.names, overwrite=options.overwrite)
    if options.force not in (None, 1) and not field.origin.per_newton:
        note(f"the forces are not known: {options.force:g} is relative to an average recorded impact")
    if options.force is not None and not options.no_noise and (average := field.residual.force):
        level = f"{average:.3g} {'N' if field.origin.per_newton else 'times the average force'}"
        note(f"the noise does not depend on the force: it is that of an impact of {level}; --no-noise leaves it out")
    if round(field.sample_rate) != field.sample_rate:
        note(f"the wav files have {round(field.sample_rate)} Hz for {field.sample_rate:g} Hz")
    doing("rendering")
    with warnings.catch_warnings():
        # The notes have said it, with the names of the sounds.
        warnings.simplefilter("ignore", PositionWarning)
        sounds = field.render(
            contacts.places,
            contacts.directions,
            options.force,
            samples=None if options.seconds is None else _samples(options.seconds, field.sample_rate),
            pulse=ForcePulse(options.contact_time, options.pulse) if options.contact_time else None,
            noise=not options.no_noise,
        )
    by_peak = options.normalize == "peak"
    sounds = sounds * (
        peak_factor(sounds, level_db=options.level_db, coding=options.coding)
        if by_peak
        else 10 ** (options.level_db / 20)
    )
    peak = float(sounds.abs().max())
    peak_dbfs = 20 * math.log10(peak) if peak > 0 else -math.inf
    if options.coding == "float32" and peak_dbfs > 0:
        over = f"the loudest sound peaks at {peak_dbfs:+.1f} dB over full scale and will clip"
        note(f"{over}; add --normalize peak, or lower --level-db")
    elif not by_peak and -math.inf < peak_dbfs < _LOW_LEVEL_DBFS:
        note(f"the loudest sound peaks at {peak_dbfs:.1f} dBFS, which is quiet; add --normalize peak")
    for path, sound in zip(paths, sounds, strict=True):
        write_sound(path, sound, sample_rate=field.sample_rate, coding=options.coding)
    wrote = paths[0] if len(paths) == 1 else f"{len(paths)} sounds to {options.output}"
    seconds = sounds.shape[1] / field.sample_rate
    text = (
        f"wrote {wrote}: {seconds:.3g} s at {field.sample_rate:g} Hz, {options.coding}, "
        # The sum makes 0.0 of -0.0.
        f"peak {round(peak_dbfs, 1) + 0.0:.1f} dBFS"
    )
    values = {"files": list(map(str, paths)), "sample_rate": field.sample_rate, "seconds": seconds}
    values |= {"peak": peak, "peak_dbfs": peak_dbfs}
    return finish(text, values, command("avmsf export", options.field, "--to web -o page.html"))


def _samples(seconds: float, rate: float) -> int:
    from avmsf.capture.audio import MAX_SAMPLES

    samples = round(seconds * rate) if math.isfinite(seconds) else 0
    if not 1 <= samples <= MAX_SAMPLES:
        raise OutputError.expected(f"more than 0 and at most {MAX_SAMPLES / rate:g} s", seconds, name="--seconds")
    return samples


def _paths(output: Path, names: tuple[str, ...], *, overwrite: bool) -> list[Path]:
    """Return the files of the sounds. Raises OutputError for one file of several, and where one cannot be written."""
    paths = [output / name for name in names]
    if output.suffix.lower() == ".wav" and not output.is_dir():
        if len(names) > 1:
            wanted, got = f"a folder for {len(names)} contacts", "the name of a file"
            raise OutputError.expected(wanted, len(names), got=got, file=output)
        paths = [output]
    for path in paths:
        expect_writable(path)
        expect_free(path, overwrite=overwrite)
    return paths


def peak_factor(
    sounds: "Float[Tensor, 'contacts samples']", *, level_db: float = -1.0, coding: Coding = "float32"
) -> float:
    """Return the one factor on all sounds by which the loudest peaks at a level against full scale, dB."""
    peak = float(sounds.abs().max())
    full = 1.0 if coding == "float32" else (2**15 - 1) / 2**15
    return 10 ** (level_db / 20) * (full / peak if peak > 0 else 1.0)


def write_sound(
    path: Path, sound: "Float[Tensor, ' samples']", *, sample_rate: float, coding: Coding = "float32"
) -> None:
    """Write a mono wav file. Raises ArrayError as `wav_bytes`."""
    from avmsf._utils.files import write_whole
    from avmsf.capture.audio import wav_bytes

    write_whole(path, wav_bytes(sound.numpy(), round(sample_rate), coding=coding, file=path))
