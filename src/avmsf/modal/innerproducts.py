"""Inner products over time: of damped sines with each other, and of sounds with damped sines.

With z = exp((-d + 2 pi i f) / rate) the former are geometric series, sum_n n^p (z_i z_j)^n, and have a closed form: the
normal equations of any number of modes cost nothing that grows with the length of the sounds. Only the products of the
sounds with the modes do. All on the processor and without gradients.
"""

import math
from typing import no_type_check

import torch
from jaxtyping import Complex128, Float, Float64
from torch import Tensor

from avmsf.compiled import compiled
from avmsf.modal.bank import ModalBank

_BLOCK = 512
_DEAD = 1e-12
"""Part of its beginning below which a mode is no longer followed."""


def poles_of(bank: ModalBank, sample_rate: float) -> Complex128[Tensor, " modes"]:
    """Return z = exp((-d + 2 pi i f) / rate), the factor by which each mode turns and shrinks from sample to sample."""
    return torch.exp(torch.complex(-bank.damping, 2 * math.pi * bank.frequency) / sample_rate)


def gram(poles: Complex128[Tensor, " modes"], samples: int, *, power: int) -> Float64[Tensor, "two_modes two_modes"]:
    """Return inner products over time, weighted by n^power (0, 1 or 2), of all sines and cosines with each other."""
    products = torch.empty(2 * len(poles), 2 * len(poles), dtype=torch.float64)
    _gram(poles.numpy(), (poles**samples).numpy(), samples, power, products.numpy())
    return products


def own_gram(poles: Complex128[Tensor, " modes"], samples: int) -> Float64[Tensor, "modes 2 2"]:
    """Return the inner products over time of each mode's own sine and cosine: the two by two blocks of `gram`."""
    blocks = torch.empty(len(poles), 2, 2, dtype=torch.float64)
    _own_gram(poles.numpy(), (poles**samples).numpy(), samples, 0, blocks.numpy())
    return blocks


@compiled(error_model="numpy", nogil=True)
@no_type_check
def _power_sum(ratio, last, samples, power):
    """Return the sum over n < samples of n^power ratio^n, in closed form; `last` is ratio^samples."""
    rest = 1.0 - ratio
    if (rest.real**2 + rest.imag**2) * samples**2 < 1.0:
        # The fractions lose their digits where hardly anything decays or turns over the whole sound.
        return _steady_sum(ratio, samples, power)
    plain = (1.0 - last) / rest
    if power == 0:
        return plain
    first = (ratio * plain - samples * last) / rest
    if power == 1:
        return first
    return (ratio * (2.0 * first + plain) - float(samples) * samples * last) / rest


@compiled(error_model="numpy", nogil=True)
@no_type_check
def _steady_sum(ratio, samples, power):
    """Return the sum over n < samples of n^power ratio^n for a ratio near one, doubling its length again and again."""
    plain, first, second = 0.0j, 0.0j, 0.0j
    length, bit = 0.0, 1
    while 2 * bit <= samples:
        bit *= 2
    while bit > 0:
        turned = ratio**length
        second += turned * (second + 2.0 * length * first + length * length * plain)
        first += turned * (first + length * plain)
        plain += turned * plain
        length *= 2.0
        if samples & bit:
            turned = ratio**length
            plain, first, second = plain + turned, first + length * turned, second + length * length * turned
            length += 1.0
        bit //= 2
    if power == 0:
        return plain
    return first if power == 1 else second


@compiled(error_model="numpy", nogil=True)
@no_type_check
def _gram(poles, last, samples, power, products):
    """Write what `gram` returns; symmetric, so that half of the sums are enough."""
    modes = len(poles)
    for row in range(modes):
        for column in range(row, modes):
            straight = _power_sum(poles[row] * poles[column], last[row] * last[column], samples, power)
            mirrored, last_mirrored = poles[column].conjugate(), last[column].conjugate()
            crossed = _power_sum(poles[row] * mirrored, last[row] * last_mirrored, samples, power)
            sines, cosines = 0.5 * (crossed.real - straight.real), 0.5 * (crossed.real + straight.real)
            sine_cosine, cosine_sine = 0.5 * (straight.imag + crossed.imag), 0.5 * (straight.imag - crossed.imag)
            products[row, column] = products[column, row] = sines
            products[row, modes + column] = products[modes + column, row] = sine_cosine
            products[modes + row, column] = products[column, modes + row] = cosine_sine
            products[modes + row, modes + column] = products[modes + column, modes + row] = cosines


