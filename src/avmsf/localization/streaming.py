"""Impacts in a stream of samples, each located while it still sounds.

The modes are known, so the free decay after an impact is predicted: its modal amplitudes are fitted once, propagated
from sample to sample, and updated regularly from the stream. A new impact is detected where the energy of the residual,
in hops of 2.5 ms, jumps above all of the last 60 ms. The first `window` seconds from its onset on go to the locator,
without the predicted decay of earlier impacts. The state has a fixed size (`StreamState`). The result does not depend
on the lengths of the blocks: samples are processed hop by hop.
"""

import time
from dataclasses import dataclass, replace

import scipy
import torch
from jaxtyping import Complex128, Float, Float64
from torch import Tensor

from avmsf.capture.onset import find_onset
from avmsf.capture.prepare import shortest_allowed
from avmsf.errors import LocationError
from avmsf.localization.contact_map import ContactMap
from avmsf.localization.locate import assess_match
from avmsf.localization.locator import Locator
from avmsf.modal.inner_products import gram, poles_of
from avmsf.modal.modes import ModalBank

WINDOW_SECONDS = 0.04
"""Length of an impact's sound that its first estimate uses."""
_HOP_SECONDS, _MIN_HOP_SAMPLES = 0.0025, 16
"""Length of a hop, and its samples at least."""
_MEMORY_HOPS, _SKIPPED_HOPS, _MIN_MEMORY_HOPS = 24, 2, 4
"""Hops that an impact's energy is compared with; hops between these and its own, in which it may have begun; and fewest
of the former."""
_ONSET_ENERGY_RATIO = 4.0
"""Energy of an impact's hop over the largest in memory: 6 dB."""
_MAX_UNEXPLAINED = 0.02
"""Residual energy over that of the predicted decay that prediction errors may leave within a hop: -17 dB."""
_UPDATE_HOPS = 4
"""Hops between updates of the modal amplitudes."""
_ONSET_SEARCH_SECONDS = 0.03
"""Time before a detected impact in which its onset is searched."""
_HIGHPASS_RATIO = 0.05
"""Cut-off of the high-pass filter over the lowest mode's frequency.

A stream's filter is causal, as later samples are not there yet, where `capture.prepare.remove_rumble` runs both ways
over a finished recording and moves no phase. At this cut-off the second-order filter moves the lowest mode's phase by
.07 radians and lowers no mode by more than 3e-6 of its amplitude.
"""
_MAX_HIGHPASS_HZ = 20.0


@dataclass(frozen=True, eq=False)
class LocatedImpact:
    """One impact and the posterior of its contact."""

    seconds: float
    """Its onset, from the stream's first sample on."""
    map: ContactMap
    """The posterior of its contact."""
    used_seconds: float
    """Length of its sound that the estimate uses."""
    latency: float
    """Seconds from the onset to this estimate: until the block that completed it had come, and the computation."""
    final: bool
    """False for a first estimate after which a better one comes."""


@dataclass(frozen=True, eq=False)
class PendingImpact:
    """An impact that was detected and whose last estimate was not returned yet."""

    onset: int
    """Its first sample, counted from the stream's first; provisional until `answered`."""
    earlier: Complex128[Tensor, " modes"]
    """Modal amplitudes of earlier impacts at `since`."""
    since: int
    """Sample that `earlier` is of."""
    answered: bool
    """Whether the first estimate was returned, and the impact's own modal amplitudes are known."""


@dataclass(frozen=True, eq=False)
class StreamState:
    """The state from one block to the next. Its size does not grow."""

    clock: int
    """Samples processed."""
    waiting: Float64[Tensor, " waiting"]
    """Filtered samples that wait for a complete hop."""
    recent: Float64[Tensor, " recent"]
    """The last samples processed."""
    residual: Float64[Tensor, " recent"]
    """These without the predicted decay of known impacts."""
    ringing: Complex128[Tensor, " modes"]
    """Modal amplitudes C of the decay: sample n from `clock` on is the imaginary part of the sum of C z^n."""
    pending: PendingImpact | None
    """The latest impact, until its last estimate is returned."""
    highpass: Float64[Tensor, "sections 2"]
    """State of the high-pass filter."""
    rejected: int
    """Number of detected sounds that were rejected: another object's, or noise."""
    refusal: str
    """Why the last one of them was."""


