"""How well recordings support each pole, and which poles are modes of the object.

A pole is judged by what moving it in one recording alone would gain there. The others' poles stay, all amplitudes are
fitted again; one Gauss-Newton step gives the recording's own frequency and damping, and the energy gained: its misfit.

**Modes and supporting poles.** Selection compares a pole with the background noise. Measured sounds leave more than
that: a mode's frequency differs a little between recordings, its decay is not exactly exponential, the remains of a
strong mode cover its neighborhood. A pole that is fitted to such remains explains about as much energy as its misfit:
each is what two parameters explain, two amplitudes or two coordinates of a pole. If both are of one level, whatever it
is in each recording, misfit / (misfit + explained) is uniform between 0 and 1, the tail probability of an F(2, 2)
distribution, and the sum of its negative logarithms over n recordings has a gamma distribution of shape n (R. A.
Fisher, Statistical Methods for Research Workers, 1932, section 21.1).

Where one mode's pole differs between recordings, extraction finds it twice, nearer to itself than its width: the sum
of the two follows the pole as it moves. The second one's amplitudes then follow the first one's from contact to
contact, whereas two modes of a nearly round object have independent shapes. The squared correlation of two independent
real shapes over n recordings has a beta distribution with parameters 1/2 and (n - 1) / 2; where a few recordings
outweigh the others, n is the number of equal ones of which chance would make as much.

A pole that falls to 1/e within one period has no pitch, whatever it explains: it describes a thud or an onset.

Poles that fail a test stay in the model, for held-out sounds are predicted worse without them
(docs/decisions/mode-quality.md).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Complex128, Float, Float64
from scipy.special import betaincc, gammaincc
from torch import Tensor

from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.least_squares import NormalEquations
from avmsf.modal.inner_products import poles_of
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import background_power

_MAX_FALSE_MODES = 0.1
"""Expected number of wrong decisions in a capture, by each of the two tests: as for selection (`chance_ratio`)."""


@dataclass(frozen=True, eq=False)
class ModeQuality:
    """How well the recordings support each pole of an extraction."""

    frequency_spread: Float64[Tensor, " modes"]
    """Root mean square distance of the recordings' own frequencies, each weighted by how well it determines it, Hz."""
    damping_spread: Float64[Tensor, " modes"]
    """The same of the dampings, 1/s."""
    coherence: Float64[Tensor, " modes"]
    """Coherence of the phase over recordings: one if it is the same in all modulo pi, about n^(-1/2) if random."""
    energy_share: Float64[Tensor, " modes"]
    """Part of the energy of all modes, each taken alone; they sum to one."""
    explained_left_out: Float64[Tensor, " modes"]
    """Energy that the pole explains in a recording that it was refined without, over what that recording's own pole
    explains there, both to first order; summed over recordings. One for a mode of unchanging pole, about one half by
    chance."""
    is_mode: Bool[Tensor, " modes"]
    """Whether it is a mode by all tests; if not, it supports the model of a mode or of the remains near it."""


def measure_quality(
    sounds: Float[Tensor, "contacts samples"], extraction: Extraction, *, sample_rate: float
) -> ModeQuality:
    """Return the quality of each pole, from the sounds that an extraction's gains are of (`Extraction.aligned`)."""
    bank, sounds = extraction.bank, extraction.at_common_poles(sounds, sample_rate=sample_rate)
    centered = sounds - sounds.mean(1, keepdim=True)
    loudness = centered.square().mean(1).sqrt()
    audible = loudness > 0
    scaled = (centered[audible] / loudness[audible, None]).double()
    system = NormalEquations.of(scaled, poles_of(bank, sample_rate), weighted=True)
    explained, _ = system.lost_without()
    unexplained, spread, explained_left_out = _own_moves(*system.own_step(sample_rate), explained)
    amplitudes = extraction.gains.to(torch.complex128)
    energy = (amplitudes.abs().square() / bank.damping).sum(0)
    # Loud recordings count no more than others for phases and shapes.
    amplitudes = amplitudes[audible] / loudness[audible, None]
    pitched, contacts, level = bank.damping < bank.frequency, len(scaled), _MAX_FALSE_MODES / len(bank)
    logarithms = torch.log1p(explained / unexplained.clamp_min(torch.finfo(torch.float64).tiny)).sum(0)
    by_energy = torch.from_numpy(gammaincc(contacts, logarithms.numpy())) < level
    # Noise alone gains its power times a chi-squared variable of two degrees of freedom in each recording; of a pole
    # that has no more misfit than that, selection has already tested what it explains.
    noise = unexplained / background_power(scaled, bank, sample_rate)
    only_noise = torch.from_numpy(gammaincc(contacts, noise.sum(0).numpy() / 2)) > level
    standing = torch.nonzero(pitched & (by_energy | only_noise)).flatten()
    # A double of what is no mode itself may be the mode that both are of.
    part = bank.take(standing)
    double = _doubles(part, amplitudes[:, standing], explained[:, standing].sum(0), level=level)
    is_mode = torch.zeros(len(bank), dtype=torch.bool)
    is_mode[standing[~double]] = True
    return ModeQuality(
        frequency_spread=spread[:, 0],
        damping_spread=spread[:, 1],
        coherence=amplitudes.square().sum(0).abs() / amplitudes.abs().square().sum(0),
        energy_share=energy / energy.sum(),
        explained_left_out=explained_left_out,
        is_mode=is_mode,
    )


