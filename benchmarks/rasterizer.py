"""The CPU rasterizer: its error against the oracle, and its time."""

import math
from collections.abc import Iterator
from dataclasses import fields
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.rasterizer.rasterizers import NumbaRasterizer
from avmsf.photographs.cameras import Camera
from benchmarks.processes import timed
from benchmarks.records import Record, Settings, records
from tests.oracles.gaussian_image import render_everywhere

_BACKGROUND = torch.tensor([0.2, 0.5, 0.9])
_TENSORS = tuple(each.name for each in fields(GaussianCloud))
_BAND = 8
"""Rows of the image that the oracle takes at a time."""


def rasterizer(settings: Settings) -> Iterator[Record]:
    """Image and gradients of its L1 distance from a noise image: 10,000 Gaussians on a sphere, 256 x 256 pixels.

    step_ms: median of 15, and least. image_error: largest difference from the oracle, every Gaussian at every pixel in
    float64; gradient_error: norm of the difference over norm, of the worst tensor and of each. Left out of both:
    undecided_pixels, the part of the image where a Gaussian covers 1/255 or would leave 1e-4 within one part in 5,000,
    so that rounding decides.
    """
    count, side, repeats = (300, 48, 2) if settings.quick else (10_000, 256, 15)
    cloud, camera = _speckled_sphere(count), _looking_at_sphere(side)
    target = torch.rand(side, side, 3, generator=torch.Generator().manual_seed(1))
    # The first compiles and fills caches; it is not counted.
    times = [_seconds(cloud, camera, target) for _ in range(repeats + 1)][1:]
    image_error, gradients, undecided = _compare(cloud, camera)
    values = {"image_error": image_error, "gradient_error": max(gradients.values()), "undecided_pixels": undecided}
    yield from records({**values, "step_ms": 1e3 * median(times), "step_ms_least": 1e3 * min(times)})
    for name, error in gradients.items():
        yield from records({"gradient_error": error}, group=name)


def _speckled_sphere(count: int) -> GaussianCloud:
    """Return Gaussians of many shapes, opacities and colors about a sphere of 0.1 m, each overlapping some others."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Float[Tensor, "..."]:
        return torch.randn(*shape, generator=generator)

    directions = torch.nn.functional.normalize(draw(count, 3), dim=1)
    spacing = 0.1 * math.sqrt(4 * math.pi / count)
    return GaussianCloud(
        centers=0.1 * directions * (1 + 0.02 * draw(count, 1)),
        rotations=draw(count, 4),
        log_scales=math.log(0.5 * spacing) + 0.4 * draw(count, 3),
        logit_opacities=2 * draw(count),
        harmonics=0.5 * draw(count, 4, 3),
    )


def _looking_at_sphere(side: int) -> Camera:
    """Return a camera at 0.3 m from the sphere's middle, which the sphere fills to about four fifths."""
    position, up = torch.tensor([0.18, -0.192, 0.144]), torch.tensor([0.0, 0.0, 1.0])
    return Camera.looking(position, torch.zeros(3), up=up, focal=1.18 * side, width=side, height=side)


def _compare(cloud: GaussianCloud, camera: Camera) -> tuple[float, dict[str, float], float]:
    """Return the image's largest error, each tensor's relative gradient error, and the part of pixels left out."""
    own_cloud, true_cloud = _leaves(cloud, torch.float32), _leaves(cloud, torch.float64)
    own = NumbaRasterizer()(own_cloud, camera, background=_BACKGROUND)
    slopes = torch.randn(own.color.shape, generator=torch.Generator().manual_seed(2))
    worst, left_out = 0.0, 0
    for top in range(0, camera.height, _BAND):
        rows = range(top, min(top + _BAND, camera.height))
        true, undecided = render_everywhere(true_cloud, camera, background=_BACKGROUND, rows=rows)
        slopes[rows.start : rows.stop][undecided] = 0.0
        difference = (own.color[rows.start : rows.stop] - true.color).detach()[~undecided]
        worst, left_out = max(worst, float(difference.abs().max())), left_out + int(undecided.sum())
        (true.color * slopes[rows.start : rows.stop]).sum().backward()  # type: ignore[no-untyped-call]
    (own.color * slopes).sum().backward()  # type: ignore[no-untyped-call]
    errors = {}
    for name in _TENSORS:
        expected, found = getattr(true_cloud, name).grad, getattr(own_cloud, name).grad
        errors[name] = float((found - expected).norm() / expected.norm())
    return worst, errors, left_out / (camera.width * camera.height)


def _leaves(cloud: GaussianCloud, dtype: torch.dtype) -> GaussianCloud:
    return GaussianCloud(*(getattr(cloud, name).detach().to(dtype).clone().requires_grad_() for name in _TENSORS))


def _seconds(cloud: GaussianCloud, camera: Camera, target: Float[Tensor, "height width 3"]) -> float:
    """Return how long an image, its L1 distance from the target and the gradients take."""
    leaves = _leaves(cloud, torch.float32)

    def step() -> None:
        image = NumbaRasterizer()(leaves, camera, background=_BACKGROUND).color
        (image - target).abs().mean().backward()  # type: ignore[no-untyped-call]

    return timed(step)[1]
