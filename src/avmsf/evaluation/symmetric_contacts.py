"""The places of an object that its symmetries carry one place to: all of them are right where one is."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.simulate.shapes.shape import Symmetry
from avmsf.symmetry.symmetries import MirrorSymmetry, RotationalSymmetry, Symmetries

_ALIKE = 0.15
"""Largest norm of the difference of two rotations that are taken for one: symmetries that were found on a cloud do not
close exactly, and those of order 12 are .73 apart."""
_MOST = 240
"""Motions; the largest group of turns and mirrors without an axis of any angle has 120."""
_ANGLES = 720
"""Places around an axis of any angle: the nearest of them is within .5 % of the radius of the nearest of all."""
_ON_BALL = 10_000
"""Places on a ball."""


@dataclass(frozen=True, eq=False)
class Images:
    """All motions that follow from some symmetries, those about axes of any angle apart."""

    motions: Float64[Tensor, "motions 4 4"]
    """Affine maps of the object frame, meters; standing still is the first."""
    continuous: tuple[RotationalSymmetry, ...]
    """Axes of any angle: one of them, or two that make a ball."""

    @classmethod
    def of(cls, symmetries: Symmetries) -> "Images":
        """Return what follows from symmetries one after the other."""
        steps: list[RotationalSymmetry | MirrorSymmetry] = [*symmetries.rotations, *symmetries.mirrors]
        single = [_motion(each) for each in steps if isinstance(each, MirrorSymmetry) or not each.continuous]
        found = [torch.eye(4, dtype=torch.float64)]
        # The list grows while it is walked along: every new motion is followed by every single one in turn.
        for motion in found:
            for step in single:
                made = step @ motion
                if len(found) < _MOST and not any(_alike(made, each) for each in found):
                    found.append(made)
        return cls(torch.stack(found), _axes(tuple(each for each in symmetries.rotations if each.continuous)))

    @classmethod
    def none(cls) -> "Images":
        """Return what an object without symmetry has: standing still."""
        return cls(torch.eye(4, dtype=torch.float64)[None], ())

    def at(self, place: Float[Tensor, " 3"]) -> Float64[Tensor, "images 3"]:
        """Return the images of a place (object frame, meters), itself the first; the place itself may be repeated."""
        there = place.detach().double().cpu()
        images = self.motions[:, :3, :3] @ there + self.motions[:, :3, 3]
        if not self.continuous:
            return images
        if len(self.continuous) > 1:
            return torch.cat([images[:1], _ball(self.continuous, there)])
        axis = self.continuous[0]
        return torch.cat([axis.turn(images, angle) for angle in axis.angles(_ANGLES)])


def symmetries_of(symmetry: Symmetry) -> Symmetries:
    """Return the known symmetry of a made shape as one that was found without error."""
    rotations = (
        ()
        if symmetry.axis is None
        else (RotationalSymmetry(symmetry.axis, symmetry.point, symmetry.order, error=0.0, missing=0.0),)
    )
    mirrors = tuple(MirrorSymmetry(normal, symmetry.point, error=0.0, missing=0.0) for normal in symmetry.mirrors)
    return Symmetries(rotations, mirrors, spacing=0.0, tolerance=0.0, rejected=math.inf)


def _motion(symmetry: RotationalSymmetry | MirrorSymmetry) -> Float64[Tensor, "4 4"]:
    """Return the affine map of one step: a mirror's, or a turn by 1/order."""
    corners = torch.cat([torch.zeros(1, 3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)])
    moved = (
        symmetry.reflect(corners)
        if isinstance(symmetry, MirrorSymmetry)
        else symmetry.turn(corners, symmetry.angles(1)[1])
    )
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = (moved[1:] - moved[0]).T
    motion[:3, 3] = moved[0]
    return motion


def _alike(one: Float64[Tensor, "4 4"], other: Float64[Tensor, "4 4"]) -> bool:
    # All motions leave the object's middle where it is, so that two with one rotation are one.
    return float((one[:3, :3] - other[:3, :3]).norm()) < _ALIKE


def _axes(found: tuple[RotationalSymmetry, ...]) -> tuple[RotationalSymmetry, ...]:
    """Return one axis, or two that differ, of which all others follow."""
    others = [each for each in found[1:] if abs(float(each.axis.double() @ found[0].axis.double())) < 0.99]
    return (*found[:1], *others[:1])


def _ball(axes: tuple[RotationalSymmetry, ...], place: Float64[Tensor, " 3"]) -> Float64[Tensor, "images 3"]:
    """Return places spread evenly, along a spiral, over the sphere about the middle that holds a place."""
    middle = torch.stack([each.point.double() for each in axes]).mean(dim=0)
    steps = torch.arange(_ON_BALL, dtype=torch.float64)
    height = 1.0 - 2.0 * (steps + 0.5) / _ON_BALL
    angle = math.pi * (1.0 + math.sqrt(5.0)) * steps
    across = torch.sqrt(1.0 - height.square())
    directions = torch.stack([across * torch.cos(angle), across * torch.sin(angle), height], dim=1)
    return middle + (place - middle).norm() * directions
