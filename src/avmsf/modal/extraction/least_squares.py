"""Gains, and better modes, by linear and nonlinear least squares."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Complex, Complex128, Float, Float64, Int64
from torch import Tensor

from avmsf.modal.inner_products import gram, poles_of, project
from avmsf.modal.modes import ModalBank

_RIDGE = 1e-13
"""Relative to the Gram matrix's diagonal: keeps two modes of one frequency solvable."""


def fit_gains(
    sounds: Float[Tensor, "contacts samples"], bank: ModalBank, *, sample_rate: float
) -> Complex[Tensor, "contacts modes"]:
    """Return the gains c of `bank`'s modes, Im(c exp((-d + 2 pi i f) t)), that fit each sound best.

    Least squares over the whole sound; gains in the unit and precision of `sounds`: sines and i times cosines.
    """
    system = NormalEquations.of(sounds, poles_of(bank, sample_rate))
    return torch.complex(*system.solve().to(sounds.dtype).chunk(2, dim=1))


def fit_sine_gains(
    sounds: Float[Tensor, "contacts samples"],
    bank: ModalBank,
    *,
    sample_rate: float,
    phase: Float64[Tensor, " modes"] | None = None,
) -> Float[Tensor, "contacts modes"]:
    """Return the signed amplitudes of exp(-d t) sin(2 pi f t + phase) that fit each sound best.

    `phase` in radians, one a mode; None is zero, all that the paper's synthesis (eq. 3) can express.
    """
    system = NormalEquations.of(sounds, poles_of(bank, sample_rate))
    zero = torch.zeros_like(bank.frequency) if phase is None else phase
    # Each mode's atom as a mixture of its sine and its cosine.
    mixture = torch.cat([torch.diag(torch.cos(zero)), torch.diag(torch.sin(zero))])
    return _solve(mixture.T @ system.gram @ mixture, system.products @ mixture).to(sounds.dtype)