def _own_moves(
    hessian: Float64[Tensor, "contacts modes 2 2"],
    slope: Float64[Tensor, "contacts modes 2"],
    explained: Float64[Tensor, "contacts modes"],
) -> tuple[Float64[Tensor, "contacts modes"], Float64[Tensor, "modes 2"], Float64[Tensor, " modes"]]:
    """Return what one Gauss-Newton step of each pole, (frequency Hz, damping 1/s), in each recording alone says.

    First the energy that the recording gains by it, then the root mean square of the steps, weighted by the information
    about each coordinate, and the part that poles without a recording's influence explain there, of what its own pole
    explains.
    """
    move = _times(_inverse(hessian), slope)
    unexplained, weight = (slope * move).sum(-1), torch.diagonal(hessian, dim1=-2, dim2=-1)
    spread = ((weight * move.square()).sum(0) / weight.sum(0)).sqrt()
    common = _times(_inverse(hessian.sum(0)), slope.sum(0))
    alone = slope - _times(hessian, common)
    others = _times(_inverse(hessian.sum(0) - hessian), -alone)
    bent = (others * _times(hessian, others)).sum(-1)
    # Never less than nothing: a recording may give the mode no amplitude.
    left_out = (explained + 2 * (alone * others).sum(-1) - bent).clamp_min(0)
    return unexplained, spread, left_out.sum(0) / (explained + unexplained).sum(0)


def _doubles(
    bank: ModalBank,
    amplitudes: Complex128[Tensor, "contacts modes"],
    explained: Float64[Tensor, " modes"],
    *,
    level: float,
) -> Bool[Tensor, " modes"]:
    """Return which poles only follow one that explains more, within the narrower one's half-power bandwidth."""
    width = torch.minimum(bank.damping[:, None], bank.damping[None, :]) / math.pi
    near = (bank.frequency[:, None] - bank.frequency[None, :]).abs() < width
    near &= explained[:, None] < explained[None, :]
    power = amplitudes.abs().square()
    product = (power.sum(0)[:, None] * power.sum(0)[None, :]).clamp_min(torch.finfo(torch.float64).tiny)
    correlation = ((amplitudes.mH @ amplitudes).abs().square() / product).clamp_max(1.0)
    # With random signs the squared correlation is one over this in the mean: as of so many recordings of equal weight.
    effective = product / (power.T @ power).clamp_min(torch.finfo(torch.float64).tiny)
    freedom = (effective - 1).clamp_min(torch.finfo(torch.float64).eps)
    chance = torch.from_numpy(betaincc(0.5, freedom.numpy() / 2, correlation.numpy()))
    return (near & (chance < level)).any(1)


def _inverse(matrices: Float64[Tensor, "*batch 2 2"]) -> Float64[Tensor, "*batch 2 2"]:
    """Return the pseudoinverses: nothing is learned from a recording in which a mode is silent."""
    return torch.linalg.pinv(matrices, hermitian=True)


def _times(
    matrices: Float64[Tensor, "*batch 2 2"], vectors: Float64[Tensor, "*#batch 2"]
) -> Float64[Tensor, "*batch 2"]:
    return (matrices @ vectors[..., None])[..., 0]
