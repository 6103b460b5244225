"""Inner products over time: of damped sines with each other, and of sounds with damped sines.

With z = exp((-d + 2 pi i f) / rate) the former are geometric series, sum_n n^p (z_i z_j)^n, and have a closed form: the
normal equations of any number of modes cost nothing that grows with the length of the sounds. Only the products of the
sounds with the modes do. All on the processor and without gradients.
"""

import math

import numpy as np
import torch
from jaxtyping import Complex128, Float, Float64
from torch import Tensor

from avmsf.modal.modes import ModalBank

_BLOCK = 512


def poles_of(bank: ModalBank, sample_rate: float) -> Complex128[Tensor, " modes"]:
    """Return z = exp((-d + 2 pi i f) / rate), the factor by which each mode turns and shrinks from sample to sample."""
    return torch.exp(torch.complex(-bank.damping, 2 * math.pi * bank.frequency) / sample_rate)


def gram(poles: Complex128[Tensor, " modes"], samples: int, *, power: int) -> Float64[Tensor, "two_modes two_modes"]:
    """Return inner products over time, weighted by n^power (0, 1 or 2), of all sines and cosines with each other."""
    own, last = poles.numpy(), (poles**samples).numpy()
    straight = _power_sum(own[:, None] * own, last[:, None] * last, samples, power)
    crossed = _power_sum(own[:, None] * own.conj(), last[:, None] * last.conj(), samples, power)
    mixed = straight.imag + crossed.imag
    parts = np.block([[crossed.real - straight.real, mixed], [mixed.T, crossed.real + straight.real]])
    return torch.from_numpy(0.5 * parts)


def own_gram(poles: Complex128[Tensor, " modes"], samples: int) -> Float64[Tensor, "modes 2 2"]:
    """Return the inner products over time of each mode's own sine and cosine: the two by two blocks of `gram`."""
    own, last = poles.numpy(), (poles**samples).numpy()
    straight = _power_sum(own * own, last * last, samples, 0)
    crossed = _power_sum(own * own.conj(), last * last.conj(), samples, 0)
    parts = [crossed.real - straight.real, straight.imag, straight.imag, crossed.real + straight.real]
    return torch.from_numpy(0.5 * np.stack(parts, axis=1).reshape(-1, 2, 2))


def _power_sum(
    ratio: Complex128[np.ndarray, "*shape"], last: Complex128[np.ndarray, "*shape"], samples: int, power: int
) -> Complex128[np.ndarray, "*shape"]:
    """Return the sum over n < samples of n^power ratio^n, in closed form; `last` is ratio^samples."""
    rest = 1.0 - ratio
    # The fractions lose their digits where hardly anything decays or turns over the whole sound.
    steady = np.abs(rest) * samples < 1.0
    rest[steady] = 1.0
    found = (1.0 - last) / rest
    if power:
        plain, found = found, (ratio * found - samples * last) / rest
        if power == 2:
            found = (ratio * (2.0 * found + plain) - float(samples) ** 2 * last) / rest
    if steady.any():
        found[steady] = _steady_sum(ratio[steady], samples, power)
    return found


def _steady_sum(ratio: Complex128[np.ndarray, " some"], samples: int, power: int) -> Complex128[np.ndarray, " some"]:
    """Return the sum over n < samples of n^power ratio^n for ratios near one, doubling its length again and again."""
    plain = first = second = np.zeros_like(ratio)
    length = 0.0
    for bit in f"{samples:b}":
        turned = ratio**length
        second = second + turned * (second + 2.0 * length * first + length * length * plain)
        first = first + turned * (first + length * plain)
        plain = plain + turned * plain
        length *= 2.0
        if bit == "1":
            turned = ratio**length
            plain, first, second = plain + turned, first + length * turned, second + length * length * turned
            length += 1.0
    return (plain, first, second)[power]


def project(
    sounds: Float[Tensor, "contacts samples"], poles: Complex128[Tensor, " modes"], *, weighted: bool = False
) -> tuple[Float64[Tensor, "contacts two_modes"], Float64[Tensor, "contacts two_modes"] | None]:
    """Return the sounds' inner products with all sines and cosines, and with n times them if `weighted`.

    All in float64: what two modes of nearly one frequency share cancels in the solution, and float32 products would
    leave only rounding of the rest. A mode is followed until it has fallen below 1e-12 of its beginning: most die
    long before the sound ends.
    """
    samples, wide = sounds.shape[1], sounds.to(torch.float64)
    needed = math.log(1e-12) / torch.log(poles.abs()).clamp_max(-1e-300)
    inner = torch.zeros(len(sounds), len(poles), dtype=torch.complex128)
    outer = torch.zeros_like(inner)
    upper, length = math.inf, samples
    while upper > 0:
        lower = length // 2 if length > 2 * _BLOCK else 0
        group = torch.nonzero((needed > lower) & (needed <= upper)).flatten()
        if len(group):
            beginning = wide[:, : math.ceil(length / _BLOCK) * _BLOCK]
            inner[:, group], outer[:, group] = _project(beginning, poles[group], weighted)
        upper, length = lower, lower
    products = torch.cat([inner.imag, inner.real], dim=1)
    return products, torch.cat([outer.imag, outer.real], dim=1) if weighted else None


def _project(
    sounds: Float64[Tensor, "contacts samples"], poles: Complex128[Tensor, " modes"], weighted: bool
) -> tuple[Complex128[Tensor, "contacts modes"], Complex128[Tensor, "contacts modes"]]:
    """Return the sums over n of sound z^n and, if `weighted`, of n sound z^n (zero if not)."""
    within = _powers(poles, _BLOCK)
    tables = [within.real, within.imag]
    if weighted:
        steps = torch.arange(_BLOCK, dtype=torch.float64)[:, None]
        tables += [steps * within.real, steps * within.imag]
    table = torch.cat(tables, dim=1)
    whole, rest = divmod(sounds.shape[1], _BLOCK)
    # A view of the whole blocks and the rest apart: padding would copy all sounds.
    blocks = sounds[:, : whole * _BLOCK].reshape(len(sounds), whole, _BLOCK)
    summed = blocks @ table
    if rest:
        summed = torch.cat([summed, (sounds[:, whole * _BLOCK :] @ table[:rest])[:, None]], dim=1)
    starts = _powers(poles**_BLOCK, summed.shape[1])
    count = len(poles)
    plain = torch.complex(summed[..., :count], summed[..., count : 2 * count])
    inner = (starts * plain).sum(1)
    if not weighted:
        return inner, torch.zeros_like(inner)
    offset = _BLOCK * torch.arange(len(starts), dtype=torch.float64)[:, None]
    outer = torch.complex(summed[..., 2 * count : 3 * count], summed[..., 3 * count :]) + offset * plain
    return inner, (starts * outer).sum(1)


def _powers(poles: Complex128[Tensor, " modes"], count: int) -> Complex128[Tensor, "count modes"]:
    """Return z^0 to z^(count - 1), by doubling: a product costs a twentieth of a power, and rounds no worse."""
    table = torch.ones(1, len(poles), dtype=poles.dtype)
    while len(table) < count:
        table = torch.cat([table, table * poles ** len(table)])
    return table[:count]