def refine(
    sounds: Float[Tensor, "contacts samples"], bank: ModalBank, *, sample_rate: float, iterations: int = 20
) -> ModalBank:
    """Move frequencies and dampings to where all sounds together are explained best.

    Gauss-Newton on the sum of squared residuals with the gains of every sound eliminated (variable projection, in
    Kaufman's approximation), damped after Levenberg and Marquardt; no step moves a mode by more than half its own
    width, and none leaves a mode that falls by less than a hundredth over the whole sound. Returns modes sorted by
    frequency, which explain at least as much as `bank` does.
    """
    if len(bank) == 0:
        return bank
    frequency, damping = bank.frequency.clone(), bank.damping.clone()
    resolution = sample_rate / sounds.shape[1]
    wide = sounds.to(torch.float64)
    system = NormalEquations.of(wide, poles_of(bank, sample_rate), weighted=True)
    energy, trust = system.explained(), 1e-3
    for _ in range(iterations):
        step = system.step(sample_rate, trust)
        width = torch.clamp(damping / (2 * math.pi), min=0.25 * resolution)
        moved = frequency + torch.clamp(step[0], -0.5 * width, 0.5 * width)
        decayed = damping * torch.exp(torch.clamp(step[1] / damping, -0.3, 0.3))
        decayed = torch.maximum(decayed, torch.clamp(damping, max=0.01 * resolution))
        inside = (moved > 0) & (moved < sample_rate / 2)
        moved = torch.where(inside, moved, frequency)
        trial = NormalEquations.of(wide, poles_of(ModalBank(moved, decayed), sample_rate), weighted=True)
        gained = trial.explained() - energy
        # Not "gained <= 0": a step into a singular basis gives NaN, and is refused too.
        if not gained > 0:
            trust *= 10
            if trust > 1e3:
                break
            continue
        frequency, damping, system = moved, decayed, trial
        energy, trust = energy + gained, max(trust / 5, 1e-6)
        if gained < 1e-7 * energy:
            break
    order = torch.argsort(frequency)
    return ModalBank(frequency[order], damping[order])


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of all sounds in the basis (sines, cosines) of the given poles, and what moving a pole needs."""

    gram: Float64[Tensor, "two_modes two_modes"]
    products: Float64[Tensor, "contacts two_modes"]
    mixed_gram: Float64[Tensor, "two_modes two_modes"] | None
    """Of n-weighted basis (rows) with plain basis (columns)."""
    weighted_gram: Float64[Tensor, "two_modes two_modes"] | None
    weighted_products: Float64[Tensor, "contacts two_modes"] | None

    @classmethod
    def of(
        cls, sounds: Float[Tensor, "contacts samples"], poles: Complex128[Tensor, " modes"], *, weighted: bool = False
    ) -> "NormalEquations":
        """Return the equations of the given sounds and poles, with what `step` needs besides if `weighted`."""
        samples = sounds.shape[1]
        products, weighted_products = project(sounds, poles, weighted=weighted)
        if not weighted:
            return cls(gram(poles, samples, power=0), products, None, None, None)
        mixed = gram(poles, samples, power=1)
        return cls(gram(poles, samples, power=0), products, mixed, gram(poles, samples, power=2), weighted_products)

    def take(self, modes: Int64[Tensor, " kept"]) -> "NormalEquations":
        """Return the plain equations of some of the modes alone."""
        both = torch.cat([modes, modes + self.gram.shape[0] // 2])
        return NormalEquations(self.gram[both][:, both], self.products[:, both], None, None, None)

    def solve(self) -> Float64[Tensor, "contacts two_modes"]:
        """Return the amplitudes of sines and cosines that fit each sound best."""
        return _solve(self.gram, self.products)

    def explained(self) -> float:
        """Return the energy of the sounds that their best fit explains."""
        return float((self.solve() * self.products).sum())

    def lost_without(self) -> tuple[Float64[Tensor, "contacts modes"], Float64[Tensor, " modes"]]:
        """Return what each mode is needed for, and how far the others could stand in for it.

        First the energy of each sound that goes unexplained when one mode is left out and the rest fitted anew. Then
        the part of each mode (of the phase that is worst off) that the others do not span, in energy: one for a mode
        on its own, near zero where modes cancel each other.
        """
        scale = torch.sqrt(torch.diagonal(self.gram))
        modes = len(scale) // 2
        inverse = torch.linalg.inv(_normalize(self.gram, scale)).reshape(2, modes, 2, modes)
        own = torch.diagonal(inverse, dim1=1, dim2=3).permute(2, 0, 1)
        pairs = (self.solve() * scale).reshape(-1, 2, modes).permute(2, 1, 0)
        lost = (pairs * torch.linalg.solve(own, pairs)).sum(1).T
        return lost, 1 / torch.linalg.eigvalsh(own)[:, 1]

    def step(self, sample_rate: float, trust: float) -> Float64[Tensor, "2 modes"]:
        """Return the Gauss-Newton step of (frequency Hz, damping 1/s), of `weighted` equations only."""
        blocks, by_part, residual = self._slopes(sample_rate)
        modes = by_part.shape[-1]
        weights = torch.einsum("acpi,bcqj->apibqj", by_part, by_part)
        hessian = torch.einsum("apibqj,piqj->aibj", weights, blocks).reshape(2 * modes, 2 * modes)
        slope = torch.einsum("acpi,cpi->ai", by_part, residual).reshape(-1)
        # Rounding may leave nothing, or less, of a mode that the others span.
        least = max(1e-24 * float(torch.diagonal(hessian).max()), torch.finfo(torch.float64).tiny)
        scale = torch.diagonal(hessian).clamp_min(least)
        damped = hessian + torch.diag(trust * scale)
        root = torch.sqrt(scale)
        step = torch.linalg.solve(damped / (root[:, None] * root[None, :]), slope / root) / root
        return step.reshape(2, modes)

    def own_step(
        self, sample_rate: float
    ) -> tuple[Float64[Tensor, "contacts modes 2 2"], Float64[Tensor, "contacts modes 2"]]:
        """Return the Gauss-Newton equations of each sound for each mode's (frequency, damping), the other poles fixed.

        Of `weighted` equations only. Moving the pole by x in one sound explains 2 b x - x' A x more of its energy.
        """
        blocks, by_part, residual = self._slopes(sample_rate)
        own = torch.diagonal(blocks, dim1=1, dim2=3)
        hessian = torch.einsum("acpi,bcqi,pqi->ciab", by_part, by_part, own)
        return hessian, torch.einsum("acpi,cpi->cia", by_part, residual)

    def _slopes(
        self, sample_rate: float
    ) -> tuple[
        Float64[Tensor, "2 modes 2 modes"], Float64[Tensor, "2 contacts 2 modes"], Float64[Tensor, "contacts 2 modes"]
    ]:
        """Return the weighted basis's products beside the basis, the model's slopes in it, and the residual's products.

        The slopes are those along frequency (Hz) and damping (1/s).
        """
        assert self.mixed_gram is not None
        assert self.weighted_gram is not None
        assert self.weighted_products is not None
        coefficients = self.solve()
        modes = coefficients.shape[1] // 2
        sine, cosine = coefficients[:, :modes], coefficients[:, modes:]
        # In the n-weighted basis: 2 pi n (g cos - q sin) / rate, and -n (g sin + q cos) / rate.
        by_frequency = torch.cat([-cosine, sine], dim=1) * (2 * math.pi / sample_rate)
        by_damping = torch.cat([-sine, -cosine], dim=1) / sample_rate
        slopes = torch.stack([by_frequency, by_damping])
        residual = self.weighted_products - coefficients @ self.mixed_gram.T
        projected = self.weighted_gram - self.mixed_gram @ _solve(self.gram, self.mixed_gram).T
        blocks = projected.reshape(2, modes, 2, modes)
        return blocks, slopes.reshape(2, -1, 2, modes), residual.reshape(-1, 2, modes)


def _solve(
    gram: Float64[Tensor, "basis basis"], products: Float64[Tensor, "rows basis"]
) -> Float64[Tensor, "rows basis"]:
    scale = torch.sqrt(torch.diagonal(gram))
    return torch.linalg.solve(_normalize(gram, scale), (products / scale).T).T / scale


def _normalize(
    gram: Float64[Tensor, "basis basis"], scale: Float64[Tensor, " basis"]
) -> Float64[Tensor, "basis basis"]:
    ridge = _RIDGE * torch.eye(len(scale), dtype=gram.dtype, device=gram.device)
    return gram / (scale[:, None] * scale[None, :]) + ridge
