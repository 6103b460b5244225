"""DiffSound's inverse problem: the material, and the thickness of walls, whose modes sound like recorded clips.

Jin et al. (DiffSound, SIGGRAPH 2024) predict one sound for all clips, the lowest 16 modes with the same amplitude, and
move Young's modulus and Poisson's ratio by Adam until its spectra are those of the clips: first by optimal transport,
then by differences (`avmsf.evaluation.spectral_losses`). Frequencies determine E / rho alone, not E.

What is ours: `BodyFamily` in place of an eigenvalue problem every 15 steps; the thickness of walls; parameters are the
logarithm of E / rho, a sigmoid of Poisson's ratio and the logarithm of the thickness; steps are fewer and longer; the
difference is also scanned over the whole range beforehand, and of the descents from the end of the transport and from
the best of the scan that with the lower difference counts; dampings are those of extracted modes.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.signal import butter, resample_poly, sosfilt
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.evaluation.spectral_losses import ClipSpectra
from avmsf.fem.family import BodyFamily
from avmsf.fem.isotropic import IsotropicModes
from avmsf.modal.bank import ModalBank
from avmsf.modal.synthesis import synthesise
from avmsf.simulate.elastic import ElasticModes
from avmsf.simulate.material import MATERIALS, Material, material_named

MODES = 16
RATE = 32_000.0
"""Sample rate at which clips are compared, Hz."""
SAMPLES = 8_000
CLIPS = 8
"""Recordings that are compared at most, the first of them."""
_SCANNED_CLIPS = 4
"""Of them, those that are scanned by."""
HIGH_PASS = 100.0
"""Hz."""
BAND = 20.0, 16_000.0
"""Frequencies that are synthesized, Hz."""
POISSON = 0.01, 0.499
"""Range of Poisson's ratio."""
_STIFFER = 10.0
"""Largest factor on the stiffness of the material at the start, and its inverse."""
_TRANSPORT_RATE, _DIFFERENCE_RATE = 1e-3, 2e-3
_TRANSPORT_DECAY, _DIFFERENCE_DECAY = 0.9, 0.95
"""Adam's rates, and their factor after each tenth and each twentieth of a stage."""
_PUBLISHED_STEPS = 1000, 2000
_FASTEST_DECAY = 300.0
"""Largest damping of modes that the damping curve is made of, 1/s."""
_CURVE_STEP, _CURVE_END = 500.0, 20_000.0
"""Width of the damping curve's bins, and the highest frequency, Hz."""
_SCAN_STEP = 0.02
"""Of the logarithm of E / rho: modes move by 1 %, a bin of the longest FFT at 3 kHz."""
_LONGEST = 0.005
"""Longest steps of a descent by differences: longer ones leave the basin that they start in."""
_STEEPEST = 5.0
"""Largest argument of Poisson's ratio's sigmoid: .013 to .496."""
_SCANNED_POISSON = (0.15, 0.3, 0.42)
_SCANNED_WALLS = 9
_FINE_WALLS = np.exp(np.linspace(-0.1, 0.1, 7))
_FINE_STEP, _FINE_STEPS = 0.005, 16
_FINE_POISSON = tuple(float(each) for each in np.linspace(0.03, 0.47, 12))
"""Of the scan around the best place of the first."""


@dataclass(frozen=True)
class DiffSoundConfig:
    """How a material is fitted."""

    material: str | None = None
    """Name in the table of materials of what the object is made of, at which the descent starts; None tries all."""
    transport_steps: int = 12
    """Steps by optimal transport, each with one clip; 1000, with all clips, in the published program."""
    difference_steps: int = 200
    """Steps by differences of spectra; 2000 in the published program."""
    scan: bool = True
    """Whether differences are scanned over the whole range; not in the published program."""

    def __post_init__(self) -> None:
        if self.material is not None:
            material_named(self.material)
        for name in ("transport_steps", "difference_steps"):
            if getattr(self, name) < 0:
                raise EvaluationError(f"{name} = {getattr(self, name)}: expected 0 or more")


