"""How a field is fitted, one flat record that is the command line's options too, and the kind of its file."""

import math
from dataclasses import dataclass, fields
from typing import Literal

from avmsf._utils.headers import FileKind
from avmsf.errors import FieldFileError, FitError
from avmsf.modal.config import scaled_fft_size

AUTO, NETWORK = "auto", "network"
GainModelName = Literal["auto", "network", "smooth", "thin-plate", "symmetry", "visual", "elastic"]
"""How gains vary over an object: see `avmsf.field.gains.estimator`."""

FORMAT = 8
"""Number of this format; it grows with every change that older versions could not read. Later versions read it."""
FIELD = FileKind("avmsf", "a sound field", "fit and save it again", FieldFileError, (FORMAT,))
ADDED_SETTINGS = {"positive_gains": False, "positive": False}
"""Settings of a fit and of the network that the first field files lack, and what they stand for there: files hold them
only where they differ, so that earlier versions read all others."""
REMOVED_SETTINGS = {"patience": 0}
"""Settings of a fit that this version lacks and earlier ones have: files hold these values, and any are read."""
_COUNTS = ("clusters", "width", "hidden", "interleave", "early")
_POSITIVE = ("feature_scale", "warmup_rate", "learning_rate")


@dataclass(frozen=True)
class AttentionShape:
    """The network's sizes: settings of `FitConfig`, whether dampings depend on the contact too, and whether gains are
    positive.
    """

    clusters: int
    bands: int
    width: int
    hidden: int
    layers: int
    feature_scale: float
    spatial_damping: bool = False
    projection: bool = False
    positive: bool = False


