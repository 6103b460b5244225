"""An instrument of one object: blows by point, force and hammer in, sound out, as fast as they come.

It stands beside the exports because it reads the same table of points that they do, and nothing above it.
"""

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float32, Float64

from avmsf.errors import PlayerError
from avmsf.export.sampledfield import SampledField
from avmsf.modal.pulse import ForcePulse
from avmsf.modal.voices import FLOOR, VoiceBank, turns

Keys = Literal["contacts", "pitch"]
LOWEST_NOTE, NOTES = 36, 61
"""First MIDI note and number of notes that contacts are spread over: a keyboard of five octaves from C2 on."""
MIDDLE_NOTE = 60
"""Note at which the object sounds as it is, where notes are pitches."""
MIDDLE_VELOCITY = 100
"""Velocity of a blow of force 1."""
_LOUDEST = 0.25
"""What the loudest single blow of force 1 reaches of full scale, -12 dB, where the level is chosen here."""
_JUDGED = 64
"""Points among which the loudest blow is looked for."""


@dataclass(frozen=True)
class Blow:
    """One blow of what is played."""

    row: int
    """Which of the field's points."""
    force: float = 1.0
    """Newtons where the field knows forces, else relative to an average recorded blow."""
    start: int = 0
    """Sample at which it begins."""
    contact_time: float = 0.0
    """How long hammer and object touch, seconds; 0 is the blow as it was recorded."""
    ratio: float = 1.0
    """What all frequencies are multiplied by."""


class Player:
    """Turns blows into sound, block by block."""

    def __init__(
        self, field: SampledField, *, voices: int = 32, level: float | None = None, floor: float = FLOOR
    ) -> None:
        """Get ready. `level` is what sounds are multiplied by; without it the loudest single blow peaks at -12 dB.

        `voices` and `floor` as in `VoiceBank`. Raises `PlayerError` for a level that is not positive.
        """
        if level is None:
            level = comfortable_level(field)
        if not 0 < level < math.inf:
            raise PlayerError(f"expected a level above 0, found {level:g}")
        self.field, self.level = field, level
        self._amplitude = level * (field.sine.numpy().astype(np.float64) + 1j * field.cosine.numpy())
        self._bank = VoiceBank(
            sample_rate=field.sample_rate, noise=level * field.noise.numpy(), voices=voices, floor=floor
        )

    @property
    def now(self) -> int:
        """Samples rendered so far."""
        return self._bank.now

    @property
    def ringing(self) -> int:
        """How many sets of resonators sound: one for all blows where the dampings are the same everywhere."""
        return self._bank.ringing

    def strike(self, blow: Blow) -> None:
        """Add a blow. Raises `PlayerError` for a point that is not there, and for a start that has gone by."""
        if not 0 <= blow.row < len(self.field):
            raise PlayerError(f"expected one of points 0 to {len(self.field) - 1}, found {blow.row}")
        frequency = blow.ratio * self.field.frequency.numpy()
        damping = self.field.damping.numpy() if self.field.shared_damping else self.field.damping[blow.row].numpy()
        rate = self.field.sample_rate
        heard = frequency < 0.5 * rate
        pulse = ForcePulse(blow.contact_time).samples(rate).numpy() if blow.contact_time > 0 else None
        self._bank.strike(
            (blow.ratio, -1 if self.field.shared_damping else blow.row),
            turns(frequency, damping, sample_rate=rate),
            np.where(heard, self._amplitude[blow.row], 0.0),
            force=blow.force,
            pulse=pulse,
            start=blow.start,
        )

    def render(self, count: int, *, limit: bool = True) -> Float32[np.ndarray, " samples"]:
        """Return the next `count` samples, as `VoiceBank.render`."""
        return self._bank.render(count, limit=limit)

    def play(self, blows: Iterable[Blow], samples: int, *, block: int = 256) -> Iterator[Float32[np.ndarray, " block"]]:
        """Yield blocks of what the blows, in any order, sound like, `samples` in all."""
        for blow in blows:
            self.strike(blow)
        for begin in range(0, samples, block):
            yield self.render(min(block, samples - begin))


def comfortable_level(field: SampledField) -> float:
    """Return the factor by which the loudest blow of force 1, of some spread over the object, peaks at -12 dB."""
    rows = field.spread(_JUDGED)
    peak = float(field.render(rows, samples=min(field.samples, round(0.25 * field.sample_rate) + 1)).abs().max())
    return _LOUDEST / peak if peak > 0 else 1.0


