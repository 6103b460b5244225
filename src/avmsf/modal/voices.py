"""Blows in real time, block by block: resonators for the modes, the noise beside them, and a limiter behind them.

The state of a mode is a complex number that turns and shrinks, p[n] = z p[n-1] + a x[n] with z = exp((-d + 2 pi i f) /
rate), x the blow's force and a = sine + i cosine; its imaginary part is heard. The bank is linear: where frequencies
and dampings are the same, all blows ring in one set of resonators, exactly. Others get sets of their own, "voices".
"""

import heapq
import math
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import no_type_check

import numpy as np
from jaxtyping import Complex128, Float32, Float64

from avmsf.compiled import compiled
from avmsf.errors import PlayerError

FLOOR = 1e-7
"""Amplitude, of full scale 1, below which a mode's ringing is dropped: -140 dB, so that 128 modes at once are at most
-98 dB, where 16 bits end."""
CEILING = 0.89
"""Level that the limiter lets pass untouched, -1 dB of full scale; nothing is louder."""
_RELEASE = 0.1
"""Seconds in which the limiter's gain goes most of the way back."""
_FADE = 0.01
"""Seconds in which a voice that has to make room, and the noise at its end, die away."""


@dataclass(eq=False)
class _Voice:
    """A set of resonators that all blows of one key ring in."""

    turn: Complex128[np.ndarray, " modes"]
    state: Complex128[np.ndarray, " modes"]
    blows: list["_Blow"] = field(default_factory=list)
    fading: int = -1
    """Samples of its fading that are still to come; -1 if it is to stay."""


@dataclass(eq=False)
class _Blow:
    start: int
    amplitude: Complex128[np.ndarray, " modes"]
    pulse: Float64[np.ndarray, " pulse"]


@dataclass(eq=False)
class _Noise:
    """What one blow brings along beside its modes."""

    start: int
    force: float
    fading: int = -1
    """As a voice's."""


class VoiceBank:
    """Sounds blows as they come; not thread-safe: let one thread strike and render."""

    def __init__(
        self, *, sample_rate: float, noise: Float32[np.ndarray, " samples"], voices: int = 32, floor: float = FLOOR
    ) -> None:
        """Start in silence. `noise` is what every blow of force 1 brings along beside its modes.

        At most `voices` sets of resonators ring at once, and as many blows' noise; the faintest makes room for a new
        one. Modes below `floor` are dropped, none with 0. Raises `PlayerError` for fewer than one voice.
        """
        if voices < 1:
            raise PlayerError(f"expected 1 voice or more, found {voices}")
        self.sample_rate = sample_rate
        self.now = 0
        """Samples rendered so far."""
        self._limit, self._floor = voices, floor
        self._voices: dict[Hashable, _Voice] = {}
        self._fading: list[_Voice] = []
        self._fade = max(1, round(_FADE * sample_rate))
        self._noise = _faded(noise.astype(np.float64), self._fade)
        self._noises: list[_Noise] = []
        self._coming: list[tuple[int, int, Hashable, Complex128[np.ndarray, " modes"], _Blow, float]] = []
        self._struck = 0
        self._gain = 1.0

    @property
    def ringing(self) -> int:
        """How many sets of resonators sound."""
        return len(self._voices) + len(self._fading)

    def strike(
        self,
        key: Hashable,
        turn: Complex128[np.ndarray, " modes"],
        amplitude: Complex128[np.ndarray, " modes"],
        *,
        force: float = 1.0,
        pulse: Float64[np.ndarray, " pulse"] | None = None,
        start: int | None = None,
    ) -> None:
        """Add a blow that begins at sample `start`, or with the next block.

        Blows of one `key` have one `turn`, the z of their modes, and ring together. `amplitude` is sine + i cosine of
        each mode; `pulse` the course of the force, of sum 1. Raises `PlayerError` for a start in the past.
        """
        begun = self.now if start is None else start
        if begun < self.now:
            raise PlayerError(
                f"expected a blow from sample {self.now} on, found one at {begun}: strike before rendering"
            )
        shape = np.ones(1) if pulse is None else pulse
        self._struck += 1
        # Blows of one sample begin in the order in which they were struck.
        heapq.heappush(self._coming, (begun, self._struck, key, turn, _Blow(begun, force * amplitude, shape), force))

    def render(self, count: int, *, limit: bool = True) -> Float32[np.ndarray, " samples"]:
        """Return the next `count` samples; with `limit` none is louder than `CEILING`, and fainter ones are exact."""
        out = np.zeros(count)
        while self._coming and self._coming[0][0] < self.now + count:
            self._begin(*heapq.heappop(self._coming)[2:])
        for voice in [*self._voices.values(), *self._fading]:
            self._ring(voice, out)
        self._voices = {key: voice for key, voice in self._voices.items() if voice.blows or voice.state.any()}
        self._fading = [voice for voice in self._fading if voice.fading > 0]
        for noise in self._noises:
            self._rustle(noise, out)
        self.now += count
        self._noises = [each for each in self._noises if each.start + len(self._noise) > self.now and each.fading != 0]
        if limit:
            self._gain = _limit(out, self._gain, math.exp(-1.0 / (_RELEASE * self.sample_rate)))
        return out.astype(np.float32)

    def _begin(self, key: Hashable, turn: Complex128[np.ndarray, " modes"], blow: _Blow, force: float) -> None:
        if key not in self._voices:
            if len(self._voices) >= self._limit:
                self._make_room()
            self._voices[key] = _Voice(turn, np.zeros_like(turn))
        self._voices[key].blows.append(blow)
        if self._noise.any():
            self._noises.append(_Noise(blow.start, force))
            kept = [each for each in self._noises if each.fading < 0]
            if len(kept) > self._limit:
                faintest = min(kept, key=lambda each: (abs(each.force), each.start))
                faintest.fading = self._fade
                if faintest.start >= self.now:
                    # Nothing of it was heard, so that it leaves no step behind.
                    self._noises.remove(faintest)

    def _ring(self, voice: _Voice, out: Float64[np.ndarray, " samples"]) -> None:
        end = self.now + len(out)
        begun = [blow for blow in voice.blows if blow.start < end]
        loudest = np.abs(voice.state)
        for blow in begun:
            loudest = np.maximum(loudest, np.abs(blow.amplitude))
        heard = np.flatnonzero(loudest > self._floor)
        kept = voice.state[heard]
        added = np.zeros(len(out))
        force = np.zeros((len(begun), len(out)))
        for row, blow in enumerate(begun):
            first, last = max(blow.start, self.now), min(blow.start + len(blow.pulse), end)
            if first < last:
                force[row, first - self.now : last - self.now] = blow.pulse[first - blow.start : last - blow.start]
        amplitude = np.array([blow.amplitude[heard] for blow in begun]).reshape(len(begun), len(heard))
        real, imaginary = kept.real.copy(), kept.imag.copy()
        turn = voice.turn[heard]
        _turn(
            real,
            imaginary,
            turn.real.copy(),
            turn.imag.copy(),
            amplitude.real.copy(),
            amplitude.imag.copy(),
            force,
            added,
        )
        voice.state[:] = 0.0
        voice.state[heard] = real + 1j * imaginary
        voice.blows = [blow for blow in voice.blows if blow.start + len(blow.pulse) > end]
        if voice.fading >= 0:
            added *= self._ramp(voice.fading, len(out))
            voice.fading = max(0, voice.fading - len(out))
        out += added

    def _rustle(self, noise: _Noise, out: Float64[np.ndarray, " samples"]) -> None:
        first, last = max(noise.start, self.now), min(noise.start + len(self._noise), self.now + len(out))
        if first >= last:
            return
        added = noise.force * self._noise[first - noise.start : last - noise.start]
        if noise.fading >= 0:
            added *= self._ramp(noise.fading, len(out))[: len(added)]
            noise.fading = max(0, noise.fading - len(out))
        out[first - self.now : last - self.now] += added

    def _ramp(self, fading: int, count: int) -> Float64[np.ndarray, " samples"]:
        """Return how loud the next samples are of what has so many of its fading to come."""
        return np.clip((fading - np.arange(count)) / self._fade, 0.0, 1.0)

    def _make_room(self) -> None:
        """Let the voice die away that sounds the faintest."""

        def strength(key: Hashable) -> float:
            voice = self._voices[key]
            coming = sum(float(np.abs(blow.amplitude).sum()) for blow in voice.blows)
            return float(np.abs(voice.state).sum()) + coming

        voice = self._voices.pop(min(self._voices, key=strength))
        voice.fading = self._fade
        self._fading.append(voice)