class StreamingLocalizer:
    """Locates the impacts in a stream that comes in blocks of any length.

    The first estimate of an impact uses `window` seconds from its onset on. With `later`, longer than that, a second
    and better one uses that length, or all up to the next impact. Impacts closer to each other than `window` count as
    one, and one more than 11 dB below the decay of earlier ones is not detected. The first 15 ms of a stream count as
    its noise. The stream is high-pass filtered at `highpass` Hz, by default a twentieth of the lowest mode's frequency,
    at most 20 Hz; 0 turns the filter off. At most the length of the field's own sounds is used.

    Raises LocationError for a sample rate that is not the field's, times that are not positive, a window of less than
    20 ms, and a field of which no mode is audible.
    """

    def __init__(
        self,
        locator: Locator,
        *,
        sample_rate: float | None = None,
        window: float = WINDOW_SECONDS,
        later: float | None = None,
        highpass: float | None = None,
    ) -> None:
        field = locator.field
        rate = field.sample_rate
        if sample_rate is not None and sample_rate != rate:
            advice = "open the stream at this rate, or locate finished recordings, which are resampled"
            wanted = f"the field's {rate:g} Hz"
            raise LocationError.expected(wanted, sample_rate, name="sample_rate", advice=advice)
        if not 0.0 < window < 10.0:
            raise LocationError.expected("0 to 10 s", window, name="window")
        if not (later is None or window < later < 10.0):
            raise LocationError.expected(f"{window:g} s to 10 s", later, name="later")
        lowest = min(_HIGHPASS_RATIO * float(field.bank.frequency.min()), _MAX_HIGHPASS_HZ)
        cut = lowest if highpass is None else highpass
        if not 0.0 <= cut < rate / 2:
            raise LocationError.expected(f"0 for no filter, or less than {rate / 2:g} Hz", cut, name="highpass")
        if round(window * rate) < shortest_allowed(rate):
            wanted = f"{shortest_allowed(rate)} samples or more to resolve the modes"
            got = f"{round(window * rate)} ({window:g} s)"
            raise LocationError.expected(wanted, window, got=got, name="window")
        audible = torch.nonzero(field.audible).flatten()
        if not len(audible):
            raise LocationError.expected(f"modes below {rate / 2:g} Hz", 0, got="none", name="field")
        self.locator, self.rate = locator, rate
        self.hop = max(_MIN_HOP_SAMPLES, round(_HOP_SECONDS * rate))
        self.window = min(round(window * rate), field.samples)
        last = 0 if later is None else min(round(later * rate), field.samples)
        self.later = last if last > self.window else None
        self.filter = scipy.signal.butter(2, cut, "highpass", fs=rate, output="sos") if cut > 0.0 else None
        strength = locator.gains[:, audible].abs().square().mean(0).sqrt()
        bank = field.bank.take(audible)
        self._modes = Ringing.of(bank, strength, sample_rate=rate, hop=self.hop, window=self.window)
        memory = self.hop * (_MEMORY_HOPS + 2 * _SKIPPED_HOPS) + round(_ONSET_SEARCH_SECONDS * rate)
        self._history_samples = (self.later or self.window) + memory
        self.state = self._silence()
        locator.prepare(*(each for each in (self.window, self.later) if each is not None))

    def process(self, block: Float[Tensor, " samples"]) -> list[LocatedImpact]:
        """Return the estimates that the next samples of the stream complete, in the order of time.

        Raises LocationError for samples that are not finite; the block is skipped.
        """
        begun = time.perf_counter()
        if not bool(torch.isfinite(block).all()):
            advice = "leave them out or send zeros"
            raise LocationError.expected("finite samples", got="NaN or infinity", name="block", advice=advice)
        clear, highpass = self._filtered(block.detach().double().cpu(), self.state.highpass)
        state = replace(self.state, waiting=torch.cat([self.state.waiting, clear]), highpass=highpass)
        came = state.clock + len(state.waiting)
        answers: list[LocatedImpact] = []
        while len(state.waiting) >= self.hop:
            state, answer = self._process_hop(state)
            if answer is not None:
                waited = (came - round(answer.seconds * self.rate)) / self.rate
                answers.append(replace(answer, latency=waited + time.perf_counter() - begun))
        self.state = state
        return answers

    def _silence(self) -> StreamState:
        nothing = torch.zeros(0, dtype=torch.float64)
        sections = 0 if self.filter is None else len(self.filter)
        still = torch.zeros(len(self._modes.poles), dtype=torch.complex128)
        highpass = torch.zeros(sections, 2, dtype=torch.float64)
        return StreamState(0, nothing, nothing, nothing, still, None, highpass, 0, "")

    def _process_hop(self, state: StreamState) -> tuple[StreamState, LocatedImpact | None]:
        """Process one hop, and return the estimate that it completes."""
        new, predicted = state.waiting[: self.hop], self._modes.render(state.ringing, self.hop)
        recent = torch.cat([state.recent, new])[-self._history_samples :]
        residual = torch.cat([state.residual, new - predicted])[-self._history_samples :]
        state = replace(
            state,
            clock=state.clock + self.hop,
            waiting=state.waiting[self.hop :],
            recent=recent,
            residual=residual,
            ringing=state.ringing * self._modes.hop,
        )
        if state.pending is None or state.pending.answered:
            return self._detect(state, float(predicted.square().mean()))
        return self._answer(state, state.pending)

    def _detect(self, state: StreamState, ringing: float) -> tuple[StreamState, LocatedImpact | None]:
        """Detect an impact in the last hop; without one, update the decay or return a later estimate."""
        pending, answer = state.pending, None
        detected = self._has_energy_jump(state.residual, ringing)
        if pending is not None and (detected or state.clock - pending.onset >= (self.later or 0)):
            # The hop in which the next impact began is left out.
            end = state.clock - self.hop * (_SKIPPED_HOPS if detected else 0)
            length = min(end - pending.onset, self.later or 0)
            state = replace(state, pending=None)
            if length > self.window:
                state, answer = self._located(state, pending, length, final=True)
        if detected:
            start = state.clock - self.hop
            before = self._modes.after(state.ringing, -self.hop)
            return replace(state, pending=PendingImpact(start, before, start, answered=False)), answer
        if state.clock // self.hop % _UPDATE_HOPS == 0 and self._is_settled(state):
            state = self._corrected(state, state.clock - self.window)
        return state, answer

    def _answer(self, state: StreamState, pending: PendingImpact) -> tuple[StreamState, LocatedImpact | None]:
        """Return the first estimate as soon as the window is complete."""
        if state.clock < pending.onset + self.hop + self.window:
            return state, None
        onset = self._onset(state, pending)
        if state.clock < onset + self.window:
            return replace(state, pending=replace(pending, onset=onset)), None
        begun = replace(pending, onset=onset, answered=True)
        state, answer = self._located(state, begun, self.window, final=self.later is None)
        more = answer is not None and self.later is not None
        return replace(self._corrected(state, onset), pending=begun if more else None), answer

    def _located(
        self, state: StreamState, pending: PendingImpact, length: int, *, final: bool
    ) -> tuple[StreamState, LocatedImpact | None]:
        """Locate an impact by so many samples without the decay of earlier ones; None where it is rejected."""
        earlier = self._modes.after(pending.earlier, pending.onset - pending.since)
        start = len(state.recent) - (state.clock - pending.onset)
        sound = state.recent[start : start + length] - self._modes.render(earlier, length)
        try:
            found = assess_match(self.locator.locate(sound.float()))
            if found.refusal is not None:
                raise LocationError(f"the impact: {found.refusal}", name="impact", value=pending.onset / self.rate)
        except LocationError as error:
            return replace(state, rejected=state.rejected + 1, refusal=str(error)), None
        return state, LocatedImpact(pending.onset / self.rate, found, length / self.rate, 0.0, final)

    def _has_energy_jump(self, residual: Float64[Tensor, " recent"], ringing: float) -> bool:
        """Return whether the residual's energy in the last hop exceeds that before it by `_ONSET_ENERGY_RATIO`."""
        count = min(_MEMORY_HOPS + _SKIPPED_HOPS + 1, len(residual) // self.hop)
        hops = residual[len(residual) - count * self.hop :].reshape(count, self.hop).square().mean(1)
        known = hops[: -_SKIPPED_HOPS - 1]
        return len(known) >= _MIN_MEMORY_HOPS and float(hops[-1]) > _ONSET_ENERGY_RATIO * (
            float(known.max()) + _MAX_UNEXPLAINED * ringing
        )

    def _is_settled(self, state: StreamState) -> bool:
        """Return whether the last window holds no beginning of an impact that the decay was not fitted to."""
        since = 0 if state.pending is None else state.pending.onset
        return state.clock - self.window >= since and len(state.recent) >= self.window

    def _onset(self, state: StreamState, pending: PendingImpact) -> int:
        """Return an impact's first sample, found as in recordings."""
        behind = min(len(state.residual), state.clock - pending.onset + round(_ONSET_SEARCH_SECONDS * self.rate))
        there = state.residual[len(state.residual) - behind :]
        return state.clock - behind + find_onset(there.numpy(), sample_rate=self.rate)

    def _corrected(self, state: StreamState, start: int) -> StreamState:
        """Add the modal amplitudes of the residual in the window from sample `start` on."""
        first = len(state.residual) - (state.clock - start)
        last = first + self.window
        before = state.residual[max(0, first - self.window) : first]
        noise = float(before.square().mean()) if len(before) else 0.0
        found = self._modes.fit(state.residual[first:last], noise)
        explained = self._modes.render(found, state.clock - start)
        residual = torch.cat([state.residual[:first], state.residual[first:] - explained])
        return replace(state, residual=residual, ringing=state.ringing + self._modes.after(found, state.clock - start))

    def _filtered(
        self, block: Float64[Tensor, " samples"], state: Float64[Tensor, "sections 2"]
    ) -> tuple[Float64[Tensor, " samples"], Float64[Tensor, "sections 2"]]:
        if self.filter is None or not len(block):
            return block, state
        passed, after = scipy.signal.sosfilt(self.filter, block.numpy(), zi=state.numpy())
        return torch.from_numpy(passed), torch.from_numpy(after)


_MIN_NOISE_RATIO = 1e-12
"""Noise over the power of what is fitted, that is assumed at least: rounding."""
_FAINTEST = 1e-3
"""Strength over the strongest mode's, that every mode has at least beforehand."""


@dataclass(frozen=True, eq=False)
class Ringing:
    """An object's modes at one sample rate, and how strong each is beforehand."""

    poles: Complex128[Tensor, " modes"]
    window: Complex128[Tensor, "window modes"]
    """Powers of the poles."""
    hop: Complex128[Tensor, " modes"]
    """The poles' powers by a hop."""
    scale: Float64[Tensor, " two_modes"]
    """Standard deviation of the sines' and cosines' amplitudes over the object's surface."""
    vectors: Float64[Tensor, "two_modes two_modes"]
    values: Float64[Tensor, " two_modes"]
    """Eigenvectors and -values of the Gram matrix over a window, of amplitudes in units of `scale`: with these the fit
    with any amount of noise is two small products."""

    @classmethod
    def of(
        cls, bank: ModalBank, size: Float[Tensor, " modes"], *, sample_rate: float, hop: int, window: int
    ) -> "Ringing":
        """Return the ringing of modes that are as strong as `size` on average over the object, in any unit."""
        poles = poles_of(bank, sample_rate)
        relative = size.double() / size.double().max().clamp_min(torch.finfo(torch.float64).tiny)
        scale = relative.clamp_min(_FAINTEST).repeat(2)
        values, vectors = torch.linalg.eigh(gram(poles, window, power=0) * scale[:, None] * scale)
        powers = poles ** torch.arange(window)[:, None]
        return cls(poles, powers, poles**hop, scale, vectors, values.clamp_min(0.0))

    def render(self, amplitudes: Complex128[Tensor, " modes"], length: int) -> Float64[Tensor, " samples"]:
        """Return so many samples of what rings with amplitudes."""
        if length <= len(self.window):
            return (self.window[:length] @ amplitudes).imag
        starts = range(0, length, len(self.window))
        return torch.cat([(self.window[: length - n] @ self.after(amplitudes, n)).imag for n in starts])

    def after(self, amplitudes: Complex128[Tensor, " modes"], samples: int) -> Complex128[Tensor, " modes"]:
        """Return the amplitudes so many samples later."""
        return amplitudes * self.poles**samples

    def fit(self, sound: Float64[Tensor, " window"], noise: float) -> Complex128[Tensor, " modes"]:
        """Return the likeliest amplitudes at a window's beginning, with white noise of this variance beside them.

        Beforehand the modes are as strong as over the object's surface, all by one factor, which the sound's energy
        beyond the noise gives: modes that a window is too short to part do not cancel each other.
        """
        energy = float(sound.square().sum())
        modal = energy - noise * len(sound)
        if not modal > 0.0:
            return torch.zeros_like(self.poles)
        factor = modal / float(self.values.sum())
        share = max(noise, _MIN_NOISE_RATIO * energy / len(sound)) / factor
        products = sound.to(torch.complex128) @ self.window
        both = torch.cat([products.imag, products.real]) * self.scale
        sine, cosine = (self.scale * (self.vectors @ ((both @ self.vectors) / (self.values + share)))).chunk(2)
        return torch.complex(sine, cosine)