def random_blows(
    field: SampledField,
    *,
    seconds: float,
    each_second: float,
    seed: int,
    force: float = 1.0,
    contact_time: float = 0.0,
) -> list[Blow]:
    """Return those of `endless_blows` that begin within so many seconds; raises `PlayerError` as it does."""
    _expect_above_zero(seconds, "seconds")
    blows = endless_blows(field, each_second=each_second, seed=seed, force=force, contact_time=contact_time)
    return list(takewhile(lambda blow: blow.start < seconds * field.sample_rate, blows))


def endless_blows(
    field: SampledField, *, each_second: float, seed: int, force: float = 1.0, contact_time: float = 0.0
) -> Iterator[Blow]:
    """Return blows at random times (a Poisson process), points and forces, the same for one seed, one after another.

    Forces scatter by 6 dB about `force`. Raises `PlayerError` for rates and forces that are not positive.
    """
    _expect_above_zero(each_second, "blows a second")
    _expect_above_zero(force, "force")

    def drawn() -> Iterator[Blow]:
        generator = np.random.default_rng(seed)
        when = 0.0
        while True:
            row, strength = int(generator.integers(len(field))), force * 10 ** (6 * generator.standard_normal() / 20)
            yield Blow(row, strength, round(when * field.sample_rate), contact_time)
            when += generator.exponential(1.0 / each_second)

    return drawn()


def _expect_above_zero(value: float, what: str) -> None:
    if not 0 < value < math.inf:
        raise PlayerError(f"expected {what} above 0, found {value:g}")


class Keyboard:
    """Which blow a key of a MIDI keyboard is."""

    def __init__(
        self, field: SampledField, *, keys: Keys = "contacts", row: int | None = None, contact_time: float = 0.0
    ) -> None:
        """Spread contacts over the notes from `LOWEST_NOTE` on, or with "pitch" let notes transpose one contact.

        That is point `row`, or the first of the field's points that are spread the farthest apart.
        """
        self._keys, self._contact_time = keys, contact_time
        self._rows = field.spread(NOTES).tolist()
        self._row = self._rows[0] if row is None else row

    def blow(self, note: int, velocity: int, *, start: int) -> Blow:
        """Return the blow of a note from 0 to 127 at a velocity from 1 to 127: force 1 at 100, and by its square."""
        force = (velocity / MIDDLE_VELOCITY) ** 2
        if self._keys == "pitch":
            return Blow(self._row, force, start, self._contact_time, 2.0 ** ((note - MIDDLE_NOTE) / 12))
        return Blow(self._rows[(note - LOWEST_NOTE) % len(self._rows)], force, start, self._contact_time)


@dataclass(frozen=True)
class Capacity:
    """How much can sound at once."""

    voices: int
    """Sets of resonators, all modes audible, that ring in real time on one core."""
    blows: float
    """Blows a second, in one set, that are sounded in real time; nan where blows do not share one."""


def measure_capacity(field: SampledField, *, block: int = 256, tried: int = 16, seconds: float = 0.5) -> Capacity:
    """Measure how many voices sound in the time that they last, by rendering `tried` of them with nothing culled."""
    rate, count = field.sample_rate, max(1, round(seconds * field.sample_rate / block))
    several = replace(field, damping=field.damping_at(torch.arange(len(field))))
    used = _seconds_of(
        several,
        [Blow(place % len(field), ratio=1 + 1e-6 * place) for place in range(tried)],
        count,
        block,
        voices=tried,
    )
    voices = math.floor(tried * count * block / rate / used)
    blows = math.nan
    if field.shared_damping:
        each = [Blow(place % len(field), start=place * count * block // 1000) for place in range(1000)]
        blows = 1000 / max(1e-9, _seconds_of(field, each, count, block, voices=tried))
    return Capacity(voices, blows)


def _seconds_of(field: SampledField, blows: Sequence[Blow], count: int, block: int, *, voices: int) -> float:
    """Return the processor time of sounding blows for so many blocks, the compiling and the first of all aside."""
    for warm in (True, False):
        player = Player(field, voices=voices, level=1.0, floor=0.0)
        begun = time.process_time()
        for _ in player.play(blows, block if warm else count * block, block=block):
            pass
    return time.process_time() - begun


def bounce(player: Player, blows: Iterable[Blow], samples: int, *, block: int = 256) -> Float64[np.ndarray, " samples"]:
    """Return the sound of blows, `samples` long."""
    return np.concatenate(list(player.play(blows, samples, block=block))).astype(np.float64)
