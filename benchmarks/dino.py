"""Gaussians from 63 real photographs of a ceramic dinosaur, compared with 10 that they never saw."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch

from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.fit import SplatProgress, splat
from avmsf.gaussians.rasterizer.rasterizers import choose_rasterizer
from avmsf.gaussians.ssim import psnr, ssim
from avmsf.gaussians.targets import pyramid
from avmsf.photographs import find_foreground, read_views
from avmsf.photographs.cameras import View
from avmsf.symmetry.find import find_symmetries
from benchmarks.objects import shared_data
from benchmarks.processes import apart, peak_gigabytes, timed
from benchmarks.records import Record, Settings, records

EVERY = 8
"""Of the views in order of their names, every eighth is held out, the first of them too."""
CONFIG = SplatConfig()
QUICK = replace(CONFIG, steps=60, start_points=2000, gaussians=3000)


def dino(settings: Settings) -> Iterator[Record]:
    """PSNR and SSIM over the held-out views, renderings before black against the photographs as they are.

    psnr_mask: inside the found masks. seconds: from photographs in memory to the Gaussians that lie on the object,
    without the evaluation of held-out views; of these the masks took masking_seconds; compiling or loading the kernels
    took compiling_seconds more. gigabytes: peak memory of the process. By step: before what lies off the object is
    removed.
    """
    shared_data()
    values, curve, symmetries = apart(fit_dino, settings.quick)
    for step, point in curve.items():
        yield from records(point, group=f"step {step}")
    yield from records(values, note=symmetries)


def fit_dino(quick: bool) -> tuple[dict[str, float], dict[int, dict[str, float]], str]:
    """Fit the Gaussians; return values of all of it, those by step, and the symmetries in words."""
    views = [_small(view) if quick else view for view in read_views(shared_data() / "dino")]
    config = QUICK if quick else CONFIG
    # Of the photographs to fit alone; the masks that held-out ones are compared in come from all, and serve only that.
    train, masking = timed(lambda: list(find_foreground(_hold_out(views)[0])))
    _, held = _hold_out(find_foreground(views))
    # A few steps on small images compile all that is compiled at first use, and loads it later.
    warmup = replace(QUICK, steps=10, densify_every=5)
    _, compiling = timed(lambda: splat([_small(view) for view in train], warmup, device="cpu"))
    curve: dict[int, dict[str, float]] = {}
    paused = 0.0

    def evaluate(progress: SplatProgress) -> None:
        nonlocal paused
        if progress.step % max(10, config.steps // 100 * 10) == 0:
            seconds = time.perf_counter() - begun - paused
            scores, taken = timed(lambda: _scores(progress.cloud, held))
            curve[progress.step] = {"seconds": seconds, "gaussians": len(progress.cloud), **scores}
            paused += taken

    begun = time.perf_counter()
    cloud = splat(train, config, device="cpu", progress=evaluate)
    seconds = time.perf_counter() - begun - paused
    values = _scores(cloud, held)
    symmetries = find_symmetries(cloud.centers, seed=0).summary()
    values |= {"seconds": masking + seconds, "gigabytes": peak_gigabytes(), "gaussians": len(cloud)}
    return values | {"masking_seconds": masking, "compiling_seconds": compiling}, curve, symmetries


def _hold_out(views: Sequence[View]) -> tuple[list[View], list[View]]:
    """Return the views to fit, and every eighth by name, which is held out."""
    ordered = sorted(views, key=lambda view: view.name)
    return [view for row, view in enumerate(ordered) if row % EVERY], ordered[::EVERY]


def _scores(cloud: GaussianCloud, views: Sequence[View]) -> dict[str, float]:
    """Return mean PSNR over the image and inside the mask, dB, and mean SSIM."""
    render, sums = choose_rasterizer("cpu"), {"psnr": 0.0, "psnr_mask": 0.0, "ssim": 0.0}
    for view in views:
        # Black: what lies behind the dinosaur in every photograph, and no parameter fitted to those held out.
        image = render(cloud.detach(), view.camera, background=torch.zeros(3)).color
        assert view.mask is not None
        sums["psnr"] += psnr(image, view.color)
        sums["psnr_mask"] += psnr(image, view.color, inside=view.mask > 127)
        sums["ssim"] += float(ssim(image, view.color))
    return {name: value / len(views) for name, value in sums.items()}


def _small(view: View) -> View:
    return pyramid(view, halvings=2)[-1]
