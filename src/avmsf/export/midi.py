"""Notes of MIDI files and keyboards."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avmsf.errors import PlayerError


@dataclass(frozen=True)
class Note:
    """A key struck."""

    number: int
    """0 to 127; 60 is the middle C."""
    velocity: int
    """How hard, 1 to 127."""
    seconds: float
    """When, from the file's beginning, or from when listening began."""


def read_midi(path: Path) -> list[Note]:
    """Return the notes struck in a file, of all its tracks and channels, in order.

    Raises `PlayerError` for a file that is missing, no MIDI, or without notes, and where mido is missing.
    """
    mido = _mido()
    if not path.is_file():
        raise PlayerError(f"{path}: expected a MIDI file, found none: check the name")
    notes, seconds = [], 0.0
    try:
        for message in mido.MidiFile(str(path)):
            seconds += message.time
            if message.type == "note_on" and message.velocity > 0:
                notes.append(Note(message.note, message.velocity, seconds))
    except (OSError, EOFError, ValueError, KeyError, TypeError, IndexError) as error:
        raise PlayerError(
            f"{path}: this is no MIDI file that can be read ({str(error) or 'it ends too soon'})"
        ) from error
    if not notes:
        raise PlayerError(f"{path}: expected notes, found a MIDI file without any")
    return notes


@contextmanager
def listen(wanted: str, hear: Callable[[Note], None]) -> Iterator[str]:
    """Call `hear` from another thread with each note of the input whose name holds `wanted`; yields the name.

    Raises `PlayerError` where there is no such input, or no MIDI at all.
    """
    mido = _mido()
    try:
        names = list(mido.get_input_names())
    except Exception as error:  # each backend has its own errors, and none is documented
        raise PlayerError(f"no MIDI input can be opened here ({error}): use a MIDI file, or random blows") from error
    name = next((each for each in names if wanted.lower() in each.lower()), None)
    if name is None:
        found = ", ".join(names) or "none"
        raise PlayerError(f"expected a MIDI input named like {wanted!r}, found {found}: name one of them, or a file")
    begun = time.monotonic()

    def receive(message: Any) -> None:
        if message.type == "note_on" and message.velocity > 0:
            hear(Note(message.note, message.velocity, time.monotonic() - begun))

    with mido.open_input(name, callback=receive):
        yield name


def _mido() -> Any:
    try:
        import mido
    except ImportError as error:
        raise PlayerError("MIDI needs mido and python-rtmidi: run pip install 'avmsf[play]'") from error
    return mido
