"""`avmsf play`: a field in real time, by MIDI or at random, through a sound device or into a file."""

import math
import queue
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro

from avmsf.cli.contacts import Contacts, contacts_at, refuse_far
from avmsf.cli.printing import print_text, say
from avmsf.cli.render import METRES
from avmsf.cli.writing import Coding, expect_writable, write_sound
from avmsf.errors import PlayerError
from avmsf.export.midi import Note, listen, read_midi
from avmsf.export.player import Blow, Keyboard, Keys, Player, bounce, endless_blows, measure_capacity
from avmsf.export.sampledfield import SampledField
from avmsf.field.soundfield import SoundField
from avmsf.field.store import load

_MIDI_FILES = (".mid", ".midi")
_RING_SECONDS = 2.0
"""What a MIDI file's last note is given to ring."""
_BOUNCED_SECONDS = 10.0
"""Of random blows in a file, where no length is asked for."""


@dataclass(frozen=True)
class Options:
    """Play a field in real time, or write what would be played to a file.

    Blows fall at random, or come from a MIDI keyboard or file: with `--keys contacts` each key strikes another contact,
    with `--keys pitch` all keys strike one, at other pitches. How hard a key is struck is the force. What is louder
    than full scale is turned down at once and comes back slowly; all else sounds exactly as rendered.
    """

    field: tyro.conf.Positional[Path]
    """Field file, as `avmsf fit` writes it."""
    bounce: Path | None = None
    """Write a .wav instead of using a sound device, as fast as it goes."""
    seconds: float | None = None
    """How long to play. Without it until Ctrl-C, 10 s for random blows into a file, or to the end of a MIDI file."""
    midi: str | None = None
    """A MIDI file, or part of the name of a MIDI input; "" is the first input. Without it blows fall at random."""
    keys: Keys = "contacts"
    """What the keys of a MIDI keyboard are."""
    at: tuple[float, float, float] | None = None
    """The contact that `--keys pitch` strikes, in the object frame."""
    unit: Literal["m", "cm", "mm", "in", "ft"] = "m"
    """What the coordinates of `--at` count."""
    blows: float = 4.0
    """Random blows a second."""
    seed: int = 0
    """Of the random blows."""
    contact_time: float = 0.0
    """How long hammer and object touch, seconds, up to .1; 0 is the blow as it was recorded."""
    voices: int = 32
    """Most sets of resonators, and blows' noises, that sound at once; the faintest makes room."""
    level_db: float | None = None
    """Gain, dB. Without it the loudest blow of force 1 peaks at 12 dB below full scale."""
    points: int = 1000
    """Most contacts that can be struck, spread over the object."""
    device: str | None = None
    """Sound device, by number or part of its name; the system's own where it is not given."""
    block: int = 256
    """Samples in a block: fewer answer sooner, more are steadier."""
    coding: Coding = "float32"
    """How the file's samples are written."""


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return tyro.cli(Options, prog="avmsf play", args=words, config=(tyro.conf.FlagCreatePairsOff,))


def run(options: Options) -> int:
    """Play, or write."""
    _expect(options)
    whole = load(options.field)
    place = _place(options, whole)
    field = SampledField.of(whole, limit=options.points)
    if not len(field.frequency):
        raise PlayerError(f"{options.field}: expected modes that sound below half the sample rate, found none to play")
    level = None if options.level_db is None else 10 ** (options.level_db / 20)
    player = Player(field, voices=options.voices, level=level)
    row = None if place is None else int(field.nearest(place.places.float())[0])
    keyboard = Keyboard(field, keys=options.keys, row=row, contact_time=options.contact_time)
    capacity = measure_capacity(field, block=options.block)
    shared = f"; blows in one set of resonators: {capacity.blows:.0f} a second" if field.shared_damping else ""
    say(
        f"{len(field.frequency)} modes at {len(field)} contacts; voices at once in real time: {capacity.voices}{shared}"
    )
    if options.bounce is not None:
        return _bounce(player, keyboard, options)
    _play(player, keyboard, options)
    return 0


def _expect(options: Options) -> None:
    if options.bounce is not None:
        expect_writable(options.bounce)
        if options.bounce.suffix.lower() != ".wav":
            raise PlayerError(f"{options.bounce}: expected a name that ends in .wav")
        if options.midi is not None and Path(options.midi).suffix.lower() not in _MIDI_FILES:
            raise PlayerError(f"--midi {options.midi!r}: expected a MIDI file, .mid, where nothing is played live")
    if options.seconds is not None and not 0 < options.seconds < math.inf:
        raise PlayerError(f"--seconds is {options.seconds:g}; expected a time above 0")
    if not 0 <= options.contact_time <= 0.1:
        raise PlayerError(f"--contact-time is {options.contact_time:g}; expected 0 to .1 s")
    if not 16 <= options.block <= 1 << 16:
        raise PlayerError(f"--block is {options.block}; expected 16 to {1 << 16} samples")
    if options.level_db is not None and not math.isfinite(options.level_db):
        raise PlayerError(f"--level-db is {options.level_db}; expected a finite number")
    if options.keys == "pitch" and options.midi is None:
        raise PlayerError(
            "--keys pitch: random blows have no keys; name a MIDI file or input by --midi, or leave it out"
        )
    if options.at is not None and options.keys != "pitch":
        raise PlayerError("--at is the contact that --keys pitch strikes; add --keys pitch, or leave --at out")