def turns(
    frequency: Float64[np.ndarray, " modes"], damping: Float64[np.ndarray, " modes"], *, sample_rate: float
) -> Complex128[np.ndarray, " modes"]:
    """Return the z of modes (Hz, 1/s): what a mode is multiplied by from one sample to the next."""
    return np.exp((-damping + 2j * math.pi * frequency) / sample_rate)


def _faded(noise: Float64[np.ndarray, " samples"], length: int) -> Float64[np.ndarray, " samples"]:
    """Return the noise with an end that does not click."""
    ramp = np.clip((len(noise) - np.arange(len(noise))) / length, 0.0, 1.0)
    return noise * ramp


@compiled(fastmath={"contract", "reassoc"})
@no_type_check
def _turn(real, imaginary, turn_real, turn_imaginary, sine, cosine, force, out):
    """Let modes ring for a block: turn, add what the blows push, and sum up what is heard."""
    modes, blows = len(real), len(force)
    for n in range(len(out)):
        total = 0.0
        for k in range(modes):
            turned = turn_real[k] * real[k] - turn_imaginary[k] * imaginary[k]
            imaginary[k] = turn_real[k] * imaginary[k] + turn_imaginary[k] * real[k]
            real[k] = turned
            total += imaginary[k]
        for b in range(blows):
            push = force[b, n]
            if push != 0.0:
                for k in range(modes):
                    real[k] += push * sine[b, k]
                    imaginary[k] += push * cosine[b, k]
                    total += push * cosine[b, k]
        out[n] = total


@compiled()
@no_type_check
def _limit(out, gain, release):
    """Scale samples so that none is above the ceiling: down at once, and slowly back; return the last gain."""
    for n in range(len(out)):
        gain = 1.0 - (1.0 - gain) * release
        if gain > 1.0 - 1e-9:
            gain = 1.0
        loud = abs(out[n])
        if loud * gain > CEILING:
            gain = CEILING / loud
        out[n] *= gain
    return gain
