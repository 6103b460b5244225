"""Sound files as they lie on disk: every channel, the file's own rate, nothing resampled or scaled."""

import io
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import soundfile
from jaxtyping import Float64, Shaped
from scipy.ndimage import uniform_filter1d
from scipy.special import stdtrit

from avmsf._utils.files import is_lfs_pointer
from avmsf._utils.text import listed
from avmsf.capture.filenames import similar_name
from avmsf.errors import ArrayError, CaptureError, RecordingLengthError

LOWEST_RATE = 100.0
HIGHEST_RATE = 192_000.0
MAX_SAMPLES = 1 << 24
"""Samples of one recording, in all channels: 6 minutes at 48 kHz, 134 MB as float64. A compressed file of 100 kB may
hold hours of silence."""
MIN_PEAK, MAX_PEAK = 1e-15, 1e15
"""Largest magnitude that a recording may have, in its own unit. Full scale is 1 and raw counts of 32 bits reach 2e9.
Between these the squares of `MAX_SAMPLES` samples and their sum are ordinary numbers in float32."""
MAX_CHANNEL_DIFFERENCE = 0.01
"""Share of a channel, root mean square, that another channel times a constant may leave of it where both hold one
sound: 40 dB down, less than the noise of a usable recording (`HIGHEST_NOISE_DB` in measure.py is 20)."""
_BITS = {"PCM_S8": 8, "PCM_U8": 8, "PCM_16": 16, "PCM_24": 24, "PCM_32": 32}
MIN_CHANNEL_LEVEL = 0.1
"""Level of a channel over the loudest one's below which it is not used: a muted or far microphone's, 20 dB down."""
OFFSET_SIGNIFICANCE = 1e-6
"""Probability by which noise without an offset would look as if it had one."""
_FEW_BLOCKS, _CLEAR_OFFSET = 80, 40.0
"""Blocks below which an offset has to be this many standard deviations of the quietest ones' means."""
EIGHT_BIT = frozenset({"PCM_U8", "PCM_S8", "ULAW", "ALAW", "DPCM_8"})
LOSSLESS = ("PCM_", "FLOAT", "DOUBLE", "ALAC_", "DWVW_", "DPCM_")
"""What libsndfile's names of formats without loss begin with; FLAC's is that of its samples, PCM_16 or PCM_24."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One sound file, read whole."""

    name: str
    """What messages and tables call it."""
    channels: Float64[np.ndarray, "channels frames"]
    """Integer formats as fractions of full scale, float formats as they are."""
    sample_rate: float
    """The file's own rate, Hz."""
    subtype: str
    """libsndfile's name of the sample format: PCM_16, PCM_U8, FLOAT and so on."""

    @property
    def frames(self) -> int:
        """Samples in each channel."""
        return self.channels.shape[1]

    @property
    def duration(self) -> float:
        """Seconds, as recorded."""
        return self.frames / self.sample_rate

    def error(self, wanted: str, value: Any, *, name: str, got: str | None = None, advice: str = "") -> CaptureError:
        """Return an error about this recording."""
        return CaptureError.expected(wanted, value, got=got, file=self.name, name=name, advice=advice)

    def channel(self, number: int) -> Float64[np.ndarray, " frames"]:
        """Return one channel, counted from 1 as sound editors count them; `CaptureError` where there is none."""
        if not 1 <= number <= len(self.channels):
            advice = "correct response_channel or force_channel in capture.toml"
            raise self.error(f"a channel from 1 to {len(self.channels)}", number, name="channel", advice=advice)
        return self.channels[number - 1]

    def response_channel(self, number: int | None = None, *, force_channel: int | None = None) -> int:
        """Return the number of the channel that holds the object's sound: the given one, or the only possible one.

        Without a number it is the only channel, or the only one besides the force. If all channels hold one sound up to
        a constant factor, rounding and dither, it is the first one with a sufficient level: the same channel in all
        files of a recorder, because another one might have the opposite sign. Raises `CaptureError` if several
        channels are possible.
        """
        if number is not None:
            return number
        count, wanted, key = len(self.channels), "one channel with the sound", "response_channel"
        levels = {each: float(np.std(self.channels[each - 1])) for each in range(1, count + 1) if each != force_channel}
        if not levels:
            got, advice = "only the force channel", "record both, or remove force_channel from capture.toml"
            raise self.error(wanted, 0, got=got, name=key, advice=advice)
        loudest = max(levels, key=levels.__getitem__)
        if not all(self._agree(loudest, each) for each in levels if each != loudest):
            got = f"different ones, {listed(list(map(str, levels)), separator=' and ')}"
            advice = (
                "choose one by response_channel in capture.toml (`avmsf check` proposes one where the recordings show "
                "which), or save as mono"
            )
            raise self.error(wanted, count, got=got, name=key, advice=advice)
        return next(each for each, level in levels.items() if level >= MIN_CHANNEL_LEVEL * levels[loudest])

    def response(
        self, number: int | None = None, *, force_channel: int | None = None
    ) -> Float64[np.ndarray, " frames"]:
        """Return the channel that holds the object's sound (see `response_channel`), without a constant offset."""
        sound = self.channel(self.response_channel(number, force_channel=force_channel))
        return sound - constant_offset(sound, sample_rate=self.sample_rate)

    def _agree(self, reference: int, other: int) -> bool:
        """Return whether a channel is the reference times a constant, up to rounding, dither or 1 % of itself."""
        first, second = (self.channels[number - 1] for number in (reference, other))
        first, second = first - first.mean(), second - second.mean()
        power = float(first @ first)
        rest = second - (float(first @ second) / power if power else 0.0) * first
        bits = _BITS.get(self.subtype)
        # Rounding with dither has an rms of half a step in each of the two channels.
        step = 0.0 if bits is None else 2.0 ** (1 - bits)
        return float(np.std(rest)) <= max(MAX_CHANNEL_DIFFERENCE * float(np.std(second)), step)