def _place(options: Options, field: SoundField) -> Contacts | None:
    """Return the contact that all keys strike."""
    if options.at is None:
        return None
    if not all(map(math.isfinite, options.at)):
        raise PlayerError(f"--at is {' '.join(f'{value:g}' for value in options.at)}; expected finite numbers")
    place = Contacts(contacts_at([options.at], metres=METRES[options.unit]).places, ("--at",))
    refuse_far(place, field)
    return place


def _known_blows(player: Player, keyboard: Keyboard, options: Options) -> tuple[Iterator[Blow], float]:
    """Return blows that are known beforehand, from the first to the last, and how long they are to be heard, s."""
    rate = player.field.sample_rate
    if options.midi is None:
        blows = endless_blows(
            player.field, each_second=options.blows, seed=options.seed, contact_time=options.contact_time
        )
        return blows, math.inf if options.seconds is None else options.seconds
    notes = sorted(read_midi(Path(options.midi)), key=lambda note: note.seconds)
    length = options.seconds if options.seconds is not None else notes[-1].seconds + _RING_SECONDS
    return (keyboard.blow(each.number, each.velocity, start=round(each.seconds * rate)) for each in notes), length


def _bounce(player: Player, keyboard: Keyboard, options: Options) -> int:
    assert options.bounce is not None
    rate = player.field.sample_rate
    known, seconds = _known_blows(player, keyboard, options)
    samples = round((seconds if math.isfinite(seconds) else _BOUNCED_SECONDS) * rate)
    if samples < 1:
        raise PlayerError(f"--seconds is {options.seconds}; expected a time that holds a sample at {rate:g} Hz")
    blows = list(takewhile(lambda blow: blow.start < samples, known))
    begun = time.perf_counter()
    sound = bounce(player, blows, samples, block=options.block)
    taken = time.perf_counter() - begun
    write_sound(options.bounce, torch.from_numpy(sound), sample_rate=rate, coding=options.coding)
    print_text(
        f"wrote {options.bounce}: {len(blows)} blows, {samples / rate:.3g} s at {rate:g} Hz, {options.coding}, "
        f"{samples / rate / max(taken, 1e-9):.0f} times as fast as real time"
    )
    return 0


class _Live:
    """What the sound device's callback and the threads that hear of blows have in common."""

    def __init__(self, player: Player, known: Iterable[Blow] = ()) -> None:
        self.player = player
        self.coming: queue.SimpleQueue[Blow] = queue.SimpleQueue()
        self._known = iter(known)
        self._next = next(self._known, None)
        self.failed: list[BaseException] = []
        self.late = 0

    def fill(self, out: np.ndarray, frames: int, when: Any, status: Any) -> None:
        """Render one block into a device's buffer of one column or more."""
        try:
            self.late += bool(status)
            while not self.coming.empty():
                blow = self.coming.get()
                start = max(blow.start, self.player.now)
                self.player.strike(Blow(blow.row, blow.force, start, blow.contact_time, blow.ratio))
            # No more than are due: a callback has milliseconds, and blows at random have no end.
            while self._next is not None and self._next.start < self.player.now + frames:
                self.player.strike(self._next)
                self._next = next(self._known, None)
            out[:] = self.player.render(frames)[:, None]
        except Exception as error:
            out[:] = 0.0
            self.failed.append(error)


def _play(player: Player, keyboard: Keyboard, options: Options) -> None:
    devices = _sounddevice()
    file = options.midi is not None and Path(options.midi).suffix.lower() in _MIDI_FILES
    seconds = math.inf if options.seconds is None else options.seconds
    known: Iterable[Blow] = ()
    if options.midi is None or file:
        known, seconds = _known_blows(player, keyboard, options)
    live = _Live(player, known)
    rate = player.field.sample_rate
    device: int | str | None = options.device
    if options.device is not None and options.device.isdecimal():
        device = int(options.device)
    ended = threading.Event()
    try:
        stream = devices.OutputStream(
            samplerate=rate, blocksize=options.block, device=device, channels=1, dtype="float32", callback=live.fill
        )
    except (devices.PortAudioError, ValueError) as error:
        raise PlayerError(
            f"no sound device plays {rate:g} Hz here ({error}): name another by --device, or write a file by --bounce "
            "FILE.wav"
        ) from error
    try:
        with stream:
            if options.midi is not None and not file:
                with listen(options.midi, lambda note: live.coming.put(_heard(keyboard, note))) as name:
                    say(f"listening to {name}; Ctrl-C ends")
                    _wait(live, seconds, ended)
            else:
                say("playing; Ctrl-C ends")
                _wait(live, seconds, ended)
    finally:
        if live.late:
            say(f"note: {live.late} blocks came too late; a larger --block or fewer --voices help")


def _heard(keyboard: Keyboard, note: Note) -> Blow:
    return keyboard.blow(note.number, note.velocity, start=0)


def _wait(live: _Live, seconds: float, ended: threading.Event) -> None:
    """Wait so long, or until something fails in the callback, which cannot raise."""
    begun = time.monotonic()
    while time.monotonic() - begun < seconds and not live.failed:
        ended.wait(0.05)
    if live.failed:
        raise PlayerError(f"the sound stopped: {live.failed[0]}") from live.failed[0]


def _sounddevice() -> Any:
    try:
        import sounddevice
    except ImportError as error:
        raise PlayerError(
            "playing needs sounddevice: run pip install 'avmsf[play]', or write a file by --bounce FILE.wav"
        ) from error
    except OSError as error:
        raise PlayerError(
            f"playing needs the PortAudio library ({error}): install it, or write a file by --bounce FILE.wav"
        ) from error
    return sounddevice