@dataclass(frozen=True)
class MaterialFit:
    """What the clips say of a body."""

    stiffness: float
    """E / rho, m2/s2."""
    poisson: float
    thickness: float | None
    """Of the walls on average, meters; None for a filled body."""
    difference: float
    """The objective that was reached: the mean difference of spectra."""
    body: IsotropicModes
    """The body of that thickness."""

    def modes(self) -> ElasticModes:
        """Return the body's modes, of the fitted material with a density of 1 kg/m3, which sounds do not tell."""
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
        frequency, damping = (
            bank.frequency.detach().cpu().double().numpy(),
            bank.damping.detach().cpu().double().numpy(),
        )
        slow = (damping > 0.0) & (damping < _FASTEST_DECAY) & (frequency > BAND[0]) & (frequency < _CURVE_END)
        if not slow.any():
            raise EvaluationError(
                f"expected modes that decay by less than {_FASTEST_DECAY:g} 1/s in the recordings, got none of "
                f"{len(bank)}: the object is too dull for DiffSound"
            )
        bins = ((frequency[slow] - BAND[0]) // _CURVE_STEP).astype(int)
        kept = np.unique(bins)
        least = [float(damping[slow][bins == each].min()) for each in kept]
        return cls(tuple(float(BAND[0] + (each + 0.5) * _CURVE_STEP) for each in kept), tuple(least))

    def __call__(self, frequency: Float64[Tensor, " modes"]) -> Float64[Tensor, " modes"]:
        """Return dampings, 1/s: linear between the bins, constant beyond the first and the last."""
        found = np.interp(frequency.detach().cpu().numpy(), self.frequency, self.damping)
        return torch.from_numpy(found).to(frequency)


def clip_spectra(impacts: Impacts) -> ClipSpectra:
    """Return the recordings as DiffSound compares them: .25 s at 32 kHz, without what is below 100 Hz, of peak 1.

    Silent recordings are left out, and those after the first `CLIPS`. Raises EvaluationError where all are silent.
    """
    sounds = impacts.sounds.detach().cpu().double().numpy()
    rates = int(RATE), round(impacts.sample_rate)
    common = math.gcd(*rates)
    kept = resample_poly(sounds, rates[0] // common, rates[1] // common, axis=1)[:, :SAMPLES]
    kept = sosfilt(butter(2, HIGH_PASS, "highpass", fs=RATE, output="sos"), kept, axis=1)
    kept = np.pad(kept, ((0, 0), (0, SAMPLES - kept.shape[1])))
    peaks = np.abs(kept).max(axis=1)
    if not (peaks > 0.0).any():
        raise EvaluationError(
            f"expected a recording with a sound, got {len(impacts)} that are silent ({', '.join(impacts.names[:3])}): "
            "record the impacts again"
        )
    loud = peaks > 0.0
    return ClipSpectra(torch.from_numpy((kept[loud] / peaks[loud, None])[:CLIPS]).float(), RATE)


def predicted_sound(
    frequency: Float64[Tensor, " modes"], damping: Float64[Tensor, " modes"]
) -> tuple[Float[Tensor, " samples"], Float64[Tensor, " heard"]]:
    """Return the sum of the modes with equal amplitudes, of peak 1, and the damped frequencies of those in the band.

    `frequency` is undamped, Hz. Raises EvaluationError where no mode is in the band.
    """
    heard = damped_frequency(frequency, damping)
    inside = (heard > BAND[0]) & (heard < BAND[1])
    if not bool(inside.any()):
        raise EvaluationError(f"expected modes from {BAND[0]:g} to {BAND[1]:g} Hz, got none")
    ones = torch.ones(1, int(inside.sum()))
    sound = synthesise(ones, heard[inside], damping[inside], samples=SAMPLES, sample_rate=RATE)[0]
    return sound / sound.detach().abs().max(), heard[inside]


def damped_frequency(
    frequency: Float64[Tensor, " modes"], damping: Float64[Tensor, " modes"]
) -> Float64[Tensor, " modes"]:
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
    _expect_audible(family, starts)
    problem = _Problem(spectra, curve, family, _bounds(starts))
    scanned = problem.by_few_clips().scan() if config.scan else None
    start = _start(problem, starts)
    ends = [problem.descended(problem.transported(start, config.transport_steps), config.difference_steps)]
    if scanned is not None:
        ends.append(problem.descended(scanned, config.difference_steps))
    best = min(ends, key=problem.loss)
    thickness = family.thickness[0] if family.thickness else None
    if family.walled:
        # Between thicknesses frequencies are interpolated: the body of the one that was found makes them exact there.
        problem = replace(problem, family=family.including(float(best.log_thickness.exp())))
        best = problem.descended(problem.scanned_around(best), config.difference_steps)
        thickness = float(best.log_thickness.exp())
        problem = replace(problem, family=BodyFamily((family.at(thickness),), (thickness,)))
        best = problem.descended(problem.scanned_around(best), config.difference_steps // 2)
    return MaterialFit(
        float(best.log_stiffness.exp()), float(best.poisson), thickness, problem.loss(best), problem.family.bodies[0]
    )


@dataclass(frozen=True, eq=False)
class _Parameters:
    """What is fitted."""

    log_stiffness: Float64[Tensor, ""]
    place: Float64[Tensor, ""]
    """Of Poisson's ratio in its range, before a sigmoid."""
    log_thickness: Float64[Tensor, ""]

    @classmethod
    def at(cls, stiffness: float, poisson: float, thickness: float) -> "_Parameters":
        part = (poisson - POISSON[0]) / (POISSON[1] - POISSON[0])
        values = (math.log(stiffness), math.log(part / (1.0 - part)), math.log(thickness))
        return cls(*(torch.tensor(each, dtype=torch.float64) for each in values))

    @property
    def poisson(self) -> Float64[Tensor, ""]:
        return POISSON[0] + (POISSON[1] - POISSON[0]) * torch.sigmoid(self.place)

    @property
    def values(self) -> list[Float64[Tensor, ""]]:
        return [self.log_stiffness, self.place, self.log_thickness]

    def frequency(self, family: BodyFamily) -> Float64[Tensor, " modes"]:
        """Return undamped natural frequencies, Hz."""
        squares = family.squares(self.poisson, self.log_thickness)
        return (self.log_stiffness.exp() * squares).sqrt() / (2.0 * math.pi)

    def moving(self) -> "_Parameters":
        """Return a copy that gradients are taken by."""
        return _Parameters(*(each.clone().requires_grad_() for each in self.values))

    def fixed(self) -> "_Parameters":
        return _Parameters(*(each.detach().clone() for each in self.values))

    def limit(self, bounds: tuple[float, float], thickness: tuple[float, ...]) -> None:
        """Bring the values into their ranges, in place."""
        with torch.no_grad():
            self.log_stiffness.clamp_(*map(math.log, bounds))
            self.place.clamp_(-_STEEPEST, _STEEPEST)
            if len(thickness) > 1:
                self.log_thickness.clamp_(math.log(thickness[0]), math.log(thickness[-1]))


_Loss = Callable[[_Parameters, int], Float[Tensor, ""]]
"""Of parameters at a step."""


@dataclass(frozen=True, eq=False)
class _Problem:
    """Clips, dampings and bodies."""

    spectra: ClipSpectra
    curve: DampingCurve
    family: BodyFamily
    bounds: tuple[float, float]
    """Of E / rho, m2/s2."""

    def sound(self, here: _Parameters) -> tuple[Float[Tensor, " samples"], Float64[Tensor, " heard"]]:
        frequency = here.frequency(self.family)
        return predicted_sound(frequency, self.curve(frequency))

    def loss(self, here: _Parameters) -> float:
        """Return the mean difference of spectra; infinite where nothing is heard."""
        with torch.no_grad():
            try:
                return float(self.spectra.difference(self.sound(here)[0]))
            except EvaluationError:
                return math.inf

    def by_few_clips(self) -> "_Problem":
        clips = self.spectra.clips[:_SCANNED_CLIPS]
        return replace(self, spectra=ClipSpectra(clips, self.spectra.sample_rate))

    def middle(self) -> float:
        """Return a thickness in the middle of the range, meters; 1 where none is fitted."""
        known = self.family.thickness
        return math.sqrt(known[0] * known[-1]) if self.family.walled else 1.0

    def transported(self, start: _Parameters, steps: int) -> _Parameters:
        """Return where a descent by optimal transport ends."""

        def loss(here: _Parameters, step: int) -> Float[Tensor, ""]:
            sound, heard = self.sound(here)
            return self.spectra.transport(sound, heard, row=step % len(self.spectra.clips))

        rate = _TRANSPORT_RATE * _PUBLISHED_STEPS[0] / max(steps, 1)
        return self._descend(start, loss, steps, rate=rate, decay=_TRANSPORT_DECAY ** (10.0 / max(steps, 1)))

    def descended(self, start: _Parameters, steps: int) -> _Parameters:
        """Return where a descent by differences of spectra ends, or the best place on the way."""

        def loss(here: _Parameters, step: int) -> Float[Tensor, ""]:
            return self.spectra.difference(self.sound(here)[0])

        rate = min(_DIFFERENCE_RATE * _PUBLISHED_STEPS[1] / max(steps, 1), _LONGEST)
        decay = _DIFFERENCE_DECAY ** (20.0 / max(steps, 1))
        return self._descend(start, loss, steps, rate=rate, decay=decay, best=True)

    def scan(self) -> _Parameters:
        """Return the best of a grid over the whole range, and of a finer one around it."""
        low, high = map(math.log, self.bounds)
        known = self.family.thickness
        walls = np.geomspace(known[0], known[-1], _SCANNED_WALLS) if self.family.walled else np.ones(1)
        logs = np.arange(low, high + _SCAN_STEP, _SCAN_STEP)
        best = self._best(logs, _SCANNED_POISSON[1:2] if self.family.walled else _SCANNED_POISSON, walls)
        return self.scanned_around(best)

    def scanned_around(self, start: _Parameters) -> _Parameters:
        """Return the best of a fine grid around a place, and of the place itself."""
        around = float(start.log_stiffness) + _FINE_STEP * np.arange(-_FINE_STEPS, _FINE_STEPS + 1)
        wall = float(start.log_thickness.exp())
        walls = wall * _FINE_WALLS if self.family.walled else np.array([wall])
        # Thin walls bend in proportion to their thickness, which moves modes nearly as the stiffness does.
        tried = [
            self._best(around - 2.0 * math.log(each / wall), _FINE_POISSON[:: 2 if len(walls) > 1 else 1], each[None])
            for each in walls
        ]
        return min([start, *tried], key=self.loss)

    def _best(self, logs: np.ndarray, poisson: Iterable[float], walls: np.ndarray) -> _Parameters:
        """Return the best of a grid: logarithms of E / rho, Poisson's ratios and thicknesses, meters."""
        grid = (
            _Parameters.at(math.exp(each), ratio, float(wall)) for wall in walls for ratio in poisson for each in logs
        )
        return min(grid, key=self.loss)

    def _descend(
        self, start: _Parameters, loss: _Loss, steps: int, *, rate: float, decay: float, best: bool = False
    ) -> _Parameters:
        """Return where Adam ends, or with `best` the place on the way where the loss was least."""
        moving = start.moving()
        optimizer = torch.optim.Adam(moving.values, lr=rate)
        schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, decay)
        least, kept = math.inf, start
        for step in range(steps):
            optimizer.zero_grad()
            try:
                value = loss(moving, step)
            except EvaluationError:
                # All modes have left the band: the best place on the way remains.
                break
            if float(value.detach()) < least:
                least, kept = float(value.detach()), moving.fixed()
            torch.autograd.backward(value)
            optimizer.step()
            schedule.step()
            moving.limit(self.bounds, self.family.thickness)
        return kept if best else moving.fixed()


def _start(problem: _Problem, materials: Iterable[Material]) -> _Parameters:
    """Return the material at which the difference is least."""
    tried = [_Parameters.at(each.young / each.density, each.poisson, problem.middle()) for each in materials]
    return min(tried, key=problem.loss)


def _bounds(materials: Iterable[Material]) -> tuple[float, float]:
    stiffness = [each.young / each.density for each in materials]
    return min(stiffness) / _STIFFER, max(stiffness) * _STIFFER


def _expect_audible(family: BodyFamily, materials: Iterable[Material]) -> None:
    """Raise EvaluationError where no material of the table gives the body a mode in the band."""
    bodies = family.bodies
    for material in materials:
        for body in bodies:
            frequency = body.modes(material).frequency
            if bool(((frequency > BAND[0]) & (frequency < BAND[1])).any()):
                return
    lowest = float(bodies[0].modes(next(iter(materials))).frequency[0])
    raise EvaluationError(
        f"expected a body with modes from {BAND[0]:g} to {BAND[1]:g} Hz, got one whose lowest is at {lowest:.3g} Hz: "
        "state the mesh's unit"
    )
