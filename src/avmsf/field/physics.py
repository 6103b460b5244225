"""The recipe that knows the object's shape: elastic modes of the likeliest body, and gains by evidence."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from avmsf.capture.placement import surface_points
from avmsf.capture.surface import Surface
from avmsf.errors import FitError
from avmsf.field.bodychoice import MeasuredGains, likely_bodies, plausible_bodies
from avmsf.field.config import FitConfig
from avmsf.field.placed import expect_placed
from avmsf.field.recipes import SHARED, GainCase
from avmsf.field.refinement import RefinedGains
from avmsf.field.suspects import agreeing, doubted, find_suspects
from avmsf.simulate.elastic import ElasticModes
from avmsf.simulate.nominal import NominalBodies, NominalBody, body_name

FEWEST = 3
"""Strikes below which evidence says nothing."""
_STILL = 1e-9
"""Most motion along the blows over the largest anywhere, that is none."""
_LOOKED_AT = 200
"""Most points of the features that are compared with the body's surface."""
_SPREAD = 0.02
"""Diagonal of the contacts' box over the object's, below which all were struck in one place."""


@runtime_checkable
class Finer(Protocol):
    """Makes a body that was good enough to choose by as fine as was asked for."""

    def __call__(self, body: NominalBody) -> NominalBody:
        """Return the body with finer elements, or as it is where that fails."""
        ...

    def digest(self) -> str:
        """Return what tells its bodies from another's."""
        ...


@dataclass(frozen=True, eq=False)
class Physics:
    """Gains from elastic mode shapes, `ModalBasis`."""

    bodies: NominalBodies
    """What may lie behind the object's surface."""
    finer: Finer | None = None
    """Makes the chosen body's elements finer, where there were several to choose from."""

    @property
    def name(self) -> str:
        """`physics`."""
        return "physics"

    @property
    def warms_up(self) -> bool:
        """The regression is solved for."""
        return False

    def digest(self) -> str:
        """Return a digest of the bodies."""
        digest = hashlib.sha256(("" if self.finer is None else self.finer.digest()).encode())
        for body in self.bodies.bodies:
            digest.update(body.name.encode())
            for tensor in (body.elastic.frequency, body.elastic.nodes, body.elastic.shapes):
                digest.update(tensor.contiguous().numpy().tobytes())
        return digest.hexdigest()

    def dampings(self, config: FitConfig) -> tuple[str, ...]:
        """Return shared dampings alone: a mode decays as fast wherever it was struck."""
        return (SHARED,)

    def start(self, case: GainCase, damping: str) -> RefinedGains:
        """Return the field of the likeliest body.

        Raises FitError for fewer than three strikes, all strikes in one place, directions of length zero, and contacts
        or features that are not on the body's surface.
        """
        heard, points, bodies = measured_gains(case), case.features.points, self.bodies.bodies
        expect_enough(len(case.train))
        _expect_one_frame(case, bodies[0])
        _expect_strikes(case)
        _expect_motion(bodies, heard)
        names = case.train.names
        suspects = find_suspects(plausible_bodies(bodies, points, heard), heard)
        measured = doubted(heard, suspects)
        likely = likely_bodies(bodies, points, measured)
        body = agreeing(likely, measured)
        if self.finer is not None:
            fine = self.finer(body.body)
            body = agreeing(likely_bodies([fine], points, measured), measured)
        report = {
            "body": body.name,
            "wall": body.body.wall,
            "fine": body.body.fine,
            "factor": body.factor,
            "bodies": [
                {"body": each.name, "wall": each.body.wall, "factor": each.factor, "lag": each.lag} for each in likely
            ],
            "bodies_refused": [
                {"body": body_name(wall), "wall": wall, "reason": reason}
                for wall, reason in self.bodies.refused.items()
            ],
            "suspects": {names[each.row]: each.describe(names, case.train.contacts) for each in suspects},
        }
        return RefinedGains(replace(body.fit(measured), report=report), case.modes.bank)

    def rows(self, case: GainCase) -> Int[Tensor, " contacts"]:
        """Return the contacts themselves."""
        return torch.arange(len(case.train))


