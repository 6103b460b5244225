"""DiffSound as a renderer: an object's elastic modes, of a material fitted to its recordings.

The sound of an impact at x along n is the sum over modes of

    level w_i (phi_i(x) . n) / (2 pi f_i) exp(-d_i t) sin(2 pi f_i t),

with mass-normalized shapes phi_i, damped frequencies f_i and dampings d_i of the damping curve: the displacement that
an impulse sets each mode in motion with. One level, or with `weighted` a non-negative weight w_i for each mode, makes
the magnitudes of spectra those of the training recordings, by least squares. Jin et al. (DiffSound, SIGGRAPH 2024)
publish neither gains by position nor a level; Li et al. compare with "position-specific impact sounds" simulated "from
the object's vibration modes" and add their learned residual noise, as here."""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.optimize
import torch
from jaxtyping import Complex, Float, Float64
from torch import Tensor

from avmsf.baselines.diffsound.body_family import BodyFamily
from avmsf.baselines.diffsound.material_fit import (
    DampingCurve,
    DiffSoundConfig,
    MaterialFit,
    clip_spectra,
    damped_frequency,
    fit_material,
)
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError, LocationError
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.modal.config import scaled_fft_size
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.modal.modes import ModalBank, cosine_distance, synthesize
from avmsf.modal.residual_noise import Residual, low_fluctuation_noise
from avmsf.modal.spectra import magnitude_stft

_FFT_SIZE = 2048
"""Samples at 44.1 and 48 kHz of the spectra that levels are fitted to."""

Contacts = Float[Tensor, "contacts 3"]
"""Points in the object frame, meters; or as directions, unit vectors."""


@dataclass(frozen=True, eq=False)
class DiffSound:
    """Modes of a body of a fitted material, their weights, and the residual noise of the recordings."""

    fit: MaterialFit
    elastic: ElasticModes
    """Modes that are rendered, of density 1."""
    bank: ModalBank
    """Their damped frequencies, below half the sample rate, and dampings."""
    weight: Float64[Tensor, " modes"]
    """Level times w_i: the recordings' unit per simulated displacement."""
    noise: Float[Tensor, " samples"]
    """What is added to the modes' sounds, as long as they are."""
    sample_rate: float
    """Hz."""

    @property
    def report(self) -> dict[str, Any]:
        """What was fitted, as plain values."""
        return {name: getattr(self.fit, name) for name in ("stiffness", "poisson", "thickness", "difference")}

    def gains(self, contacts: Contacts, *, directions: Contacts | None = None) -> Float64[Tensor, "contacts modes"]:
        """Return signed amplitudes of exp(-d t) sin(2 pi f t), in the recordings' unit.

        `directions` are unit vectors along which the hammer moves; without them it moves straight into the surface.
        """
        return _displacements(self.elastic, self.bank, contacts, directions) * self.weight

    def complex_gains(
        self, contacts: Contacts, *, directions: Contacts | None = None
    ) -> Complex[Tensor, "contacts modes"]:
        """Return amplitudes A, -i times `gains`: sounds are the real part of the sum of A exp((-d + 2 pi i f) t)."""
        gains = self.gains(contacts, directions=directions)
        return torch.complex(torch.zeros_like(gains), -gains)

    def render(self, contacts: Contacts, *, directions: Contacts | None = None) -> Float[Tensor, "contacts samples"]:
        """Return the sound of an impact at each contact, in the unit of the training sounds."""
        gains, bank, samples = self.gains(contacts, directions=directions).float(), self.bank, len(self.noise)
        sounds = synthesize(gains, bank.frequency, bank.damping, samples=samples, sample_rate=self.sample_rate)
        return sounds + self.noise.to(sounds)

    def distance(
        self, gains: Float64[Tensor, "points modes"], sound: Float[Tensor, " samples"]
    ) -> Float64[Tensor, " points"]:
        """Return the cosine distance of points' `gains` from those in a sound, 0 to 1 (see `cosine_distance`).

        The sound starts about at its onset and has the renderer's sample rate. Raises LocationError where it is silent
        or not finite.
        """
        audible = sound.detach().cpu()[: len(self.noise)].double()
        if not bool(torch.isfinite(audible).all()) or not bool(audible.any()):
            wanted, advice = "finite samples that are not all 0", "record the impact again"
            raise LocationError.expected(wanted, got="others", name="sound", advice=advice)
        found = fit_gains(audible[None], self.bank, sample_rate=self.sample_rate)[0]
        return cosine_distance(gains.to(torch.complex64), found, self.bank.frequency)