@dataclass(frozen=True)
class FitConfig:
    """Settings of a fit. The defaults are the quick recipe; `PAPER` holds the paper's."""

    clusters: int = 16
    """Regions of the object that the network attends to (paper: 128, 256 or 512)."""
    bands: int = 0
    """Octaves in the encoding of offsets; 0 uses the offsets only."""
    width: int = 64
    """Size of queries, keys and values."""
    hidden: int = 512
    """Neurons in each hidden layer."""
    layers: int = 3
    """Hidden layers."""
    projection: bool = False
    """Project what attention reads before it is joined with the contact's feature (paper)."""
    feature_scale: float = 4.0
    """Factor on the features as the network reads them: larger lets gains change over shorter distances."""
    positive_gains: bool = False
    """Pass the network's output through a softplus, as the gains of the paper's regression are not negative either."""
    warmup_rate: float = 3e-3
    """Adam's step at the start of the warm-up; it falls on a cosine to a tenth."""
    learning_rate: float = 1e-3
    """Adam's step at the start of the end-to-end stage; it falls on a cosine to a tenth (paper: 1e-2, 5e-3 or 1e-3)."""
    correction_rate: float = 1e-2
    """Adam's step for frequencies, in widths of their modes, and for the logarithms of dampings."""
    noise_rate: float = 0.0
    """Adam's step for the logarithms of the residual noise's magnitudes (paper). With 0 they are measured instead,
    after the other parameters are trained, since training ends 2.3 dB too low: see docs/decisions/residual-level.md."""
    weight_decay: float = 1.0
    """Decoupled weight decay on the network's matrices."""
    warmup_steps: int = 1000
    """Steps on the extracted gains alone (paper, eq. 13)."""
    warmup_gains: Literal["least-squares", "regression"] = "least-squares"
    """What these are: signed amplitudes by least squares, or each bin's own regression (paper, eq. 5)."""
    warmup_weights: Literal["energy", "equal"] = "energy"
    """Weights of the modes' squared errors: the energy of a unit gain over time, or all equal (paper)."""
    steps: int = 150
    """Steps end to end on spectra (paper, eq. 14); a Gaussian process takes a third of them, three times as long."""
    fft_sizes: tuple[int, ...] = (2048, 1024, 512, 256)
    """Resolutions of the spectral loss, samples at 44.1 and 48 kHz; other rates scale them in octaves."""
    hop: int = 0
    """Samples between frames at 44.1 and 48 kHz; 0 takes a quarter of each FFT size (paper: 64)."""
    interleave: int = 2
    """Each step compares every n-th frame, in turn; 1 compares all frames at every step, as the paper does."""
    spectral_norm: Literal["each", "common"] = "each"
    """Divisor of each resolution's distance. each: the norm of its recordings. common: one number for all (paper)."""
    early: int = 8192
    """Length of the beginning that is compared again, samples at 44.1 and 48 kHz."""
    early_weight: float = 1.0
    """Weight of that beginning (paper: .5, 1 or 2)."""
    damping: Literal["shared", "per-contact", "validated"] = "validated"
    """Dampings for all contacts or for each; `validated` fits both and takes the better at validation contacts."""
    validation: float = 0.25
    """Part of the training positions that choices are validated on; with fewer than 6 positions none are."""
    phase: Literal["common", "sine"] = "common"
    """Initial phases of the modes: each the common one of the training recordings, or sines (paper, eq. 3)."""
    residual: bool = True
    """Model noise in addition to the modes."""
    residual_start: Literal["beneath-modes", "quietest"] = "beneath-modes"
    """What its training starts from: the recordings without the modes, or their lowest-energy segments (paper)."""
    residual_noise: Literal["low-fluctuation", "gaussian"] = "low-fluctuation"
    """Noise that is filtered to the residual's spectrum when the field is rendered: a fixed sequence whose spectrogram
    hardly fluctuates, 1.7 dB below a recording's noise, or a random draw at its level (paper)."""
    seed: int = 0
    """Seed of the random numbers: initial weights, noise in training, and rendered Gaussian noise."""

    def __post_init__(self) -> None:
        if not isinstance(self.seed, int):
            raise FitError.expected("a whole number", self.seed, name="seed")
        for each in fields(self):
            value, least = getattr(self, each.name), 1 if each.name in _COUNTS else 0
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            if not least <= value < math.inf or (each.name in _POSITIVE and value == 0):
                wanted = "more than 0" if each.name in _POSITIVE else f"{least} or more"
                raise FitError.expected(wanted, value, name=each.name)
        if self.seed >= 2**63:
            raise FitError.expected("less than 2^63", self.seed, name="seed")
        if not 0 <= self.validation <= 0.5:
            raise FitError.expected("0 to 0.5 of the positions", self.validation, name="validation")
        if self.warmup_steps + self.steps == 0:
            raise FitError.expected("warmup_steps or steps of 1 or more", 0, got="0 for both", name="steps")
        # A rate as low as a structure's takes a quarter of each size, which has to be even.
        odd = [size for size in self.fft_sizes if size < 16 or size % 8]
        if odd or not self.fft_sizes:
            raise FitError.expected("one or more multiples of 8 from 16 on", self.fft_sizes, name="fft_sizes")

    @property
    def shape(self) -> AttentionShape:
        """Sizes of the network, with shared damping."""
        sizes = (self.clusters, self.bands, self.width, self.hidden, self.layers, self.feature_scale)
        return AttentionShape(*sizes, projection=self.projection, positive=self.positive_gains)

    def resolutions(self, sample_rate: float) -> tuple[tuple[int, ...], tuple[int, ...], int]:
        """Return FFT sizes, hops and the early length in samples at a sample rate, Hz."""
        sizes = tuple(scaled_fft_size(size, sample_rate=sample_rate) for size in self.fft_sizes)
        if self.hop:
            hops = (scaled_fft_size(self.hop, sample_rate=sample_rate),) * len(sizes)
        else:
            hops = tuple(max(1, size // 4) for size in sizes)
        return sizes, hops, scaled_fft_size(self.early, sample_rate=sample_rate)


PAPER = FitConfig(
    clusters=256,
    bands=4,
    width=128,
    hidden=256,
    layers=2,
    projection=True,
    feature_scale=1.0,
    warmup_rate=5e-3,
    learning_rate=5e-3,
    correction_rate=5e-3,
    noise_rate=5e-3,
    weight_decay=0.0,
    warmup_gains="regression",
    warmup_weights="equal",
    steps=10000,
    fft_sizes=(2048, 1024, 512, 256),
    hop=64,
    interleave=1,
    spectral_norm="common",
    early_weight=1.0,
    phase="sine",
    residual_start="quietest",
    residual_noise="gaussian",
)
"""The paper's settings where it states them (supplement, training setup), the middle of each of its lists: clusters,
learning rate, steps, resolutions, hop and the beginning's weight. It leaves the network's other sizes, the warm-up and
the beginning's length open."""
