"""From Gaussians and views to the features that a gain field reads: described, lifted, pooled over symmetries."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch

from avmsf._utils.device import usable_device
from avmsf.capture.cameras import View
from avmsf.capture.surface import Surface
from avmsf.errors import SceneError
from avmsf.scene.descriptors import ImageDescriptors
from avmsf.scene.dino import DinoEncoder
from avmsf.scene.encode import Encoder
from avmsf.scene.features import FeatureField
from avmsf.scene.gaussians import GaussianCloud
from avmsf.scene.lift import Lifted, LiftProgress, by_presence, by_visibility, lift, lift_points, supported
from avmsf.scene.points import sample_surface
from avmsf.scene.rasteriser import Rasteriser
from avmsf.scene.reduction import reduce, resize, with_positions
from avmsf.scene.refine import ANGLES, orbit_spread, refine
from avmsf.scene.symmetry import Symmetries
from avmsf.scene.symmetrysearch import find_symmetries
from avmsf.scene.visibility import depth_of_surface

DINO = "facebook/dinov2-base"
DESCRIPTORS = "descriptors"
AUTO = "auto"
_WEIGHTINGS = {"plain": by_presence, "visibility": by_visibility}


@dataclass(frozen=True)
class LiftConfig:
    """Settings of the features."""

    encoder: str = AUTO
    """What describes the images: the name of a DINOv2 model (such as facebook/dinov2-base), a folder that holds one,
    `descriptors` (built in, no download), or `auto`: DINOv2 base where it is to be had, else the built-in ones."""
    longest: int = 518
    """Pixels of an image's longer side as DINOv2 sees it."""
    background: Literal["inpainted", "kept"] = "inpainted"
    """What the encoder sees outside an object's mask: the object's colors carried on, or the image as it is (paper)."""
    weighting: Literal["plain", "visibility"] = "visibility"
    """How the views that see a point are averaged: by how well they see it, or plainly (paper)."""
    components: int = 32
    """Principal components of the features to keep; 0 keeps the features as they are."""
    symmetry: bool = True
    """Whether features are made alike where the object's symmetries make its shape alike."""
    missing: float = 0.1
    """Part of the object's surface that may have its counterpart in a hole of the points, for a symmetry to count: more
    where large parts of the object were not seen, up to .45."""
    iterations: int = 3
    """How often features are pooled over the symmetries (paper: T)."""
    angles: int = ANGLES
    """Angles that stand for all of a continuous rotation (paper: the size of Theta)."""
    reach: float = 3.0
    """Point spacings within which the nearest point is a symmetric counterpart; 0 takes it at any distance (paper)."""
    positions: bool = True
    """Whether the points' positions, relative to the object's size, stand before the features."""
    size: float = 0.3
    """Root mean square length of the features beside positions, which are about .5 long; alone they have length 1."""
    onto: Literal["mesh", "gaussians"] = "mesh"
    """What is the object where a folder shows a mesh alone: its own surface, or Gaussians fitted to pictures of it."""
    points: int = 8192
    """Points of a mesh whose own surface is the object."""
    seed: int = 0
    """Start of all chance: which points of a mesh, which of them the search for symmetries looks at."""

    def __post_init__(self) -> None:
        for name, least in {"longest": 1, "components": 0, "iterations": 1, "angles": 2, "points": 100}.items():
            if getattr(self, name) < least:
                raise SceneError(f"{name} = {getattr(self, name)}: expected {least} or more")
        if not 0 <= self.missing <= 0.45:
            raise SceneError(f"missing = {self.missing}: expected 0 to 0.45")
        if not 0 <= self.reach < math.inf:
            raise SceneError(f"reach = {self.reach}: expected a number of point spacings, or 0 for any distance")
        if not 0 < self.size < math.inf:
            raise SceneError(f"size = {self.size}: expected more than 0")


