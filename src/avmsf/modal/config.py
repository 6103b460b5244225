"""What settings name of extraction and synthesis: importing this imports nothing that computes."""

import math
from typing import Literal

from avmsf.errors import ArrayError

ExtractionMethod = Literal["high-resolution", "short-time"]
"""high-resolution: ESPRIT in subbands. short-time: the paper's, bin by bin of a short-time spectrum.

A class for each is in `avmsf.modal.extraction.extract.FINDERS`."""
PulseShape = Literal["half-sine", "hertz"]
"""How a hammer's force rises and falls: a mass on a linear spring, or on a Hertzian contact."""
MAX_CONTACT_SECONDS = 0.02
"""Longest contact of an impact, seconds."""


def scaled_fft_size(fft_size: int, *, sample_rate: float) -> int:
    """Return the FFT size that spans at `sample_rate` Hz nearly the time that `fft_size` samples span at 44.1 kHz.

    A power of two times `fft_size`, never below a quarter of it: a rate below 15.6 kHz marks a large, slow object whose
    modes need as many samples to tell apart, not a coarse recording of a small one. So 44.1 and 48 kHz have the size as
    it stands, 96 kHz twice the size, and a structure measured at 400 Hz a quarter. Hops and lengths scale alike. Raises
    ArrayError for a rate that is not positive.
    """
    if not sample_rate > 0.0:
        raise ArrayError.expected("a rate above 0 Hz", sample_rate, name="sample_rate")
    octaves = max(-2, round(math.log2(sample_rate / 44100.0)))
    return max(2, round(fft_size * 2.0**octaves))
