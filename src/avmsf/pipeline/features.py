"""From Gaussians and views to the features that a gain field reads: described, lifted, pooled over symmetries."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from avmsf._utils.device import usable_device
from avmsf.errors import SceneError
from avmsf.features.descriptors import ImageDescriptors
from avmsf.features.dino import DinoEncoder
from avmsf.features.encoder import Encoder
from avmsf.features.feature_field import FeatureField, reduce, resize, with_positions
from avmsf.features.lift import Lifted, by_presence, by_visibility, lift, lift_points, supported
from avmsf.features.pooling import orbit_spread, refine
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.points import sample_surface
from avmsf.gaussians.rasterizer.protocol import Rasterizer
from avmsf.gaussians.visibility import depth_of_surface
from avmsf.mesh.surface import Surface
from avmsf.photographs.cameras import View
from avmsf.pipeline.config import AUTO, DESCRIPTORS, DINO, LiftConfig
from avmsf.symmetry.find import find_symmetries
from avmsf.symmetry.symmetries import Symmetries

_WEIGHTINGS = {"plain": by_presence, "visibility": by_visibility}


@dataclass(frozen=True, eq=False)
class MadeFeatures:
    """Features, and what came to light on the way."""

    features: FeatureField
    symmetries: Symmetries | None
    """None where none were looked for."""
    report: dict[str, Any]
    """Plain values: encoder, points, how many of them no view sees and how many were left out, agreement of the views,
    symmetries, spread over orbits."""


def choose_encoder(config: LiftConfig, *, log: Callable[[str], None], device: str | None = None) -> Encoder:
    """Return the encoder that the settings name, on a device as for `usable_device`.

    Raises SceneError where either is not available.
    """
    if config.encoder == DESCRIPTORS:
        return ImageDescriptors()
    place = usable_device(device, raising=SceneError)
    if config.encoder != AUTO:
        return DinoEncoder.load(config.encoder, longest=config.longest, device=place)
    try:
        return DinoEncoder.load(DINO, longest=config.longest, device=place)
    except SceneError as error:
        log(f"encoder: the built-in descriptors are used in place of DINOv2 ({error})")
        return ImageDescriptors()


def settled(config: LiftConfig, *, log: Callable[[str], None], device: str | None = None) -> LiftConfig:
    """Return the settings with the encoder that `auto` means here; `log` reports any other than DINOv2."""
    if config.encoder != AUTO:
        return config
    found = choose_encoder(config, log=log, device=device)
    return replace(config, encoder=DESCRIPTORS if isinstance(found, ImageDescriptors) else DINO)


def lift_to_cloud(
    cloud: GaussianCloud,
    views: Sequence[View],
    encoder: Encoder,
    config: LiftConfig,
    *,
    rasterizer: Rasterizer,
    progress: Callable[[int, int, str], None] | None = None,
) -> Lifted:
    """Lift features onto the Gaussians that views see, as the settings say."""
    weighting = _WEIGHTINGS[config.weighting]
    lifted = lift(
        cloud,
        views,
        encoder,
        rasterizer=rasterizer,
        weighting=weighting,
        inpainted=config.encoder_background == "inpainted",
        progress=progress,
    )
    return supported(lifted)


def lift_to_surface(
    surface: Surface,
    views: Sequence[View],
    encoder: Encoder,
    config: LiftConfig,
    *,
    progress: Callable[[int, int, str], None] | None = None,
) -> Lifted:
    """Lift features onto points drawn evenly from a mesh, whose triangles hide what lies behind them."""
    generator = torch.Generator().manual_seed(config.seed)
    points = sample_surface(surface.vertices, surface.faces, config.points, generator=generator)
    weighting = _WEIGHTINGS[config.weighting]
    depth_map = depth_of_surface(surface)
    return lift_points(
        points,
        views,
        encoder,
        depth_map=depth_map,
        weighting=weighting,
        inpainted=config.encoder_background == "inpainted",
        progress=progress,
    )


def finish_features(lifted: Lifted, config: LiftConfig) -> MadeFeatures:
    """Reduce lifted features, pool them over the symmetries that the points have, and set positions beside them."""
    features = lifted.features
    if config.components:
        features = reduce(features, config.components)
    # Before pooling, which is meant to shrink what is noise.
    features = resize(features, config.feature_size if config.positions else 1.0)
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
        symmetries = find_symmetries(features.points, seed=generator)
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
