"""DiffSound's inverse problem: material and wall thickness from recorded clips.

Jin et al. (DiffSound, SIGGRAPH 2024) predict one sound for all clips, the lowest 16 modes with the same amplitude, and
move Young's modulus and Poisson's ratio by Adam until its spectra are those of the clips: first by optimal transport,
then by differences (`avmsf.baselines.diffsound.losses`). Frequencies determine E / rho alone, not E.

What is ours: `BodyFamily` in place of an eigenvalue problem every 15 steps; the thickness of walls; the parameters are
log(E / rho), Poisson's ratio and log(thickness); steps are fewer and longer; differential evolution (Storn and Price,
1997) then searches the whole range for a smaller difference; dampings are those of extracted modes.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize
import torch
from jaxtyping import Float, Float64
from scipy.signal import butter, sosfilt
from torch import Tensor

from avmsf.baselines.diffsound.body_family import BodyFamily
from avmsf.baselines.diffsound.losses import ClipSpectra
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.isotropic import IsotropicModes
from avmsf.fem.material import MATERIALS, Material, material_named
from avmsf.modal.modes import ModalBank, synthesize
from avmsf.modal.spectra import resampled, with_length

PerMode = Float64[Tensor, " modes"]
Point = Float64[Tensor, "3"]
"""log(E / rho), Poisson's ratio and log(thickness)."""
MODES = 16
RATE = 32_000.0
"""Sample rate at which clips are compared, Hz."""
SAMPLES = 8_000
CLIPS = 8
"""Recordings that are compared at most, the first of them."""
BAND = 20.0, 16_000.0
"""Frequencies that are synthesized, Hz."""
POISSON = 0.01, 0.499
"""Range of Poisson's ratio."""
_STIFFER = 10.0
"""Largest factor on the stiffness of the material at the start, and its inverse."""
_FASTEST_DECAY = 300.0
"""Largest damping of modes that the damping curve is made of, 1/s."""
_CURVE_STEP, _CURVE_END = 500.0, 20_000.0
"""Width of the damping curve's bins, and the highest frequency, Hz."""
_INSIDE = 1e-9
"""Distance of a search's start from its bounds, over the distance between these."""
_NEAR = 0.3, 0.1, 0.1
"""Reach of the search around a thickness that was found: of log(E / rho), Poisson's ratio and log(thickness). Between
two thicknesses that are computed, thickness is off by up to 9 % (the same sheet)."""
_ROUNDS = 2
"""Thicknesses that are computed as they are found, to search again near them."""


@dataclass(frozen=True)
class DiffSoundConfig:
    """Settings of the fit of a material."""

    material: str | None = None
    """Initial material, by its name in the table of materials; None tries all."""
    transport_steps: int = 12
    """Steps by optimal transport, each with one clip; 1000, with all clips, in the published program."""
    difference_steps: int = 100
    """Steps by differences of spectra; 2000 in the published program."""
    search: int = 60
    """Generations of the following global search for a smaller difference, and half as many near a thickness that was
    found; none in the published program."""

    def __post_init__(self) -> None:
        if self.material is not None:
            material_named(self.material)


@dataclass(frozen=True)
class MaterialFit:
    """Fitted material and wall thickness of a body."""

    stiffness: float
    """E / rho, m2/s2."""
    poisson: float
    thickness: float | None
    """Mean wall thickness, meters; None for a solid body."""
    difference: float
    """Value of the objective: the mean difference of spectra."""
    body: IsotropicModes
    """The body of that thickness."""

    def modes(self) -> ElasticModes:
        """Return the body's modes, of the fitted material with a density of 1 kg/m3, which sounds do not determine."""
        return self.body.modes(Material("fitted", 1.0, self.stiffness, self.poisson, 0.0, 0.0))