@dataclass(frozen=True, eq=False)
class MadeFeatures:
    """Features, and what came to light on the way."""

    features: FeatureField
    symmetries: Symmetries | None
    """None where none were looked for."""
    report: dict[str, Any]
    """Plain values: encoder, points, how many of them no view sees and how many were left out, agreement of the views,
    symmetries, spread over orbits."""


def choose_encoder(config: LiftConfig, *, tell: Callable[[str], None], device: str | None = None) -> Encoder:
    """Return the encoder that the settings name, on a device as for `usable_device`.

    Raises SceneError where either is not to be had.
    """
    if config.encoder == DESCRIPTORS:
        return ImageDescriptors()
    place = usable_device(device, raising=SceneError)
    if config.encoder != AUTO:
        return DinoEncoder.load(config.encoder, longest=config.longest, device=place)
    try:
        return DinoEncoder.load(DINO, longest=config.longest, device=place)
    except SceneError as error:
        reason = str(error).split(":")[0]
        tell(f"encoder: the built-in descriptors, for {DINO} is not to be had: {reason}")
        return ImageDescriptors()


def settled(config: LiftConfig, *, tell: Callable[[str], None]) -> LiftConfig:
    """Return the settings with the encoder that `auto` means here, which `tell` hears of if it is not DINOv2."""
    if config.encoder != AUTO:
        return config
    found = choose_encoder(config, tell=tell)
    return replace(config, encoder=DESCRIPTORS if isinstance(found, ImageDescriptors) else DINO)


def lift_to_cloud(
    cloud: GaussianCloud,
    views: Sequence[View],
    encoder: Encoder,
    config: LiftConfig,
    *,
    rasteriser: Rasteriser,
    progress: Callable[[LiftProgress], None] | None = None,
) -> Lifted:
    """Lift features onto the Gaussians that views see, as the settings say."""
    weighting = _WEIGHTINGS[config.weighting]
    lifted = lift(
        cloud,
        views,
        encoder,
        rasteriser=rasteriser,
        weighting=weighting,
        inpainted=config.background == "inpainted",
        progress=progress,
    )
    return supported(lifted, views)


def lift_to_surface(
    surface: Surface,
    views: Sequence[View],
    encoder: Encoder,
    config: LiftConfig,
    *,
    progress: Callable[[LiftProgress], None] | None = None,
) -> Lifted:
    """Lift features onto points drawn evenly from a mesh, whose triangles hide what lies behind them."""
    generator = torch.Generator().manual_seed(config.seed)
    points = sample_surface(surface.vertices, surface.faces, config.points, generator=generator).points
    weighting = _WEIGHTINGS[config.weighting]
    depth_map = depth_of_surface(surface)
    return lift_points(
        points,
        views,
        encoder,
        depth_map=depth_map,
        weighting=weighting,
        inpainted=config.background == "inpainted",
        progress=progress,
    )


def finish_features(lifted: Lifted, config: LiftConfig) -> MadeFeatures:
    """Reduce lifted features, pool them over the symmetries that the points have, and set positions beside them."""
    features = lifted.features
    if config.components:
        features = reduce(features, config.components)
    # Before pooling, which is meant to shrink what is noise.
    features = resize(features, config.size if config.positions else 1.0)
    report: dict[str, Any] = {
        "encoder": lifted.features.encoder,
        "points": len(features.points),
        "unseen": lifted.unseen,
        "dropped": lifted.dropped,
        "agreement": lifted.agreement,
    }
    symmetries = None
    if config.symmetry:
        generator = torch.Generator().manual_seed(config.seed)
        symmetries = find_symmetries(features.points, seed=generator, missing=config.missing)
        report["symmetries"] = symmetries.to_dict()
        if symmetries:
            pooled = refine(
                features, symmetries, iterations=config.iterations, angles=config.angles, reach=config.reach
            )
            spreads = (orbit_spread(each, symmetries, angles=config.angles) for each in (features, pooled))
            report["orbit_spread"] = list(spreads)
            features = pooled
    if config.positions:
        features = with_positions(features)
    return MadeFeatures(features, symmetries, report)
