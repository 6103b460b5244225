"""From views to the features that a gain field reads: described, lifted onto the object, pooled over symmetries."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch

from avmsf._utils.device import usable_device
from avmsf.errors import SceneError
from avmsf.features.dino import DinoEncoder
from avmsf.features.efficientnet import NAME as EFFICIENTNET
from avmsf.features.efficientnet import EfficientNetEncoder
from avmsf.features.encoder import Encoder, ImageDescriptors
from avmsf.features.feature_field import FeatureField, expect_varied, reduce, resize, with_positions
from avmsf.features.lift import Lifted, by_presence, by_visibility, lift, lift_points, supported
from avmsf.features.pooling import orbit_spread, refine
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.mesh.surface import Surface, sample_surface
from avmsf.photographs.cameras import View
from avmsf.photographs.mesh_views import MeshTracer
from avmsf.pipeline.config import AUTO, DESCRIPTORS, DINO, LiftConfig
from avmsf.symmetry.find import find_symmetries


def choose_encoder(config: LiftConfig, *, log: Callable[[str], None], device: str | None = None) -> Encoder:
    """Return the encoder that the settings name, on a device as for `usable_device`.

    Raises SceneError where either is not available.
    """
    if config.encoder == DESCRIPTORS:
        return ImageDescriptors()
    place = usable_device(device, raising=SceneError)
    if config.encoder == EFFICIENTNET:
        return EfficientNetEncoder.load(longest=config.longest, device=place)
    if config.encoder != AUTO:
        return DinoEncoder.load(config.encoder, longest=config.longest, device=place)
    try:
        return DinoEncoder.load(DINO, longest=config.longest, device=place)
    except SceneError as error:
        log(f"encoder: the built-in descriptors are used in place of DINOv2 ({error})")
        return ImageDescriptors()


def lift_features(
    shape: Surface | GaussianCloud,
    views: Sequence[View],
    encoder: Encoder,
    config: LiftConfig,
    *,
    progress: Callable[[int, int, str], None] | None = None,
) -> Lifted:
    """Lift features onto the Gaussians that views see, or onto points drawn evenly from a mesh, as the settings say.

    The triangles of a mesh hide what lies behind them. Raises SceneError where no view sees a point.
    """
    weighting = by_visibility if config.weighting == "visibility" else by_presence
    inpainted = config.encoder_background == "inpainted"
    if isinstance(shape, GaussianCloud):
        return supported(lift(shape, views, encoder, weighting=weighting, inpainted=inpainted, progress=progress))
    points = sample_surface(shape, config.points, seed=config.seed)
    return lift_points(
        points,
        views,
        encoder,
        depth_map=MeshTracer(shape).depth,
        weighting=weighting,
        inpainted=inpainted,
        progress=progress,
    )


def finish_features(lifted: Lifted, config: LiftConfig) -> tuple[FeatureField, dict[str, Any]]:
    """Reduce lifted features, pool them over the symmetries that the points have, and set positions beside them.

    Returns the features and a report of plain values: encoder, points, how many of them no view sees and how many were
    left out, agreement of the views, symmetries, spread over orbits before and after, and the root mean squares of the
    features' length and of their distance from their mean.
    """
    features = lifted.features
    if config.components:
        # Before pooling, which is meant to shrink what is noise. Positions are about .5 long.
        features = resize(reduce(features, config.components), 0.3 if config.positions else 1.0)
    else:
        expect_varied(features)
        if config.standardize:
            features = resize(replace(features, features=features.features - features.features.mean(0)), 1.0)
    report: dict[str, Any] = {
        "encoder": lifted.features.encoder,
        "points": len(features.points),
        "unseen": lifted.unseen,
        "dropped": lifted.dropped,
        "agreement": lifted.agreement,
    }
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
    values = features.features.double()
    for name, each in {"length": values, "variation": values - values.mean(0)}.items():
        report[name] = float(each.square().sum(1).mean().sqrt())
    return features, report