@dataclass(frozen=True)
class DampingCurve:
    """The lower envelope of dampings of free modes, by frequency."""

    frequency: tuple[float, ...]
    """Middles of the bins that hold a mode, Hz, ascending."""
    damping: tuple[float, ...]
    """Least damping in each, 1/s."""

    @classmethod
    def of(cls, bank: ModalBank) -> "DampingCurve":
        """Return the curve of extracted modes. Raises EvaluationError where all die away in a few milliseconds."""
        frequency, damping = (each.detach().cpu().double().numpy() for each in (bank.frequency, bank.damping))
        slow = (damping > 0.0) & (damping < _FASTEST_DECAY) & (frequency > BAND[0]) & (frequency < _CURVE_END)
        if not slow.any():
            wanted, got = f"a mode below {_FASTEST_DECAY:g} 1/s for DiffSound", f"none of {len(bank)}"
            raise EvaluationError.expected(wanted, len(bank), got=got, name="damping")
        bins = ((frequency[slow] - BAND[0]) // _CURVE_STEP).astype(int)
        kept = np.unique(bins)
        least = [float(damping[slow][bins == each].min()) for each in kept]
        return cls(tuple(float(BAND[0] + (each + 0.5) * _CURVE_STEP) for each in kept), tuple(least))

    def __call__(self, frequency: PerMode) -> PerMode:
        """Return dampings, 1/s: linear between the bins, constant beyond the first and the last."""
        found = np.interp(frequency.detach().cpu().numpy(), self.frequency, self.damping)
        return torch.from_numpy(found).to(frequency)


def clip_spectra(impacts: Impacts) -> ClipSpectra:
    """Return the recordings as DiffSound compares them: .25 s at 32 kHz, without what is below 100 Hz, of peak 1.

    Silent recordings are left out, and those after the first `CLIPS`. Raises EvaluationError where all are silent.
    """
    sounds = resampled(impacts.sounds.detach().cpu().double(), sample_rate=impacts.sample_rate, wanted=RATE)
    high_pass = butter(2, 100.0, "highpass", fs=RATE, output="sos")
    kept = with_length(torch.from_numpy(sosfilt(high_pass, sounds.numpy(), axis=1)), SAMPLES)
    peaks = kept.abs().amax(dim=1)
    loud = peaks > 0.0
    if not bool(loud.any()):
        got, advice = f"{len(impacts)} silent ones ({', '.join(impacts.names[:3])})", "record the impacts again"
        raise EvaluationError.expected("a recording with a sound", 0.0, got=got, name="sounds", advice=advice)
    return ClipSpectra((kept[loud] / peaks[loud, None])[:CLIPS].float(), RATE)


def predicted_sound(
    frequency: PerMode, damping: PerMode
) -> tuple[Float[Tensor, " samples"], Float64[Tensor, " audible"]]:
    """Return the sum of the modes with equal amplitudes, of peak 1, and the damped frequencies of those in the band.

    `frequency` is undamped, Hz. Raises EvaluationError where no mode is in the band.
    """
    audible = damped_frequency(frequency, damping)
    inside = (audible > BAND[0]) & (audible < BAND[1])
    if not bool(inside.any()):
        raise EvaluationError.expected(f"modes from {BAND[0]:g} to {BAND[1]:g} Hz", 0, got="none", name="frequency")
    ones = torch.ones(1, int(inside.sum()))
    sound = synthesize(ones, audible[inside], damping[inside], samples=SAMPLES, sample_rate=RATE)[0]
    return sound / sound.detach().abs().max(), audible[inside]


def damped_frequency(frequency: PerMode, damping: PerMode) -> PerMode:
    """Return what is heard of modes with undamped frequencies, Hz; 0 for those that do not oscillate."""
    return (frequency.square() - (damping / (2.0 * math.pi)).square()).clamp_min(1e-12).sqrt()


def fit_material(
    spectra: ClipSpectra, curve: DampingCurve, family: BodyFamily, config: DiffSoundConfig | None = None
) -> MaterialFit:
    """Return the material and thickness whose modes sound most like the clips.

    Raises EvaluationError for a body that has no mode in the band with any of the materials, as one whose mesh is in
    another unit.
    """
    config = DiffSoundConfig() if config is None else config
    starts = [material_named(config.material)] if config.material is not None else list(MATERIALS.values())
    problem = _Problem(spectra, curve, family, _bounds(starts, family))
    tried = [_point(each, problem.bounds[:, 2].mean()) for each in starts]
    best = min(tried, key=problem.loss)
    if not math.isfinite(problem.loss(best)):
        lowest = float(family.bodies[0].modes(starts[0]).frequency[0])
        wanted, got = f"modes from {BAND[0]:g} to {BAND[1]:g} Hz", f"a lowest mode at {lowest:.3g} Hz"
        raise EvaluationError.expected(wanted, lowest, got=got, name="frequency", advice="give the mesh's unit")
    # The published rates of Adam, for 1000 and 2000 steps, and their factors after a tenth and a twentieth of a stage.
    steps = max(config.transport_steps, 1)
    rate, decay = 1e-3 * 1000 / steps, 0.9 ** (10.0 / steps)
    best, _ = problem.descended(best, problem.transport, config.transport_steps, rate=rate, decay=decay)
    steps = max(config.difference_steps, 1)
    # Longer steps by differences leave the basin that they start in.
    rate, decay = min(2e-3 * 2000 / steps, 0.005), 0.95 ** (20.0 / steps)
    _, best = problem.descended(best, problem.difference, config.difference_steps, rate=rate, decay=decay)
    if config.search:
        best = minimize_within(problem.bounds, problem.loss, best, generations=config.search)
        for _ in range(_ROUNDS if family.walled else 0):
            # Between thicknesses frequencies are interpolated; at one that is computed they are exact.
            family = family.including(float(best[2].exp()))
            problem = replace(problem, family=family, bounds=_around(best, problem.bounds))
            best = minimize_within(problem.bounds, problem.loss, best, generations=config.search // 2)
    thickness = float(best[2].exp()) if family.walled else family.thickness[0] if family.thickness else None
    return MaterialFit(float(best[0].exp()), float(best[1]), thickness, problem.loss(best), family.at(thickness))


def _point(material: Material, log_thickness: Float64[Tensor, ""]) -> Point:
    values = math.log(material.young / material.density), material.poisson, float(log_thickness)
    return torch.tensor(values, dtype=torch.float64)


def _bounds(materials: Iterable[Material], family: BodyFamily) -> Float64[Tensor, "2 3"]:
    """Return the least and the largest log(E / rho), Poisson's ratio and log(thickness)."""
    stiffness = [each.young / each.density for each in materials]
    walls = family.thickness if family.walled else (1.0, 1.0)
    low = [math.log(min(stiffness) / _STIFFER), POISSON[0], math.log(walls[0])]
    high = [math.log(max(stiffness) * _STIFFER), POISSON[1], math.log(walls[-1])]
    return torch.tensor([low, high], dtype=torch.float64)


def _around(point: Point, bounds: Float64[Tensor, "2 3"]) -> Float64[Tensor, "2 3"]:
    reach = torch.tensor(_NEAR, dtype=torch.float64)
    return torch.stack([torch.maximum(point - reach, bounds[0]), torch.minimum(point + reach, bounds[1])])


_Loss = Callable[[Point, int], Float[Tensor, ""]]
"""Of a point, at a step."""


@dataclass(frozen=True, eq=False)
class _Problem:
    """Clips, dampings and bodies."""

    spectra: ClipSpectra
    curve: DampingCurve
    family: BodyFamily
    bounds: Float64[Tensor, "2 3"]
    """The least and the largest point."""

    def sound(self, point: Point) -> tuple[Float[Tensor, " samples"], Float64[Tensor, " audible"]]:
        frequency = (point[0].exp() * self.family.squares(point[1], point[2])).sqrt() / (2.0 * math.pi)
        return predicted_sound(frequency, self.curve(frequency))

    def loss(self, point: Point) -> float:
        """Return the mean difference of spectra; infinite where nothing is heard."""
        with torch.no_grad():
            try:
                return float(self.difference(point, 0))
            except EvaluationError:
                return math.inf

    def transport(self, point: Point, step: int) -> Float[Tensor, ""]:
        return self.spectra.transport(*self.sound(point), row=step % len(self.spectra.clips))

    def difference(self, point: Point, step: int) -> Float[Tensor, ""]:
        return self.spectra.difference(self.sound(point)[0])

    def descended(self, start: Point, loss: _Loss, steps: int, *, rate: float, decay: float) -> tuple[Point, Point]:
        """Return where Adam ends on the loss of a point at a step, and the place on the way where it was least."""
        point = start.clone().requires_grad_()
        optimizer = torch.optim.Adam([point], lr=rate)
        schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, decay)
        least, kept = math.inf, start
        for step in range(steps):
            optimizer.zero_grad()
            try:
                value = loss(point, step)
            except EvaluationError:
                # All modes have left the band: the best place on the way remains.
                return kept, kept
            if float(value.detach()) < least:
                least, kept = float(value.detach()), point.detach().clone()
            torch.autograd.backward(value)
            optimizer.step()
            schedule.step()
            with torch.no_grad():
                point.clamp_(*self.bounds)
        return point.detach(), kept


def minimize_within(
    bounds: Float64[Tensor, "2 dim"],
    loss: Callable[[Float64[Tensor, " dim"]], float],
    start: Float64[Tensor, " dim"],
    *,
    generations: int,
) -> Float64[Tensor, " dim"]:
    """Return the point of least loss between two others, as far as differential evolution finds it from a start."""
    # Just inside: scipy refuses a start on a bound that rounding puts outside.
    low, high = bounds
    inside = start.clamp(low + _INSIDE * (high - low), high - _INSIDE * (high - low))
    # By trial on a bent sheet, 40 places for each parameter find what 20 do.
    found = scipy.optimize.differential_evolution(
        lambda values: loss(torch.from_numpy(values)), bounds.T.numpy(), x0=inside.numpy(),
        popsize=20, maxiter=generations, polish=False, rng=0,
    )  # fmt: skip
    return torch.from_numpy(found.x)