def _expect_motion(bodies: Sequence[NominalBody], measured: MeasuredGains) -> None:
    """Raise FitError where no elastic shape moves along the blows."""
    if measured.directions is None:
        return
    for body in bodies:
        moved = body.elastic.gains(measured.contacts, measured.directions).abs().max()
        if float(moved) <= _STILL * float(body.elastic.shapes.abs().max()):
            raise FitError(
                f"no elastic shape of the body, {body.name}, moves along the blows at all: check nx, ny, nz, or leave "
                "them out"
            )


def measured_gains(case: GainCase) -> MeasuredGains:
    """Return a case's gains as the regression takes them, with the standard errors that noise gives them."""
    bank, values = case.modes.bank, case.parts
    size = values.square().mean((0, 2))
    return MeasuredGains(
        case.train.contacts,
        case.train.directions,
        values,
        bank.frequency,
        bank.damping,
        (gain_variance(case) / size.clamp_min(torch.finfo(torch.float64).tiny)).expand(len(case.train), -1),
        torch.ones(len(case.train), dtype=torch.float64),
    )


def gain_variance(case: GainCase) -> Float64[Tensor, " modes"]:
    """Return the variance that the background noise gives each gain by least squares.

    White noise of variance v on samples at a rate r leaves a damped sine's amplitude with 2 v / r over the energy
    (1 - exp(-2 d T)) / (2 d), twice that of the sine squared alone, for each of its two parts; around the mode's
    frequency the residual is as good as white.
    """
    bank, magnitude = case.modes.bank, case.modes.residual.magnitude.double()
    place = bank.frequency / (case.train.sample_rate / 2) * (len(magnitude) - 1)
    noise = magnitude[place.round().long().clamp(0, len(magnitude) - 1)].square()
    lasting = -torch.expm1(-2.0 * bank.damping * case.train.duration)
    return 4.0 * bank.damping * noise / (case.train.sample_rate * lasting)


def expect_enough(strikes: int) -> None:
    """Raise FitError for fewer strikes than physics can learn from."""
    if strikes < FEWEST:
        raise FitError(
            f"physics needs {FEWEST} strikes or more to tell how much of each shape a mode has, found {strikes}: "
            "strike more places, or let splines spread the gains"
        )


def _expect_one_frame(case: GainCase, body: NominalBody) -> None:
    """Raise FitError where the contacts, or the points that shapes are looked up at, are not on the body's surface."""
    if body.elastic not in _POINTS:
        # Kept, for the choice between gain models and the fit ask the same body.
        _POINTS[body.elastic] = surface_points(Surface(body.elastic.nodes, body.elastic.triangles[:, :3]))
    surface, points = _POINTS[body.elastic], case.features.points
    expect_placed(case.train.contacts, surface, names=case.train.names)
    expect_placed(points[:: -(-len(points) // _LOOKED_AT)], surface, what="points of the features")


def _expect_strikes(case: GainCase) -> None:
    train = case.train
    extent = float((train.contacts.amax(0) - train.contacts.amin(0)).norm())
    size = 2.0 * case.features.half_diagonal
    if extent < _SPREAD * size:
        raise FitError(
            f"all {len(train)} strikes lie within {extent:.2g} m on an object of {size:.2g} m: strike it in several "
            "places"
        )
    if train.directions is not None:
        lengths = train.directions.norm(dim=1)
        wrong = torch.nonzero(~(lengths > 0)).flatten()
        if len(wrong):
            row = int(wrong[0])
            raise FitError(
                f"{train.names[row]}: its direction is a vector of length zero: give the way the hammer moved, or "
                "leave nx, ny, nz out for all strikes"
            )


_POINTS: WeakKeyDictionary[ElasticModes, Tensor] = WeakKeyDictionary()
"""Points all over bodies' surfaces."""
