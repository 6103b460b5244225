"""`avmsf render`: the sounds of impacts anywhere on the object."""

import math
import warnings
from functools import partial
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from avmsf.capture.audio import MAX_SAMPLES
from avmsf.cli.contacts import Contacts, given_contacts, note_off, refuse_far
from avmsf.cli.heartbeat import doing
from avmsf.cli.options.checks import OutputError, expect_writable
from avmsf.cli.options.render import Options
from avmsf.cli.printing import next_command, print_result, say
from avmsf.cli.writing import Level, write_sound
from avmsf.errors import PositionWarning
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load
from avmsf.modal.modes import ForcePulse

_MUCH_SOFTER = 20.0
"""Decibels below the recorded impact from which a softer hammer's sound is noted."""
_LOW_LEVEL_DBFS = -20.0
"""Peak in decibels of full scale below which sounds are noted as quiet."""


def run(options: Options) -> int:
    """Render and write."""
    contacts = given_contacts(options.position, options.contact_table, unit=options.unit, directions=options.direction)
    paths = _paths(options.output, contacts)
    field = load(options.field)
    refuse_far(contacts, field, advice=", see --unit")
    note_off(contacts, field)
    if options.force != 1 and not field.origin.per_newton:
        say(f"note: the forces are not known: {options.force:g} is relative to an average recorded impact")
    if round(field.sample_rate) != field.sample_rate:
        say(f"note: the wav files have {round(field.sample_rate)} Hz for {field.sample_rate:g} Hz")
    doing("rendering")
    pulse = _pulse(options)
    rendered = partial(render_sounds, field, force=options.force, seconds=options.seconds, noise=not options.no_noise)
    sounds = rendered(contacts.places, contacts.directions, pulse=pulse)
    softer = 0.0
    if pulse is not None and options.normalize == "none" and options.level_db == 0:
        loudest = int(sounds.abs().amax(1).argmax())
        place = contacts.places[loudest : loudest + 1]
        way = None if contacts.directions is None else contacts.directions[loudest : loudest + 1]
        hard = rendered(place, way)
        softer = _softer(hard[0], sounds[loudest])
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


def _softer(hard: Float[Tensor, " samples"], soft: Float[Tensor, " samples"]) -> float:
    """Return by how many decibels a softer hammer lowers the recorded impact's peak; 0 where that is not known."""
    loud, low = (float(each.abs().max()) for each in (hard, soft))
    return 20 * math.log10(loud / low) if loud > 0 and low > 0 else 0.0


def _say_level(peak_dbfs: float, softer: float, options: Options) -> None:
    """Print that the loudest sound clips, or that it is quiet, and why where it is the softer hammer."""
    if options.coding == "float32" and peak_dbfs > 0:
        say(
            f"note: the loudest sound peaks at {peak_dbfs:+.1f} dB over full scale and will clip; add --normalize "
            "peak, or lower --level-db"
        )
    elif softer > _MUCH_SOFTER:
        say(
            f"note: a contact time of {1e3 * options.contact_time:.3g} ms lowers the peak by {softer:.0f} dB; add "
            "--normalize peak or --level-db, or a shorter --contact-time"
        )
    elif options.normalize == "none" and -math.inf < peak_dbfs < _LOW_LEVEL_DBFS:
        say(f"note: the loudest sound peaks at {peak_dbfs:.1f} dBFS, which is quiet; add --normalize peak")


def render_sounds(
    field: SoundField,
    places: Float[Tensor, "contacts 3"],
    directions: Float[Tensor, "contacts 3"] | None = None,
    *,
    force: float,
    seconds: float | None,
    pulse: ForcePulse | None = None,
    noise: bool = True,
) -> Float[Tensor, "contacts samples"]:
    """Render impacts of `force` for `seconds`; raises `OutputError` for a time of less than a sample."""
    samples = None if seconds is None else _samples(seconds, field)
    with warnings.catch_warnings():
        # The notes have said it, with the names of the sounds.
        warnings.simplefilter("ignore", PositionWarning)
        return field.render(places, directions=directions, forces=force, samples=samples, pulse=pulse, noise=noise)


def _samples(seconds: float, field: SoundField) -> int:
    samples = round(seconds * field.sample_rate) if math.isfinite(seconds) else 0
    if not 1 <= samples <= MAX_SAMPLES:
        raise OutputError.expected(
            f"more than 0 and at most {MAX_SAMPLES / field.sample_rate:g} s", seconds, name="--seconds"
        )
    return samples


def _pulse(options: Options) -> ForcePulse | None:
    return ForcePulse(options.contact_time, options.pulse) if options.contact_time else None


def _paths(output: Path, contacts: Contacts) -> list[Path]:
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
