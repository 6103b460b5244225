"""The CPU rasterizer: how right it is, beside the oracle, and how fast, beside plain torch."""

import math
import os
import time
from collections.abc import Callable
from dataclasses import fields
from statistics import median

import numba
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.rasterizer.devices import NumbaRasterizer
from avmsf.gaussians.rasterizer.protocol import Rendering
from avmsf.photographs.cameras import Camera
from benchmarks.rasterizers import render_everywhere, render_padded
from benchmarks.report import Options, Report, Table, log

_BACKGROUND = torch.tensor([0.2, 0.5, 0.9])
_TENSORS = tuple(each.name for each in fields(GaussianCloud))


def measure_rasterizer(options: Options) -> Report:
    """Return error and time at 10,000 Gaussians and 256 x 256 pixels; the oracle judges the same cloud."""
    count, side, repeats = (300, 48, 2) if options.quick_look else (10_000, 256, 15)
    cloud, camera = speckled_sphere(count), looking_at_sphere(side)
    target = torch.rand(side, side, 3, generator=torch.Generator().manual_seed(1))
    own = NumbaRasterizer()
    times: list[tuple[float, float]] = []
    # The first turn compiles and fills caches; it is not counted.
    for repeat in range(repeats + 1):
        times.append((_seconds(own, cloud, camera, target), _seconds(render_padded, cloud, camera, target)))
        log(f"rasterizer {repeat} of {repeats}: {1e3 * times[-1][0]:.1f} ms, padded {1e3 * times[-1][1]:.0f} ms")
    taken, plain = (median(column) for column in zip(*times[1:], strict=True))
    best, plain_best = (min(column) for column in zip(*times[1:], strict=True))
    image_error, gradient_errors, undecided = compare(cloud, camera)
    figures = {
        "rasterizer.speedup": plain / taken,
        "rasterizer.image_error": image_error,
        "rasterizer.gradient_error": max(gradient_errors.values()),
        "rasterizer.step_milliseconds": 1e3 * taken,
        "rasterizer.step_milliseconds_least": 1e3 * best,
        "rasterizer.padded_milliseconds": 1e3 * plain,
        "rasterizer.padded_milliseconds_least": 1e3 * plain_best,
        "rasterizer.undecided_pixels": undecided,
    }
    conventions = (
        f"rasterizer: {count} Gaussians of degree 1 on a sphere, {side} x {side} pixels, numba "
        f"{numba.get_num_threads()} and torch {torch.get_num_threads()} threads on {os.cpu_count()} processors; image "
        f"and gradients of its L1 distance from a noise image, medians of {repeats} turns taken by the two in "
        "alternation. speedup: 16 x 16 tiles padded to the longest list, plain torch and autograd, over ours.",
        "image_error: largest difference from the oracle, every Gaussian at every pixel in float64; gradient_error: "
        "norm of the difference over norm, the worst tensor. Left out of both: undecided_pixels, the part of the image "
        "where a Gaussian covers 1/255 or would leave 1e-4 within one part in 5,000, so that rounding decides.",
    )
    rows = list(figures.items()) + [(f"gradient_error of {name}", error) for name, error in gradient_errors.items()]
    return Report(conventions, (Table("rasterizer", ("figure", "value"), rows),), figures)


def speckled_sphere(count: int, *, degree: int = 1, seed: int = 0) -> GaussianCloud:
    """Return Gaussians of many shapes, opacities and colors about a sphere of 0.1 m, each overlapping some others."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Float[Tensor, "..."]:
        return torch.randn(*shape, generator=generator)

    directions = torch.nn.functional.normalize(draw(count, 3), dim=1)
    spacing = 0.1 * math.sqrt(4 * math.pi / count)
    return GaussianCloud(
        centers=0.1 * directions * (1 + 0.02 * draw(count, 1)),
        rotations=draw(count, 4),
        log_scales=math.log(0.5 * spacing) + 0.4 * draw(count, 3),
        logit_opacities=2 * draw(count),
        harmonics=0.5 * draw(count, (degree + 1) ** 2, 3),
    )


def looking_at_sphere(side: int) -> Camera:
    """Return a camera at 0.3 m from the sphere's middle, which the sphere fills to about four fifths."""
    position = torch.tensor([0.18, -0.192, 0.144])
    up = torch.tensor([0.0, 0.0, 1.0])
    return Camera.looking(position, torch.zeros(3), up=up, focal=1.18 * side, width=side, height=side)


def compare(cloud: GaussianCloud, camera: Camera, *, band: int = 8) -> tuple[float, dict[str, float], float]:
    """Return the image's largest error, each tensor's relative gradient error, and the part of pixels left out.

    The oracle takes `band` rows of the image at a time.
    """
    own_cloud, true_cloud = _leaves(cloud, torch.float32), _leaves(cloud, torch.float64)
    own = NumbaRasterizer()(own_cloud, camera, background=_BACKGROUND)
    slopes = torch.randn(own.color.shape, generator=torch.Generator().manual_seed(2))
    worst, left_out = 0.0, 0
    for top in range(0, camera.height, band):
        rows = range(top, min(top + band, camera.height))
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


def _seconds(
    render: Callable[..., Rendering], cloud: GaussianCloud, camera: Camera, target: Float[Tensor, "height width 3"]
) -> float:
    """Return how long an image, its L1 distance from the target and the gradients take."""
    leaves = _leaves(cloud, torch.float32)
    begun = time.perf_counter()
    loss = (render(leaves, camera, background=_BACKGROUND).color - target).abs().mean()
    loss.backward()  # type: ignore[no-untyped-call]
    return time.perf_counter() - begun
