"""Model updating: a body's stiffness and density as its measured frequencies and gains have them.

A nominal body is uniform; a real one varies in stiffness, density and thickness, which moves its frequencies and mixes
its mode shapes. With the first-order changes of `avmsf.fem.perturbation` on the basis of the nominal shapes,

    (Lambda + sum_l theta_l A_l + theta_nu N) v = lambda (I + sum_l theta'_l T_l) v,

has the updated shapes Phi V and frequencies. The coefficients are normal a priori and are found by Gauss and Newton's
method from the modes whose shape is known with some certainty: to first order

    d log f_k / d theta_l = v_k' A_l v_k / (2 lambda_k),   d log f_k / d theta'_l = -v_k' T_l v_k / 2,
    d phi_k = sum_(j != k) phi_j v_j' (dK - lambda_k dM) v_k / (lambda_k - lambda_j)

(Fox and Kapoor, AIAA Journal 6, 1968). Rounds of matching and solving follow each other; the one with the highest
evidence is kept, by Laplace's approximation over the coefficients, and round 0 is the nominal body. Rounds end where
the coefficients are larger than their prior expects, the sum of their squares over their variances exceeding their
number: the object is then another body, not a perturbed one, and first order says nothing of it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from avmsf.fem.elastic_modes import ElasticModes


@dataclass(frozen=True)
class Tolerances:
    """Prior standard deviations of the coefficients, and what counts as known and as near."""

    stiffness_std: float = 0.10  # of Young's modulus over its nominal value
    density_std: float = 0.04  # of the density over its nominal value
    poisson_std: float = 1.0  # of Poisson's ratio over `poisson_step`
    factor_std: float = 0.5  # of the log factor on all frequencies over one round
    poisson_step: float = 0.05  # change of Poisson's ratio that a coefficient of 1 stands for
    max_rounds: int = 6  # on simulated objects the evidence rises for 3 to 6
    min_certainty: float = 0.7  # probability of a shape from which on a mode is taken for it
    frequency_std: float = 0.02  # of log frequency at first
    min_frequency_std: float = 0.002
    min_gain_noise: float = 0.02  # variance of gains that updating cannot explain, over their mean square
    mixing_gap: float = 0.01  # of squared frequencies, relative, below which shapes mix and first order says nothing
    group_gap: float = 0.02  # of squared frequencies, relative, within which shapes count as one group
    max_step: float = 2.0  # of a coefficient, in prior standard deviations


TOLERANCES = Tolerances()


@dataclass(frozen=True, eq=False)
class Matched:
    """What measured gains say of a body."""

    evidence: float
    """Log evidence of all gains with this body among the families."""
    centers: Float64[Tensor, "shapes modes"]
    """Probability that a measured mode is a perturbation of each shape."""
    log_factor: float
    """Log of the most probable factor on the frequencies."""


def update(
    modes: ElasticModes,
    points: Float64[Tensor, "contacts 3"],
    directions: Float64[Tensor, "contacts 3"],
    frequency: Float64[Tensor, " modes"],
    values: Float64[Tensor, "contacts modes"],
    usable: Bool[Tensor, " modes"],
    match: Callable[[ElasticModes], Matched],
) -> tuple[ElasticModes, float] | None:
    """Return the updated modes and the log evidence that they gain, or None where the nominal ones have the highest.

    `modes` have `perturbations`; `frequency` (Hz) and `values`, along each mode's common phase, are those measured for
    impacts at `points` (meters) along `directions` (unit vectors); modes that are not `usable`, silent or doubled ones,
    say nothing of the body. `match` weighs a body, known at least at the points, against the other families.
    """
    local = modes.near(points)
    known = local.gains(points, directions).numpy()
    problem = _Problem(modes, known, frequency[usable].numpy(), values[:, usable].numpy())
    theta, spread, best = np.zeros(len(problem.deviation)), TOLERANCES.frequency_std, None
    found = match(local)
    nominal = highest = found.evidence
    for step in range(TOLERANCES.max_rounds):
        theta, spread, volume = problem.solved(theta, found, found.centers[:, usable], spread, with_gains=step > 0)
        size = float(np.square(theta / problem.deviation).sum())
        if size > len(theta):
            break
        found = match(problem.changed(local, theta))
        evidence = found.evidence - 0.5 * size - volume
        if evidence > highest:
            highest, best = evidence, theta
    return None if best is None else (problem.changed(modes, best), highest - nominal)


class _Problem:
    """The linearized problem of one body."""

    def __init__(
        self,
        nominal: ElasticModes,
        known: Float64[np.ndarray, "contacts shapes"],
        frequency: Float64[np.ndarray, " modes"],
        values: Float64[np.ndarray, "contacts modes"],
    ) -> None:
        self.known, self.frequency, self.values = known, frequency, values
        self.squares, changes = np.square(2.0 * np.pi * nominal.frequency.numpy()), nominal.perturbations
        assert changes is not None
        self.forces = np.concatenate([changes.stiffness, TOLERANCES.poisson_step * changes.poisson[None]])
        self.masses = changes.mass
        deviations = [TOLERANCES.stiffness_std, TOLERANCES.poisson_std, TOLERANCES.density_std]
        self.deviation = np.repeat(deviations, [len(self.forces) - 1, 1, len(self.masses)])

    def solution(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the squared angular frequencies and the updated shapes over the nominal ones, [nominal, updated]."""
        forces, masses = np.split(theta, [len(self.forces)])
        stiff = np.diag(self.squares) + np.tensordot(forces, self.forces, 1)
        heavy = np.eye(len(self.squares)) + np.tensordot(masses, self.masses, 1)
        return scipy.linalg.eigh(stiff, heavy)

    def changed(self, modes: ElasticModes, theta: np.ndarray) -> ElasticModes:
        """Return modes with these coefficients."""
        squares, shapes = self.solution(theta)
        # Coefficients far outside of first order could make a square negative.
        frequency = torch.from_numpy(np.sqrt(np.maximum(squares, 1e-6 * self.squares[0])) / (2.0 * np.pi))
        mixed = torch.einsum("njd,jk->nkd", modes.shapes, torch.from_numpy(shapes))
        return replace(modes, frequency=frequency, shapes=mixed, perturbations=None)

    def solved(
        self, theta: np.ndarray, found: Matched, known: Tensor, spread: float, *, with_gains: bool
    ) -> tuple[np.ndarray, float, float]:
        """Return the next coefficients, the standard deviation of log frequencies, and Laplace's log volume.

        `known` has the probabilities of the shapes of the usable modes. The volume is half the log determinant of the
        coefficients' posterior precision over the prior's, by which their best values overstate the evidence (MacKay,
        Neural Computation 4, 1992).
        """
        squares, shapes = self.solution(theta)
        centers = known.numpy()
        together = np.abs(squares[:, None] - squares) <= TOLERANCES.group_gap * squares[:, None]
        grouped = together @ centers
        shape = centers.argmax(0)
        certainty = grouped[shape, np.arange(len(shape))]
        mode = np.flatnonzero(certainty > TOLERANCES.min_certainty)
        shape, certainty = shape[mode], certainty[mode]
        forces = np.einsum("jk,ljm,mn->lkn", shapes, self.forces, shapes, optimize=True)
        masses = np.einsum("jk,ljm,mn->lkn", shapes, self.masses, shapes, optimize=True)
        slopes = np.concatenate([forces[:, shape, shape] / (2.0 * squares[shape]), -0.5 * masses[:, shape, shape]]).T
        apart = np.log(self.frequency[mode]) - 0.5 * np.log(squares[shape]) + np.log(2.0 * np.pi) - found.log_factor
        rows = [np.concatenate([slopes, np.ones((len(mode), 1))], axis=1) * (np.sqrt(certainty) / spread)[:, None]]
        rest = [(apart + slopes @ theta) * np.sqrt(certainty) / spread]
        if with_gains:
            along = self.known @ shapes
            for m, k, sure in zip(mode, shape, certainty, strict=True):
                row, value = self._gain_rows(along, self.values[:, m], squares, forces, masses, together[k])
                weight = np.sqrt(sure)
                rows.append(np.concatenate([row * weight, np.zeros((len(row), 1))], axis=1))
                rest.append((value + row @ theta) * weight)
        matrix, right = np.concatenate(rows), np.concatenate(rest)
        precision = np.append(self.deviation, TOLERANCES.factor_std) ** -2.0
        posterior = matrix.T @ matrix + np.diag(precision)
        solution = np.linalg.solve(posterior, matrix.T @ right)
        # Of the coefficients alone: the factor is not known of the nominal body either.
        alone = posterior[:-1, :-1] - np.outer(posterior[:-1, -1], posterior[-1, :-1]) / posterior[-1, -1]
        volume = 0.5 * np.linalg.slogdet(alone * self.deviation[:, None] * self.deviation)[1]
        longest = TOLERANCES.max_step * self.deviation
        step = np.clip(solution[:-1] - theta, -longest, longest)
        # More than the root mean square of the fitted residuals: as many coefficients as modes fit them.
        left = apart - slopes @ step - solution[-1]
        if len(mode):
            fitted = 1.5 * np.sqrt(np.average(left**2, weights=certainty))
            spread = float(np.clip(fitted, TOLERANCES.min_frequency_std, spread))
        return theta + step, spread, float(volume)

    def _gain_rows(
        self,
        along: np.ndarray,
        values: np.ndarray,
        squares: np.ndarray,
        forces: np.ndarray,
        masses: np.ndarray,
        group: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return how the gains of a mode of a group of shapes change with the coefficients, and their rest."""
        own = along[:, group]
        basis, _ = np.linalg.qr(own)
        sizes = np.linalg.lstsq(own, values, rcond=1e-3)[0]
        left = values - basis @ (basis.T @ values)
        noise = np.sqrt(max(TOLERANCES.min_gain_noise, 0.5 * (left @ left) / (values @ values)) * np.mean(values**2))
        moved = np.zeros((len(values), len(self.deviation)))
        for k, size in zip(np.flatnonzero(group), sizes, strict=True):
            apart = squares[k] - squares
            mixing = np.where(group, 0.0, apart / (apart**2 + (TOLERANCES.mixing_gap * squares[k]) ** 2))
            coefficients = np.concatenate([forces[:, :, k], -squares[k] * masses[:, :, k]]) * mixing
            moved += size * along @ coefficients.T
        moved -= basis @ (basis.T @ moved)
        return moved / noise, left / noise
