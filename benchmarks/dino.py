"""Gaussians from 63 real photographs of a ceramic dinosaur, judged on 10 that they never saw.

`python -m benchmarks.dino` fits them in a process of its own, whose peak memory is theirs, and prints JSON.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.fit import SplatProgress, splat
from avmsf.gaussians.rasterizer.devices import choose_rasterizer
from avmsf.gaussians.rasterizer.protocol import Rasterizer
from avmsf.gaussians.ssim import psnr, ssim
from avmsf.gaussians.targets import pyramid
from avmsf.photographs import find_foreground, read_views
from avmsf.photographs.cameras import View
from avmsf.symmetry.find import find_symmetries
from benchmarks.material import REPOSITORY, shared_data
from benchmarks.report import Options, Report, Table, log
from benchmarks.step import peak_gigabytes

EVERY = 8
"""Of the views in order of their names, every eighth is held out, the first of them too."""
CONFIG = SplatConfig()
QUICK = replace(CONFIG, steps=60, start_points=2000, gaussians=3000)
_LOOKS = 10
"""Points on the curve of PSNR over time."""


def measure_dino(options: Options) -> Report:
    """Fit the Gaussians and return how well they predict photographs, and what that took."""
    command = [sys.executable, "-m", "benchmarks.dino", *(["--quick-look"] if options.quick_look else [])]
    shared_data()
    done = subprocess.run(command, cwd=REPOSITORY, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}; its message is above")
    found = json.loads(done.stdout.splitlines()[-1])
    figures = {f"dino.{name}": value for name, value in found["figures"].items()}
    return Report((_convention(options, found),), (_curve(found["curve"]), _result(figures)), figures)


def hold_out(views: Sequence[View]) -> tuple[list[View], list[View]]:
    """Return the views to fit, and every eighth by name, which is held out."""
    ordered = sorted(views, key=lambda view: view.name)
    return [view for row, view in enumerate(ordered) if row % EVERY], ordered[::EVERY]


def judge(cloud: GaussianCloud, views: Sequence[View], *, rasterizer: Rasterizer) -> dict[str, float]:
    """Return mean PSNR over the image and inside the mask, dB, and mean SSIM, against the photographs as they are."""
    sums = {"psnr": 0.0, "psnr_mask": 0.0, "ssim": 0.0}
    for view in views:
        # Black: what lies behind the dinosaur in every photograph, and no parameter fitted to those held out.
        image = rasterizer(cloud.detach(), view.camera, background=torch.zeros(3)).color
        assert view.mask is not None
        sums["psnr"] += psnr(image, view.color)
        sums["psnr_mask"] += psnr(image, view.color, inside=view.mask > 127)
        sums["ssim"] += float(ssim(image, view.color))
    return {name: value / len(views) for name, value in sums.items()}


def _fit(*, quick_look: bool) -> dict[str, Any]:
    views = list(read_views(shared_data() / "dino"))
    if quick_look:
        views = [_small(view) for view in views]
    config, rasterizer = QUICK if quick_look else CONFIG, choose_rasterizer("cpu")
    bare, _ = hold_out(views)
    began = time.perf_counter()
    # Of the photographs to fit alone; the masks that held-out ones are judged in come from all, and serve nothing else.
    train = list(find_foreground(bare))
    masking = time.perf_counter() - began
    _, held = hold_out(find_foreground(views))
    size = f"{train[0].camera.width} x {train[0].camera.height}"
    began = time.perf_counter()
    # A few steps on small images compile all that is compiled at first use, and loads it later.
    splat([_small(view) for view in train], replace(QUICK, steps=10, densify_every=5), rasterizer=rasterizer)
    compiling = time.perf_counter() - began
    curve: list[dict[str, float]] = []
    judging = 0.0

    def look(progress: SplatProgress) -> None:
        nonlocal judging
        if progress.step % max(10, config.steps // _LOOKS // 10 * 10) == 0:
            paused = time.perf_counter()
            curve.append(
                {
                    "seconds": paused - began - judging,
                    "step": progress.step,
                    "gaussians": len(progress.cloud),
                    **judge(progress.cloud, held, rasterizer=rasterizer),
                }
            )
            log(f"dino: step {progress.step} of {config.steps}, {curve[-1]['psnr']:.2f} dB")
            judging += time.perf_counter() - paused

    began = time.perf_counter()
    cloud = splat(train, config, rasterizer=rasterizer, progress=look)
    seconds = time.perf_counter() - began - judging
    figures = judge(cloud, held, rasterizer=rasterizer)
    symmetries = find_symmetries(cloud.centers, seed=0)
    figures |= {"seconds": masking + seconds, "gigabytes": peak_gigabytes(), "gaussians": float(len(cloud))}
    return {
        "figures": figures,
        "curve": curve,
        "masking": masking,
        "symmetries": symmetries.summary(),
        "compiling": compiling,
        "views": len(train),
        "size": size,
    }


def _small(view: View) -> View:
    return pyramid(view, halvings=2)[-1]


def _convention(options: Options, found: dict[str, Any]) -> str:
    config = QUICK if options.quick_look else CONFIG
    return (
        f"dino: {config.steps} steps on {found['views']} photographs of {found['size']} pixels, every eighth view by "
        "name held out. PSNR and SSIM are means over the held-out views of renderings before black against the "
        "photographs as they are, background included; psnr_mask inside the found masks. seconds: from photographs in "
        "memory to the Gaussians that lie on the object, without the looks at held-out views; of these the masks took "
        f"{found['masking']:.1f} s; compiling or loading the kernels took {found['compiling']:.1f} s more. Symmetries: "
        f"{found['symmetries']}"
    )


def _curve(curve: Sequence[dict[str, float]]) -> Table:
    columns = ("seconds", "step", "gaussians", "psnr", "psnr_mask", "ssim")
    rows: list[list[str | float]] = [
        [f"{point['seconds']:.1f}", *(point[name] for name in columns[1:])] for point in curve
    ]
    return Table("dino: held-out views over time, before what lies off the object is removed", columns, rows)


def _result(figures: dict[str, float]) -> Table:
    names = tuple(name.removeprefix("dino.") for name in figures)
    return Table("dino: the Gaussians on the object", ("", *names), [["dino", *figures.values()]])


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick-look", action="store_true")
    print(json.dumps(_fit(quick_look=parser.parse_args().quick_look)))


if __name__ == "__main__":
    _main()
