"""`avmsf render`: the sounds of impacts anywhere on the object."""

import math
import warnings
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from avmsf.cli.common import Flag, Printing, Unit
from avmsf.cli.paths import ContactTable, FieldFile, NewFile, OutputError, PositionList, expect_writable
from avmsf.cli.printing import doing, next_command, note, print_result
from avmsf.errors import PositionWarning
from avmsf.modal.config import PulseShape
from avmsf.simulate.recipe import MAX_CONTACT_SECONDS

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from avmsf.cli.contacts import Contacts
    from avmsf.field.sound_field import SoundField
    from avmsf.modal.modes import ForcePulse

_MUCH_SOFTER = 20.0
"""Decibels below the recorded impact from which a softer hammer's sound is noted."""
_LOW_LEVEL_DBFS = -20.0
"""Peak in decibels of full scale below which sounds are noted as quiet."""
Coding = Literal["float32", "int16"]


@dataclass(frozen=True)
class Options(Printing):
    """Write the sounds of impacts anywhere on the object as wav files.

    Contacts come from --position, once per contact, or from a table with the columns x,y,z and optionally file and
    nx,ny,nz, such as a capture's impacts.csv. An impact without a direction is perpendicular to the surface.
    """

    field: tyro.conf.Positional[FieldFile]
    """Field file, as `avmsf fit` writes it."""
    output: Annotated[
        Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER|FILE.wav"), NewFile((".wav",), or_folder=True)
    ]
    """Folder for the sounds; for a single contact also a file that ends in .wav."""
    position: PositionList = ()
    """A contact in the object's frame."""
    direction: PositionList = ()
    """Direction of the impact at each --position, in the same order."""
    contact_table: ContactTable = None
    """Table of contacts. In it, a direction that is empty or 0,0,0 is not known."""
    unit: Unit = "m"
    """Unit of the coordinates; the field is in meters."""
    force: float = 1.0
    """Peak force, in newtons if the field knows forces, otherwise relative to an average recorded impact."""
    contact_time: float = 0.0
    """Contact time of a softer hammer of the same impulse, seconds: 0.002 for felt. 0: as recorded."""
    pulse: PulseShape = "half-sine"
    """Force over the contact time: of a linear contact, or of two round bodies (Hertz)."""
    no_noise: Flag = False
    """Write the modes without the residual noise."""
    seconds: float | None = None
    """Length of the sounds; by default that of the training sounds."""
    normalize: Literal["none", "peak"] = "none"
    """none: the scale of the recordings. peak: all sounds times one factor, the loudest at full scale."""
    level_db: float = 0.0
    """Additional gain in dB."""
    coding: Coding = "float32"
    """Format of the samples; int16 rejects sounds that would clip."""

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        if bool(self.position) == (self.contact_table is not None):
            wanted = "contacts by it, X Y Z, once or more, or by --contact-table TABLE.csv"
            raise OutputError.expected(wanted, len(self.position), name="--position")
        if self.direction and len(self.direction) != len(self.position):
            wanted = f"one for each of {len(self.position)} --position"
            raise OutputError.expected(wanted, len(self.direction), name="--direction")
        for row, place in enumerate(self.position):
            if not all(map(math.isfinite, place)):
                raise OutputError.expected("finite coordinates", list(place), row=row, name="--position")
        for row, way in enumerate(self.direction):
            if not (any(way) and all(map(math.isfinite, way))):
                advice = "leave out --direction for impacts perpendicular to the surface"
                raise OutputError.expected(
                    "a direction other than 0 0 0", list(way), row=row, name="--direction", advice=advice
                )
        if not math.isfinite(self.level_db):
            raise OutputError.expected("a finite number", self.level_db, name="--level-db")
        if not 0 < self.force < math.inf:
            advice = "--direction says which way it acts"
            raise OutputError.expected("a finite force above 0", self.force, name="--force", advice=advice)
        if not 0 <= self.contact_time <= MAX_CONTACT_SECONDS:
            raise OutputError.expected(
                f"seconds from 0 to {MAX_CONTACT_SECONDS:g}", self.contact_time, name="--contact-time"
            )
        if self.seconds is not None and not 0 < self.seconds < math.inf:
            raise OutputError.expected("more than 0", self.seconds, name="--seconds")


