"""The thickness of an object's wall, found by the evidence of the gains of all modes.

The log evidence of bodies with walls of different thickness is a function of the log thickness, which is computed where
the next bodies say most, two at a time: at the top of the parabola through the three thicknesses around the most
probable one, half way to a neighbor that is likely or far, or a step below the thinnest where that is the most probable
one. The prior is uniform in the log thickness over the range that was computed.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from avmsf.fem.candidate_bodies import CandidateBody
from avmsf.fem.material import DISCREPANCY


@dataclass(frozen=True)
class Tolerances:
    """How the thickness is searched; steps are differences of its logarithm."""

    min_step: float = 0.06  # below which no body is computed between two: real walls vary by 3 to 5 %
    # From which on three bodies say little of those between them: of a dish from photographs a body of twice the best
    # one's thickness was less probable by 66 nats; one half way was by 9 nats more so.
    max_step: float = 0.4
    max_bodies: int = 8  # that are computed besides the first ones, failures included
    max_evidence_gap: float = math.log(100.0)  # nats below the most probable body, beyond which is no hypothesis
    # Below the first range, whose lower end is a guess; with no end, gains that no wall explains made it ever thinner
    # (from 1 to .06 mm).
    max_extension: float = math.log(4.0)
    at_once: int = 2  # bodies that are computed side by side, on however many processors: the same walls everywhere
    steps: int = 2000  # thicknesses on which the posterior is summed up


TOLERANCES = Tolerances()


def search_thickness(
    bodies: Sequence[CandidateBody],
    evidence: Callable[[Sequence[CandidateBody]], Sequence[float]],
    with_walls: Callable[[CandidateBody, Sequence[float]], Sequence[CandidateBody | None]],
) -> tuple[list[CandidateBody], dict[str, float] | None]:
    """Return the bodies that are not improbable, the most probable one first, and the posterior of the thickness.

    Of this the 5th percentile `low`, the `median` and the 95th percentile `high`, meters.
    `evidence` has the log evidence of the gains with each body by itself, nats. `with_walls` computes bodies like
    another with walls of some thicknesses in meters, None where that fails, and others are tried then. Of open and
    closed walls only those like the most probable one are searched. There is no posterior where a body without a wall
    is the most probable one, or where fewer than two thicknesses are known.
    """
    found, failed = dict(zip(bodies, evidence(bodies), strict=True)), list[float]()
    thinnest = min((math.log(wall) for wall, _ in _walls(found)), default=0.0) - TOLERANCES.max_extension
    for _ in range(0, TOLERANCES.max_bodies, TOLERANCES.at_once):
        walls, best = _walls(found), max(found, key=found.__getitem__)
        if len(walls) < 2 or best.thickness is None:
            break
        known, values = np.log([wall for wall, _ in walls]), np.array([each for _, each in walls])
        wanted = _next(known, values, np.log(failed), thinnest=thinnest)
        if not wanted:
            break
        made = with_walls(best, wanted)
        failed += [wall for wall, body in zip(wanted, made, strict=True) if body is None]
        new = [body for body in made if body is not None]
        found |= zip(new, evidence(new), strict=True)
    best = max(found, key=found.__getitem__)
    likely = [body for body, each in found.items() if each > found[best] - TOLERANCES.max_evidence_gap]
    likely.sort(key=found.__getitem__)
    walls = _walls(found)
    return likely[::-1], None if best.thickness is None or len(walls) < 2 else _posterior(walls)


def _walls(found: dict[CandidateBody, float]) -> list[tuple[float, float]]:
    """Return the thicknesses of walls as open as the most probable one, from thin to thick, and their log evidence."""
    walls = [body for body in found if body.thickness is not None]
    closed = max(walls, key=found.__getitem__).closed if walls else False
    return sorted((body.thickness, found[body]) for body in walls if body.thickness and body.closed == closed)


def _next(places: np.ndarray, values: np.ndarray, failed: np.ndarray, *, thinnest: float) -> list[float]:
    """Return the thicknesses to compute next, meters; none where all that are likely have near neighbors.

    `places` are log thicknesses in rising order with their log evidence `values`, `failed` those without a body, and
    `thinnest` is the least.
    """
    best = int(values.argmax())
    proposals = []
    if 0 < best < len(places) - 1:
        around = slice(best - 1, best + 2)
        curve, slope, _ = np.polyfit(places[around] - places[best], values[around], 2)
        if curve < 0:
            proposals.append(places[best] - 0.5 * slope / curve)
    # Half way to a neighbor, the likelier one first; near the best one the log evidence is about a parabola, on which a
    # quarter of the neighbor's fall is lost there.
    near = [row for row in (best - 1, best + 1) if 0 <= row < len(places)]
    if best == 0:
        # The first range is a guess below; above, the views or the object's width bound it.
        proposals += [places[0] - part * (places[1] - places[0]) for part in (1.0, 0.5)]
    fall, apart = values[best] - values, np.abs(places - places[best])
    near = [row for row in near if fall[row] < 4.0 * TOLERANCES.max_evidence_gap or apart[row] > TOLERANCES.max_step]
    proposals += [0.5 * (places[best] + places[row]) for row in sorted(near, key=lambda row: -values[row])]
    chosen = list[float]()
    for each in proposals:
        if each >= thinnest and np.abs(np.concatenate([places, failed, chosen]) - each).min() >= TOLERANCES.min_step:
            chosen.append(each)
    return np.exp(chosen[: TOLERANCES.at_once]).tolist()


def _posterior(walls: Sequence[tuple[float, float]]) -> dict[str, float]:
    places, values = np.log([wall for wall, _ in walls]), np.array([each for _, each in walls])
    grid = np.linspace(places[0] - 3 * DISCREPANCY, places[-1] + 3 * DISCREPANCY, TOLERANCES.steps)
    likely = np.exp(np.interp(grid, places, values - values.max(), left=-np.inf, right=-np.inf))
    density = gaussian_filter1d(likely, DISCREPANCY / (grid[1] - grid[0]), mode="constant")
    share = np.cumsum(density) / density.sum()
    found = np.exp(grid[np.searchsorted(share, [0.05, 0.5, 0.95])])
    return dict(zip(("low", "median", "high"), found.tolist(), strict=True))