def fit_diffsound(
    train: Impacts,
    family: BodyFamily,
    extraction: Extraction,
    config: DiffSoundConfig | None = None,
    *,
    weighted: bool = False,
) -> DiffSound:
    """Return DiffSound fitted to recordings; `extraction` are their free modes and residual noise.

    Raises EvaluationError as `clip_spectra`, `DampingCurve.of` and `fit_material` do.
    """
    found, curve = _fitted(train, family, extraction, config), DampingCurve.of(extraction.bank)
    return leveled(found, curve, train, extraction.residual, weighted=weighted)


@lru_cache(maxsize=1)
def _fitted(train: Impacts, family: BodyFamily, extraction: Extraction, config: DiffSoundConfig | None) -> MaterialFit:
    """Return the material; of the same objects as the last time, as with and without weights, without a new fit."""
    return fit_material(clip_spectra(train), DampingCurve.of(extraction.bank), family, config)


def leveled(fit: MaterialFit, curve: DampingCurve, train: Impacts, residual: Residual, *, weighted: bool) -> DiffSound:
    """Return the renderer of a fitted material, its level or weights fitted to the recordings.

    Raises EvaluationError where no mode lies below half the sample rate.
    """
    elastic = fit.modes()
    damping = curve(elastic.frequency)
    audible = damped_frequency(elastic.frequency, damping)
    inside = torch.nonzero((audible > 1.0) & (audible < 0.5 * train.sample_rate)).flatten()
    if not len(inside):
        wanted = f"modes below {0.5 * train.sample_rate:g} Hz"
        raise EvaluationError.expected(wanted, 0, got="none", name="frequency", advice="give the mesh's unit")
    elastic = replace(elastic, frequency=elastic.frequency[inside], shapes=elastic.shapes[:, inside].contiguous())
    bank = ModalBank(audible[inside], damping[inside])
    weight = _weights(_displacements(elastic, bank, train.contacts, train.directions), bank, train, weighted=weighted)
    noise = low_fluctuation_noise(residual.magnitude, samples=train.sounds.shape[1])
    return DiffSound(fit, elastic, bank, weight, noise, train.sample_rate)


def _displacements(
    elastic: ElasticModes, bank: ModalBank, contacts: Contacts, directions: Contacts | None
) -> Float64[Tensor, "contacts modes"]:
    """Return the amplitudes of the displacement that an impulse of 1 Ns sets the modes in motion with."""
    places = contacts.detach().cpu()
    into = -elastic.normals(places)
    if directions is not None:
        given = directions.detach().cpu().double()
        # One of length zero is unknown.
        into = torch.where(given.norm(dim=1, keepdim=True) > 0.0, given, into)
    return elastic.gains(places, into) / (2.0 * math.pi * bank.frequency)


def _weights(
    displacements: Float64[Tensor, "contacts modes"], bank: ModalBank, train: Impacts, *, weighted: bool
) -> Float64[Tensor, " modes"]:
    """Return non-negative factors on the modes, all the same unless `weighted`, by least squares.

    Compared are the magnitudes of spectra with the sum of the modes' own: phases of modes whose frequencies are not
    exact mean nothing. Raises EvaluationError where all recordings are silent, or no mode moves at their contacts.
    """
    atoms = synthesize(
        torch.eye(len(bank), dtype=torch.float64), bank.frequency, bank.damping, samples=train.sounds.shape[1],
        sample_rate=train.sample_rate,
    )  # fmt: skip
    size = scaled_fft_size(_FFT_SIZE, sample_rate=train.sample_rate)
    own = magnitude_stft(atoms, fft_size=size, hop=size // 4).flatten(1)
    inner = own @ own.T
    gram, products = torch.zeros_like(inner), torch.zeros(len(bank), dtype=torch.float64)
    for sound, row in zip(train.sounds.detach().cpu().double(), displacements.abs(), strict=True):
        recorded = magnitude_stft(sound[None], fft_size=size, hop=size // 4).flatten()
        gram += row[:, None] * row * inner
        products += row * (own @ recorded)
    energy = float(gram.sum())
    if not energy > 0.0 or not float(products.sum()) > 0.0:
        wanted, got = "sounds and displacements above 0 at a contact", f"none of {len(train)}"
        raise EvaluationError.expected(wanted, 0.0, got=got, name="train", advice="record them again")
    if not weighted:
        return torch.full((len(bank),), float(products.sum()) / energy, dtype=torch.float64)
    # Modes that do not move at any contact have no weight to fit; scaled columns keep the others' size in view.
    scale = gram.diagonal().clamp_min(1e-12 * float(gram.diagonal().max())).sqrt()
    normal = (gram / scale[:, None] / scale).numpy()
    values, vectors = np.linalg.eigh(normal)
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    target = np.linalg.lstsq(root.T, (products / scale).numpy(), rcond=None)[0]
    return torch.from_numpy(scipy.optimize.nnls(root, target)[0]) / scale