def constant_offset(sound: Float64[np.ndarray, " frames"], *, sample_rate: float) -> float:
    """Return the mean of the quietest tenth of 10 ms blocks, eight at least; 0 where a t-test of the blocks finds none.

    A block is as quiet as the 50 ms around it: within 10 ms, vibrations of 20 to 50 Hz vary least where they turn.
    Short sounds have 16 shorter blocks. 0 below 256 samples, too.
    """
    size = min(max(64, round(0.01 * sample_rate)), len(sound) // 16)
    if size < 16 or np.ptp(sound) < MIN_PEAK:
        return 0.0
    count = len(sound) // size
    middle = float(np.median(sound))
    blocks = (sound[: count * size] - middle).reshape(count, size)
    means, powers = blocks.mean(axis=1), np.square(blocks).mean(axis=1)
    variance = uniform_filter1d(powers, 5) - uniform_filter1d(means, 5) ** 2
    means = means[np.argsort(variance, kind="stable")[: max(8, count // 10)]] + middle
    offset, error = float(means.mean()), float(means.std(ddof=1)) / math.sqrt(len(means))
    limit = error * float(stdtrit(len(means) - 1, 1.0 - OFFSET_SIGNIFICANCE))
    if count < _FEW_BLOCKS:
        # Their few quietest blocks may lie within one cycle of a vibration, and are then not independent.
        limit = max(limit, _CLEAR_OFFSET * float(means.std(ddof=1)))
    return offset if abs(offset) > limit else 0.0


def read_recording(path: str | Path, name: str | None = None) -> Recording:
    """Read every channel of a sound file, which messages call `name`.

    Raises `CaptureError` where the file is missing, corrupt, empty or longer than `MAX_SAMPLES`, or holds samples that
    are not numbers or larger than `MAX_PEAK`.
    """
    path, name = Path(path), name or str(path)
    if os.path.isdir(path):
        raise CaptureError.expected("a sound file", got="a folder", file=name, advice="name a file in it")
    # Unlike Path.is_file, this is False for what no file can be called.
    if not os.path.isfile(path):
        near = similar_name(path.name, (each.name for each in path.parent.glob("*")))
        advice = f"did you mean {near}?" if near else "check the path"
        raise CaptureError.expected("a sound file", near, got="none", file=name, advice=advice)
    if is_lfs_pointer(path):
        raise CaptureError.expected("a sound file", got="a Git LFS pointer", file=name, advice="run git lfs pull")
    return decode_recording(path, name)


class SoundBytes(io.BytesIO):
    """A sound file in memory, for soundfile to read."""

    def seek(self, offset: int, whence: int = 0, /) -> int:
        """Move; stay where a damaged header asks for a position before the file, as a file on disk does."""
        try:
            return super().seek(offset, whence)
        except ValueError:
            return self.tell()


def decode_recording(source: Path | SoundBytes, name: str) -> Recording:
    """Read every channel of a sound file on disk or in memory. Raises `CaptureError` as `read_recording`."""
    try:
        with soundfile.SoundFile(source) as file:
            samples = file.frames * file.channels
            if samples > MAX_SAMPLES:
                got = f"{samples:,} ({file.frames / file.samplerate / 60:.3g} minutes of {file.channels})"
                wanted, advice = (
                    f"at most {MAX_SAMPLES:,} samples in all channels",
                    "cut it to the seconds around the impact",
                )
                raise RecordingLengthError.expected(wanted, samples, got=got, file=name, advice=advice)
            channels = file.read(dtype="float64", always_2d=True).T
            rate, subtype = float(file.samplerate), str(file.subtype)
    except (soundfile.LibsndfileError, OSError, TypeError, UnicodeEncodeError) as error:  # TypeError: samples alone
        reason = getattr(error, "error_string", str(error)).strip().rstrip(".")
        size = source.stat().st_size if isinstance(source, Path) else source.getbuffer().nbytes
        got, advice = f"{size} bytes that cannot be read ({reason})", "export it again as wav"
        raise CaptureError.expected("a sound file", size, got=got, file=name, name="bytes", advice=advice) from error
    wrong, peak = int((~np.isfinite(channels)).sum()), float(np.abs(channels).max(initial=0.0))
    for wanted, value, got, bad in (
        ("samples", 0, "none", not channels.size),
        ("finite samples", wrong, f"{wrong} that are not", wrong),
        (f"samples of at most {MAX_PEAK:g}", peak, f"{peak:.3g}", peak > MAX_PEAK),
    ):
        if bad:
            raise CaptureError.expected(wanted, value, got=got, file=name, advice="record or export it again")
    return Recording(name, np.ascontiguousarray(channels), rate, subtype)


def wav_bytes(
    samples: Shaped[np.ndarray, "frames *channels"], rate: int, *, coding: str = "float32", file: Path | None = None
) -> bytes:
    """Return a wav file of samples at `rate`, Hz, as float32 or int16; the same for the same samples.

    Raises ArrayError, about `file`, for samples that are not finite, and for what 16 bits would clip.
    """
    with np.errstate(over="ignore"):
        coded, memory = samples.astype(np.float32), io.BytesIO()
    wrong, peak = int((~np.isfinite(coded)).sum()), float(np.abs(coded).max(initial=0.0))
    if wrong:
        got = f"{wrong} of {coded.size} that are not"
        raise ArrayError.expected("finite samples in float32", wrong, got=got, file=file, name="samples")
    if coding == "int16":
        if round(peak * 2**15) >= 2**15:
            got, wanted = f"{peak:.3g} ({20 * math.log10(peak):+.1f} dB)", "amplitudes below 1 for 16 bits"
            advice = "normalize the peak, lower the level, or write float32"
            raise ArrayError.expected(wanted, peak, got=got, file=file, name="peak", advice=advice)
        coded = np.rint(coded * 2**15).astype(np.int16)
    scipy.io.wavfile.write(memory, rate, coded)
    return memory.getvalue()


def check_not_silent(sound: Float64[np.ndarray, " frames"], recording: Recording) -> None:
    """Raise `CaptureError` where every sample of a recording's sound is the same."""
    if np.ptp(sound) == 0:
        got = f"silence (all {len(sound)} samples are {sound[0]:g})"
        other = "choose another response_channel" if len(recording.channels) > 1 else "remove its row"
        advice = f"record it again, or {other}"
        raise CaptureError.expected("a sound", float(sound[0]), got=got, file=recording.name, advice=advice)


def clipped_samples(samples: Shaped[np.ndarray, " frames"]) -> int:
    """Count the samples that a converter or an editor has cut off: those at the very highest or lowest value.

    At full scale three of them suffice, since an unclipped sound touches its extreme once or twice. Below full scale
    (clipped first, turned down later) it takes three flat tops of three samples or more, because a soft slow wave that
    was rounded to integers has one such top too.
    """
    total = 0
    for signed in (samples, -samples):
        extreme = signed.max()
        if extreme <= 0:
            continue
        edges = np.flatnonzero(np.diff(np.concatenate(([0], (signed == extreme).view(np.int8), [0]))))
        runs = edges[1::2] - edges[::2]
        if abs(extreme - 1) > 1e-4:
            runs = runs[runs >= 3] if (runs >= 3).sum() >= 3 else runs[:0]
        total += int(runs.sum()) if runs.sum() >= 3 else 0
    return total
