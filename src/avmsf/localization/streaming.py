"""Impacts in a stream of samples, each located while it still sounds.

The modes are known, so the free decay after an impact is predicted: its modal amplitudes are fitted once, propagated
from sample to sample, and updated regularly from the stream. A new impact is detected where the energy of the residual,
in hops of 2.5 ms, jumps above all of the last 60 ms. The first `window` seconds from its onset on go to the locator,
without the predicted decay of earlier impacts. The state has a fixed size. The result does not depend on the lengths of
the blocks: samples are processed hop by hop.
"""

import time
from dataclasses import dataclass, replace

import numpy as np
import scipy
import torch
from jaxtyping import Complex128, Float, Float64
from torch import Tensor

from avmsf._utils.arrays import ArrayLike, as_samples
from avmsf.capture.onset import find_onset
from avmsf.capture.prepare import shortest_allowed
from avmsf.errors import LocationError
from avmsf.localization.contact_map import ContactPosterior
from avmsf.localization.locate import assess_match
from avmsf.localization.locator import Locator
from avmsf.localization.preprocess import location_errors
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
    """One impact of a stream, and an estimate of where it was."""

    seconds: float
    """Its onset, from the stream's first sample on."""
    map: ContactPosterior
    """The posterior of its contact."""
    used_seconds: float
    """Length of its sound that the estimate uses."""
    latency: float
    """Seconds from the onset to this estimate: until the block that completed it had come, and the computation."""
    final: bool
    """False for a first estimate after which a better one comes."""


@dataclass(eq=False)
class _PendingImpact:
    """An impact that was detected and whose last estimate was not returned yet."""

    onset: int
    """Its first sample, counted from the stream's first; provisional until `answered`."""
    earlier: Complex128[Tensor, " modes"]
    """Modal amplitudes of earlier impacts at `since`."""
    since: int
    """Sample that `earlier` is of."""
    answered: bool = False
    """Whether the first estimate was returned, and the impact's own modal amplitudes are known."""