def run(options: Options) -> int:
    """Render and write."""
    from avmsf.cli.contacts import given_contacts, note_off, refuse_far
    from avmsf.cli.writing import Level, write_sound
    from avmsf.field.store import load
    from avmsf.modal.modes import ForcePulse

    contacts = given_contacts(options.position, options.contact_table, unit=options.unit, directions=options.direction)
    paths = _paths(options.output, contacts)
    field = load(options.field)
    refuse_far(contacts, field, advice=", see --unit")
    note_off(contacts, field)
    if options.force != 1 and not field.origin.per_newton:
        note(f"the forces are not known: {options.force:g} is relative to an average recorded impact")
    if round(field.sample_rate) != field.sample_rate:
        note(f"the wav files have {round(field.sample_rate)} Hz for {field.sample_rate:g} Hz")
    doing("rendering")
    pulse = ForcePulse(options.contact_time, options.pulse) if options.contact_time else None
    rendered = partial(render_sounds, field, force=options.force, seconds=options.seconds, noise=not options.no_noise)
    sounds = rendered(contacts.places, contacts.directions, pulse=pulse)
    softer = 0.0
    if pulse is not None and options.normalize == "none" and options.level_db == 0:
        loudest = int(sounds.abs().amax(1).argmax())
        place = contacts.places[loudest : loudest + 1]
        way = None if contacts.directions is None else contacts.directions[loudest : loudest + 1]
        peaks = [float(each.abs().max()) for each in (rendered(place, way), sounds[loudest])]
        softer = 20 * math.log10(peaks[0] / peaks[1]) if min(peaks) > 0 else 0.0
    sounds = sounds * Level(options.normalize, options.level_db).factor(sounds, coding=options.coding)
    peak = float(sounds.abs().max())
    peak_dbfs = 20 * math.log10(peak) if peak > 0 else -math.inf
    _say_level(peak_dbfs, softer, options)
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
    print_result(text, {**values, "peak": peak, "peak_dbfs": peak_dbfs}, json=options.json)
    next_command("avmsf export", options.field, "--to web -o page")
    return 0


def _say_level(peak_dbfs: float, softer: float, options: Options) -> None:
    """Print that the loudest sound clips, or that it is quiet, and why where it is the softer hammer."""
    if options.coding == "float32" and peak_dbfs > 0:
        note(
            f"the loudest sound peaks at {peak_dbfs:+.1f} dB over full scale and will clip; add --normalize "
            "peak, or lower --level-db"
        )
    elif softer > _MUCH_SOFTER:
        note(
            f"a contact time of {1e3 * options.contact_time:.3g} ms lowers the peak by {softer:.0f} dB; add "
            "--normalize peak or --level-db, or a shorter --contact-time"
        )
    elif options.normalize == "none" and -math.inf < peak_dbfs < _LOW_LEVEL_DBFS:
        note(f"the loudest sound peaks at {peak_dbfs:.1f} dBFS, which is quiet; add --normalize peak")


def render_sounds(
    field: "SoundField",
    places: "Float[Tensor, 'contacts 3']",
    directions: "Float[Tensor, 'contacts 3'] | None" = None,
    *,
    force: float,
    seconds: float | None,
    pulse: "ForcePulse | None" = None,
    noise: bool = True,
) -> "Float[Tensor, 'contacts samples']":
    """Render impacts of `force` for `seconds` at contacts.

    Raises `OutputError` for a time of less than a sample.
    """
    samples = None if seconds is None else _samples(seconds, field)
    with warnings.catch_warnings():
        # The notes have said it, with the names of the sounds.
        warnings.simplefilter("ignore", PositionWarning)
        return field.render(places, directions=directions, forces=force, samples=samples, pulse=pulse, noise=noise)


def _samples(seconds: float, field: "SoundField") -> int:
    from avmsf.capture.audio import MAX_SAMPLES

    samples = round(seconds * field.sample_rate) if math.isfinite(seconds) else 0
    if not 1 <= samples <= MAX_SAMPLES:
        raise OutputError.expected(
            f"more than 0 and at most {MAX_SAMPLES / field.sample_rate:g} s", seconds, name="--seconds"
        )
    return samples


def _paths(output: Path, contacts: "Contacts") -> list[Path]:
    if output.suffix.lower() == ".wav" and not output.is_dir():
        if len(contacts.names) > 1:
            wanted, count = f"a folder for {len(contacts.names)} contacts", len(contacts.names)
            raise OutputError.expected(wanted, count, got="the name of a file", file=output)
        expect_writable(output)
        return [output]
    paths = [output / name for name in contacts.names]
    for path in paths:
        expect_writable(path)
    return paths
