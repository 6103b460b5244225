"""Blows in a stream of samples, each located while it still rings.

The modes are known, so what rings is known too: after each blow its amplitudes are fitted once, followed from sample to
sample, and corrected now and then by what is heard. A new blow is what the ringing does not explain: the energy of the
rest, in hops of 2.5 ms, jumps above all of the last 60 ms. The first `window` of it, without the ringing of earlier
blows, goes to the locator. What a listener keeps has a fixed size (`Ears`), and the blocks that samples come in do not
matter: they are taken hop by hop.
"""

import time
from dataclasses import dataclass, replace

import torch
from jaxtyping import Complex128, Float, Float64
from scipy.signal import butter, sosfilt
from torch import Tensor

from avmsf.capture.onset import find_onset
from avmsf.capture.prepare import shortest_allowed
from avmsf.errors import LocationError
from avmsf.localization.contact_map import ContactMap
from avmsf.modal.bank import ModalBank
from avmsf.tasks.locate import judged
from avmsf.tasks.locator import Locator
from avmsf.tasks.ringing import Ringing

WINDOW = 0.04
"""Seconds of a blow that its first answer rests on."""
_HOP, _FEWEST = 0.0025, 16
"""Seconds, and samples at least, that are taken at once."""
_MEMORY, _SKIPPED, _LEAD = 24, 2, 4
"""Hops that a blow has to stand above, hops between these and the blow, in which it may have begun, and fewest of the
former."""
_JUMP = 4.0
"""Energy of a blow's hop over the most in memory: 6 dB."""
_MISFIT = 0.02
"""Energy over the ringing's that the modes may fail to foretell within a hop: -17 dB."""
_BETWEEN = 4
"""Hops between corrections of the ringing."""
_BEFORE = 0.03
"""Seconds before a blow from which its onset is found."""
_RUMBLE = 0.05
"""Cut-off of the rumble filter over the lowest mode's frequency.

A stream's filter is causal, as later samples are not there yet, where `capture.prepare.remove_rumble` runs both ways
over a finished recording and moves no phase. At this cut-off the second-order filter moves the lowest mode's phase by
.07 radians and lowers no mode by more than 3e-6 of its amplitude.
"""
_HIGHEST_RUMBLE = 20.0
"""Hz."""


@dataclass(frozen=True, eq=False)
class Blow:
    """One blow, and where it fell."""

    seconds: float
    """When it began, from the stream's first sample on."""
    map: ContactMap
    """Where it may have fallen."""
    heard: float
    """Seconds of its sound that the answer rests on."""
    latency: float
    """Seconds from the blow to this answer: until the block that completed it had come, and what was computed then."""
    final: bool
    """False for a first answer after which a better one comes."""


@dataclass(frozen=True, eq=False)
class Pending:
    """A blow that has begun and is not done with."""

    onset: int
    """Its first sample, counted from the stream's first; a guess until `answered`."""
    earlier: Complex128[Tensor, " modes"]
    """The ringing of earlier blows at `since`."""
    since: int
    """Sample that `earlier` is of."""
    answered: bool
    """Whether the first answer was given, and the blow's own ringing is known."""


@dataclass(frozen=True, eq=False)
class Ears:
    """All that a listener keeps from one block to the next. Its size does not grow."""

    clock: int
    """Samples taken."""
    rest: Float64[Tensor, " rest"]
    """Samples that wait for a whole hop, without rumble."""
    heard: Float64[Tensor, " heard"]
    """The last samples taken."""
    unexplained: Float64[Tensor, " heard"]
    """What of these is no ringing of known blows."""
    ringing: Complex128[Tensor, " modes"]
    """Amplitudes C of what rings: sample n from `clock` on is the imaginary part of the sum of C z^n."""
    pending: Pending | None
    """The latest blow, until its last answer is given."""
    rumble: Float64[Tensor, "sections 2"]
    """State of the filter against rumble."""
    strangers: int
    """Sounds that began like blows and were refused: another object's, or noise."""
    refusal: str
    """Why the last one of them was."""