@compiled(error_model="numpy", nogil=True)
@no_type_check
def _own_gram(poles, last, samples, power, blocks):
    """Write what `own_gram` returns, where `power` is 0: a literal would have the sums compiled once more."""
    for mode in range(len(poles)):
        pole, end = poles[mode], last[mode]
        straight = _power_sum(pole * pole, end * end, samples, power)
        crossed = _power_sum(pole * pole.conjugate(), end * end.conjugate(), samples, power)
        blocks[mode, 0, 0], blocks[mode, 1, 1] = (
            0.5 * (crossed.real - straight.real),
            0.5 * (crossed.real + straight.real),
        )
        blocks[mode, 0, 1] = blocks[mode, 1, 0] = 0.5 * straight.imag


def project(
    sounds: Float[Tensor, "contacts samples"], poles: Complex128[Tensor, " modes"], *, weighted: bool = False
) -> tuple[Float64[Tensor, "contacts two_modes"], Float64[Tensor, "contacts two_modes"] | None]:
    """Return the sounds' inner products with all sines and cosines, and with n times them if `weighted`.

    All in float64: what two modes of nearly one frequency share cancels in the solution, and float32 products would
    leave only rounding of the rest. A mode is followed until it has fallen below 1e-12 of its beginning: most die
    long before the sound ends.
    """
    samples, wide = sounds.shape[1], sounds.to(torch.float64)
    needed = math.log(_DEAD) / torch.log(poles.abs()).clamp_max(-1e-300)
    inner = torch.zeros(len(sounds), len(poles), dtype=torch.complex128)
    outer = torch.zeros_like(inner)
    upper, length = math.inf, samples
    while upper > 0:
        lower = length // 2 if length > 2 * _BLOCK else 0
        group = torch.nonzero((needed > lower) & (needed <= upper)).flatten()
        if len(group):
            inner[:, group], outer[:, group] = _project(
                wide[:, : math.ceil(length / _BLOCK) * _BLOCK], poles[group], weighted
            )
        upper, length = lower, lower
    products = torch.cat([inner.imag, inner.real], dim=1)
    return products, torch.cat([outer.imag, outer.real], dim=1) if weighted else None


def _project(
    sounds: Float64[Tensor, "contacts samples"], poles: Complex128[Tensor, " modes"], weighted: bool
) -> tuple[Complex128[Tensor, "contacts modes"], Complex128[Tensor, "contacts modes"]]:
    """Return the sums over n of sound z^n and, if `weighted`, of n sound z^n (zero if not).

    By blocks, as in `synthesize`: z^(mK + k) = z^(mK) z^k.
    """
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
    plain = torch.zeros(2, len(sounds), len(poles), dtype=torch.float64)
    outer = torch.zeros_like(plain)
    _over_blocks(
        summed.numpy(), starts.real.contiguous().numpy(), starts.imag.contiguous().numpy(), plain.numpy(), outer.numpy()
    )
    return torch.complex(*plain), torch.complex(*outer)


@compiled(fastmath={"contract"}, error_model="numpy", nogil=True)
@no_type_check
def _over_blocks(summed, real, imaginary, plain, outer):
    """Add up the blocks' sums, each turned and shrunk to where its block starts; real and imaginary parts apart."""
    contacts, blocks, columns = summed.shape
    modes = real.shape[1]
    for contact in range(contacts):
        for block in range(blocks):
            part, turn, turned, offset = summed[contact, block], real[block], imaginary[block], float(block * _BLOCK)
            for mode in range(modes):
                one, other = part[mode], part[modes + mode]
                plain[0, contact, mode] += turn[mode] * one - turned[mode] * other
                plain[1, contact, mode] += turn[mode] * other + turned[mode] * one
            if columns > 2 * modes:
                for mode in range(modes):
                    one = part[2 * modes + mode] + offset * part[mode]
                    other = part[3 * modes + mode] + offset * part[modes + mode]
                    outer[0, contact, mode] += turn[mode] * one - turned[mode] * other
                    outer[1, contact, mode] += turn[mode] * other + turned[mode] * one


def _powers(poles: Complex128[Tensor, " modes"], count: int) -> Complex128[Tensor, "count modes"]:
    """Return z^0 to z^(count - 1), by doubling: a product costs a twentieth of a power, and rounds no worse."""
    table = torch.ones(1, len(poles), dtype=poles.dtype)
    while len(table) < count:
        table = torch.cat([table, table * poles ** len(table)])
    return table[:count]