class StreamingLocalizer:
    """Locates the impacts in a stream that comes in blocks of any length.

    The first estimate of an impact uses `window` seconds from its onset on. With `later`, longer than that, a second
    and better one uses that length, or all up to the next impact. Impacts closer to each other than `window` count as
    one, and one more than 11 dB below the decay of earlier ones is not detected. The first 15 ms of a stream count as
    its noise. A jump where two recordings were joined may be located as an impact: give each its own listener. The
    stream is high-pass filtered at a twentieth of the lowest mode's frequency, at most 20 Hz. At most the length of the
    field's own sounds is used.

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
        cut = min(_HIGHPASS_RATIO * float(field.bank.frequency.min()), _MAX_HIGHPASS_HZ)
        self.filter = scipy.signal.butter(2, cut, "highpass", fs=rate, output="sos")
        strength = locator.gains[:, audible].abs().square().mean(0).sqrt()
        bank = field.bank.take(audible)
        self._modes = Ringing(bank, strength, sample_rate=rate, window=self.window)
        memory = self.hop * (_MEMORY_HOPS + 2 * _SKIPPED_HOPS) + round(_ONSET_SEARCH_SECONDS * rate)
        self._history_samples = (self.later or self.window) + memory
        locator.prepare(*(each for each in (self.window, self.later) if each is not None))
        self.clock = 0
        """Samples processed."""
        self.waiting = self.recent = self.residual = torch.zeros(0, dtype=torch.float64)
        """Filtered samples that wait for a complete hop; the last ones processed; these without the predicted decay."""
        self.ringing = torch.zeros(len(bank), dtype=torch.complex128)
        """Modal amplitudes C of the decay: sample n from `clock` on is the imaginary part of the sum of C z^n."""
        self.rejected, self.refusal = 0, ""
        """Number of detected sounds that were rejected, another object's or noise, and why the last one was."""
        self._pending: _PendingImpact | None = None
        self._highpass = np.zeros((len(self.filter), 2))

    def process(self, block: ArrayLike) -> list[LocatedImpact]:
        """Return the estimates that the next samples [samples] of the stream complete, in the order of time.

        Raises LocationError for several channels and samples that are not finite; the block is skipped.
        """
        begun = time.perf_counter()
        with location_errors():
            samples = as_samples(block, "block").double()
        if len(samples):
            passed, self._highpass = scipy.signal.sosfilt(self.filter, samples.numpy(), zi=self._highpass)
            samples = torch.from_numpy(passed)
        self.waiting = torch.cat([self.waiting, samples])
        came = self.clock + len(self.waiting)
        answers: list[LocatedImpact] = []
        while len(self.waiting) >= self.hop:
            answer = self._process_hop()
            if answer is not None:
                waited = (came - round(answer.seconds * self.rate)) / self.rate
                answers.append(replace(answer, latency=waited + time.perf_counter() - begun))
        return answers

    def _process_hop(self) -> LocatedImpact | None:
        """Process one hop, and return the estimate that it completes."""
        new, predicted = self.waiting[: self.hop], self._modes.render(self.ringing, self.hop)
        self.recent = torch.cat([self.recent, new])[-self._history_samples :]
        self.residual = torch.cat([self.residual, new - predicted])[-self._history_samples :]
        self.clock, self.waiting = self.clock + self.hop, self.waiting[self.hop :]
        self.ringing = self._modes.after(self.ringing, self.hop)
        if self._pending is None or self._pending.answered:
            return self._detect(self._pending, float(predicted.square().mean()))
        return self._answer(self._pending)

    def _detect(self, pending: _PendingImpact | None, ringing: float) -> LocatedImpact | None:
        """Detect an impact in the last hop; without one, update the decay or return a later estimate."""
        answer, detected = None, self._has_energy_jump(ringing)
        if pending is not None and (detected or self.clock - pending.onset >= (self.later or 0)):
            # The hop in which the next impact began is left out.
            end = self.clock - self.hop * (_SKIPPED_HOPS if detected else 0)
            length = min(end - pending.onset, self.later or 0)
            self._pending = None
            if length > self.window:
                answer = self._located(pending, length, final=True)
        if detected:
            start = self.clock - self.hop
            self._pending = _PendingImpact(start, self._modes.after(self.ringing, -self.hop), start)
        elif self.clock // self.hop % _UPDATE_HOPS == 0:
            # The window must not hold the beginning of an impact that the decay was not fitted to.
            since = 0 if self._pending is None else self._pending.onset
            if self.clock - self.window >= since and len(self.recent) >= self.window:
                self._correct(self.clock - self.window)
        return answer

    def _answer(self, pending: _PendingImpact) -> LocatedImpact | None:
        """Return the first estimate as soon as the window is complete."""
        if self.clock < pending.onset + self.hop + self.window:
            return None
        # As in recordings.
        behind = min(len(self.residual), self.clock - pending.onset + round(_ONSET_SEARCH_SECONDS * self.rate))
        there = self.residual[len(self.residual) - behind :]
        start = find_onset(there.numpy(), sample_rate=self.rate)
        if self.locator.field.origin.settings.from_peaks:
            start += int(there[start : start + self.window].abs().argmax())
        pending.onset = self.clock - behind + start
        if self.clock < pending.onset + self.window:
            return None
        pending.answered = True
        answer = self._located(pending, self.window, final=self.later is None)
        self._correct(pending.onset)
        if answer is None or self.later is None:
            self._pending = None
        return answer

    def _located(self, pending: _PendingImpact, length: int, *, final: bool) -> LocatedImpact | None:
        """Locate an impact by so many samples without the decay of earlier ones; None where it is rejected."""
        earlier = self._modes.after(pending.earlier, pending.onset - pending.since)
        start = len(self.recent) - (self.clock - pending.onset)
        sound = self.recent[start : start + length] - self._modes.render(earlier, length)
        seconds = pending.onset / self.rate
        try:
            found = assess_match(self.locator.locate(sound.float()))
            if found.refusal is not None:
                raise LocationError(f"the impact: {found.refusal}", name="impact", value=seconds)
        except LocationError as error:
            self.rejected, self.refusal = self.rejected + 1, str(error)
            return None
        return LocatedImpact(seconds, found, length / self.rate, 0.0, final)

    def _has_energy_jump(self, ringing: float) -> bool:
        """Return whether the residual's energy in the last hop exceeds that before it by `_ONSET_ENERGY_RATIO`."""
        count = min(_MEMORY_HOPS + _SKIPPED_HOPS + 1, len(self.residual) // self.hop)
        hops = self.residual[len(self.residual) - count * self.hop :].reshape(count, self.hop).square().mean(1)
        known = hops[: -_SKIPPED_HOPS - 1]
        return len(known) >= _MIN_MEMORY_HOPS and float(hops[-1]) > _ONSET_ENERGY_RATIO * (
            float(known.max()) + _MAX_UNEXPLAINED * ringing
        )

    def _correct(self, start: int) -> None:
        """Add the modal amplitudes of the residual in the window from sample `start` on."""
        behind = self.clock - start
        first = len(self.residual) - behind
        before = self.residual[max(0, first - self.window) : first]
        noise = float(before.square().mean()) if len(before) else 0.0
        found = self._modes.fit(self.residual[first : first + self.window], noise)
        explained = self._modes.render(found, behind)
        self.residual = torch.cat([self.residual[:first], self.residual[first:] - explained])
        self.ringing = self.ringing + self._modes.after(found, behind)


_MIN_NOISE_RATIO = 1e-12
"""Noise over the power of what is fitted, that is assumed at least: rounding."""
_FAINTEST = 1e-3
"""Strength over the strongest mode's, that every mode has at least beforehand."""


class Ringing:
    """An object's modes at one sample rate, and how strong each is beforehand."""

    def __init__(self, bank: ModalBank, size: Float[Tensor, " modes"], *, sample_rate: float, window: int) -> None:
        """Take modes that are as strong as `size` on average over the object, in any unit."""
        self.poles = poles_of(bank, sample_rate)
        self.window = self.poles ** torch.arange(window)[:, None]
        """Powers of the poles, [window, modes]."""
        relative = size.double() / size.double().max().clamp_min(torch.finfo(torch.float64).tiny)
        self.scale = relative.clamp_min(_FAINTEST).repeat(2)
        """Standard deviation of the sines' and cosines' amplitudes over the object's surface, [two_modes]."""
        # In units of `scale`: with eigenvectors the fit with any amount of noise is two small products.
        inner = gram(self.poles, window, power=0) * self.scale[:, None] * self.scale
        values, self.vectors = torch.linalg.eigh(inner)
        self.values = values.clamp_min(0.0)

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