class Listener:
    """Takes a stream in blocks of any length and says of each blow where it fell.

    The first answer rests on `window` seconds after the blow. With `later`, longer than that, a second and better one
    comes when so much of the blow was heard, or as much as there was before the next blow. Blows closer to each other
    than `window` are heard as one, and so is one fainter than -17 dB beside what rings; the first 15 ms of a stream
    count as its noise. Whatever lies below `rumble` Hz is removed, a constant among it; by itself that is a twentieth
    of the lowest mode's frequency, at most 20 Hz. Nothing is heard for longer than the field's own sounds last.

    Raises LocationError for a sample rate that is not the field's, times that are not positive, a window of less than
    20 ms, and a field of which no mode is audible.
    """

    def __init__(
        self,
        locator: Locator,
        *,
        sample_rate: float | None = None,
        window: float = WINDOW,
        later: float | None = None,
        rumble: float | None = None,
    ) -> None:
        field = locator.field
        rate = field.sample_rate
        if sample_rate is not None and sample_rate != rate:
            raise LocationError(
                f"sample_rate: expected the field's {rate:g} Hz, got {sample_rate:g} Hz; open the stream at this rate, "
                "or locate finished recordings, which are resampled",
                name="sample_rate",
                value=sample_rate,
            )
        if not 0.0 < window < 10.0:
            raise LocationError(f"window: expected 0 to 10 s, got {window:g} s", name="window", value=window)
        if not (later is None or window < later < 10.0):
            raise LocationError(f"later: expected {window:g} s to 10 s, got {later:g} s", name="later", value=later)
        lowest = min(_RUMBLE * float(field.bank.frequency.min()), _HIGHEST_RUMBLE)
        cut = lowest if rumble is None else rumble
        if not 0.0 <= cut < rate / 2:
            raise LocationError.expected(
                f"0 for no filter, or less than {rate / 2:g} Hz", cut, got=f"{cut:g} Hz", name="rumble"
            )
        if round(window * rate) < shortest_allowed(rate):
            raise LocationError(
                f"window: expected {shortest_allowed(rate)} samples or more to resolve the modes, got "
                f"{round(window * rate)} ({window:g} s)",
                name="window",
                value=window,
            )
        audible = torch.nonzero(field.audible).flatten()
        if not len(audible):
            raise LocationError(
                f"field: expected modes below {rate / 2:g} Hz, got none of {len(field.bank)}", name="field", value=0
            )
        self.locator, self.rate = locator, rate
        self.hop = max(_FEWEST, round(_HOP * rate))
        self.window = min(round(window * rate), field.samples)
        last = 0 if later is None else min(round(later * rate), field.samples)
        self.later = last if last > self.window else None
        self.filter = butter(2, cut, "highpass", fs=rate, output="sos") if cut > 0.0 else None
        strength = locator.gains[:, audible].abs().square().mean(0).sqrt()
        bank = ModalBank(field.bank.frequency[audible], field.bank.damping[audible])
        self._modes = Ringing.of(bank, strength, sample_rate=rate, hop=self.hop, window=self.window)
        self._kept = (self.later or self.window) + self.hop * (_MEMORY + 2 * _SKIPPED) + round(_BEFORE * rate)
        self.ears = self._silence()
        locator.prepare(*(each for each in (self.window, self.later) if each is not None))

    def hear(self, block: Float[Tensor, " samples"]) -> list[Blow]:
        """Return the answers that the next samples of the stream complete, in the order of time.

        Raises LocationError for samples that are not finite; the stream goes on as if they had not come.
        """
        begun = time.perf_counter()
        if not bool(torch.isfinite(block).all()):
            raise LocationError(
                "block: expected finite samples, got NaN or infinity; leave them out or send zeros", name="block"
            )
        clear, rumble = self._without_rumble(block.detach().double().cpu(), self.ears.rumble)
        ears = replace(self.ears, rest=torch.cat([self.ears.rest, clear]), rumble=rumble)
        came = ears.clock + len(ears.rest)
        answers: list[Blow] = []
        while len(ears.rest) >= self.hop:
            ears, answer = self._take(ears)
            if answer is not None:
                waited = (came - round(answer.seconds * self.rate)) / self.rate
                answers.append(replace(answer, latency=waited + time.perf_counter() - begun))
        self.ears = ears
        return answers

    def _silence(self) -> Ears:
        nothing = torch.zeros(0, dtype=torch.float64)
        sections = 0 if self.filter is None else len(self.filter)
        still = torch.zeros(len(self._modes.poles), dtype=torch.complex128)
        rumble = torch.zeros(sections, 2, dtype=torch.float64)
        return Ears(0, nothing, nothing, nothing, still, None, rumble, 0, "")

    def _take(self, ears: Ears) -> tuple[Ears, Blow | None]:
        """Take one hop, and the answer that it completes."""
        new, foretold = ears.rest[: self.hop], self._modes.hear(ears.ringing, self.hop)
        heard = torch.cat([ears.heard, new])[-self._kept :]
        unexplained = torch.cat([ears.unexplained, new - foretold])[-self._kept :]
        ears = replace(
            ears,
            clock=ears.clock + self.hop,
            rest=ears.rest[self.hop :],
            heard=heard,
            unexplained=unexplained,
            ringing=ears.ringing * self._modes.hop,
        )
        if ears.pending is None or ears.pending.answered:
            return self._watch(ears, float(foretold.square().mean()))
        return self._answer(ears, ears.pending)

    def _watch(self, ears: Ears, ringing: float) -> tuple[Ears, Blow | None]:
        """Look for a new blow in the last hop; correct the ringing and give the later answer while there is none."""
        pending, answer = ears.pending, None
        struck = self._jumped(ears.unexplained, ringing)
        if pending is not None and (struck or ears.clock - pending.onset >= (self.later or 0)):
            # The hop in which the next blow began is left out.
            end = ears.clock - self.hop * (_SKIPPED if struck else 0)
            length = min(end - pending.onset, self.later or 0)
            ears = replace(ears, pending=None)
            if length > self.window:
                ears, answer = self._located(ears, pending, length, final=True)
        if struck:
            start = ears.clock - self.hop
            before = self._modes.after(ears.ringing, -self.hop)
            return replace(ears, pending=Pending(start, before, start, answered=False)), answer
        if ears.clock // self.hop % _BETWEEN == 0 and self._settled(ears):
            ears = self._corrected(ears, ears.clock - self.window)
        return ears, answer

    def _answer(self, ears: Ears, pending: Pending) -> tuple[Ears, Blow | None]:
        """Give the first answer as soon as a whole window of the blow was heard."""
        if ears.clock < pending.onset + self.hop + self.window:
            return ears, None
        onset = self._onset(ears, pending)
        if ears.clock < onset + self.window:
            return replace(ears, pending=replace(pending, onset=onset)), None
        begun = replace(pending, onset=onset, answered=True)
        ears, answer = self._located(ears, begun, self.window, final=self.later is None)
        more = answer is not None and self.later is not None
        return replace(self._corrected(ears, onset), pending=begun if more else None), answer

    def _located(self, ears: Ears, pending: Pending, length: int, *, final: bool) -> tuple[Ears, Blow | None]:
        """Locate so many samples of a blow, without the ringing of earlier ones; None where that is refused."""
        earlier = self._modes.after(pending.earlier, pending.onset - pending.since)
        start = len(ears.heard) - (ears.clock - pending.onset)
        sound = ears.heard[start : start + length] - self._modes.hear(earlier, length)
        try:
            found = judged(self.locator.locate(sound.float()))
            if found.refusal is not None:
                raise LocationError(f"the impact: {found.refusal}", name="impact", value=pending.onset / self.rate)
        except LocationError as error:
            return replace(ears, strangers=ears.strangers + 1, refusal=str(error)), None
        return ears, Blow(pending.onset / self.rate, found, length / self.rate, 0.0, final)

    def _jumped(self, unexplained: Float64[Tensor, " heard"], ringing: float) -> bool:
        """Return whether the last hop's energy stands above what was before it."""
        count = min(_MEMORY + _SKIPPED + 1, len(unexplained) // self.hop)
        hops = unexplained[len(unexplained) - count * self.hop :].reshape(count, self.hop).square().mean(1)
        known = hops[: -_SKIPPED - 1]
        return len(known) >= _LEAD and float(hops[-1]) > _JUMP * (float(known.max()) + _MISFIT * ringing)

    def _settled(self, ears: Ears) -> bool:
        """Return whether the last window holds no part of a blow's beginning that the ringing was not fitted to."""
        since = 0 if ears.pending is None else ears.pending.onset
        return ears.clock - self.window >= since and len(ears.heard) >= self.window

    def _onset(self, ears: Ears, pending: Pending) -> int:
        """Return a blow's first sample, found as in recordings."""
        behind = min(len(ears.unexplained), ears.clock - pending.onset + round(_BEFORE * self.rate))
        there = ears.unexplained[len(ears.unexplained) - behind :]
        return ears.clock - behind + find_onset(there.numpy(), sample_rate=self.rate)

    def _corrected(self, ears: Ears, start: int) -> Ears:
        """Add to the ringing what of the modes is left unexplained in the window from sample `start` on."""
        first = len(ears.unexplained) - (ears.clock - start)
        last = first + self.window
        quiet = ears.unexplained[max(0, first - self.window) : first]
        noise = float(quiet.square().mean()) if len(quiet) else 0.0
        found = self._modes.fit(ears.unexplained[first:last], noise)
        explained = self._modes.hear(found, ears.clock - start)
        unexplained = torch.cat([ears.unexplained[:first], ears.unexplained[first:] - explained])
        return replace(
            ears, unexplained=unexplained, ringing=ears.ringing + self._modes.after(found, ears.clock - start)
        )

    def _without_rumble(
        self, block: Float64[Tensor, " samples"], state: Float64[Tensor, "sections 2"]
    ) -> tuple[Float64[Tensor, " samples"], Float64[Tensor, "sections 2"]]:
        if self.filter is None or not len(block):
            return block, state
        passed, after = sosfilt(self.filter, block.numpy(), zi=state.numpy())
        return torch.from_numpy(passed), torch.from_numpy(after)
