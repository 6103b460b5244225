"""From views to Gaussians: 3D Gaussian Splatting (Kerbl et al. 2023), in steps that a processor can afford."""

import importlib.util
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from avmsf._utils.state import read_checkpoint, write_checkpoint
from avmsf.errors import AvmsfWarning, SceneError
from avmsf.gaussians.checkpoint import fingerprint
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.fit_run import SplatRun
from avmsf.gaussians.initialize import StartPoints, photographed_colors, starting_cloud
from avmsf.gaussians.prune import keep_object
from avmsf.gaussians.rasterizer.protocol import Rasterizer, choose_rasterizer
from avmsf.gaussians.ssim import psnr
from avmsf.gaussians.targets import choose_backdrop, prepare_photographs
from avmsf.gaussians.visual_hull import visual_hull
from avmsf.photographs.cameras import View

_TELL_EVERY = 10
"""Least number of steps between reports of progress."""
_CHECKPOINT_SECONDS = 30.0


@dataclass(frozen=True, eq=False)
class SplatProgress:
    """Where a splatting stands."""

    step: int
    """Steps done."""
    steps: int
    """Steps in all."""
    loss: float
    """Loss of the last step."""
    psnr: float
    """Of the last step's image against its photograph, dB: one view, at the size that it is fitted at just then."""
    seconds: float
    """Since the start, or since it was resumed."""
    cloud: GaussianCloud
    """The Gaussians as they are; they change with the next step, so copy what is to be kept."""

    @property
    def gaussians(self) -> int:
        """How many there are."""
        return len(self.cloud)


def splat(
    views: Sequence[View],
    config: SplatConfig | None = None,
    *,
    start: StartPoints | None = None,
    device: torch.device | str | None = None,
    rasterizer: Rasterizer | None = None,
    progress: Callable[[SplatProgress], None] | None = None,
    checkpoint: str | Path | None = None,
) -> GaussianCloud:
    """Fit Gaussians to views and return those that lie on the object.

    They start at the points of `start`, or on the visual hull of the views' masks. Without a `device` or `rasterizer`
    they are fitted on a CUDA device if there is one and gsplat is installed, else on the CPU; they are returned on the
    CPU. There the same views, config and start give the same Gaussians on the same machine.

    With `checkpoint`, the state is saved there while it runs, on interruption and at the end, and a call with the
    same arguments continues from it to the same result; delete the file once the Gaussians are written. Raises
    `SceneError` for views or settings that nothing can be made of, and for a checkpoint that is not of these.
    """
    config = SplatConfig() if config is None else config
    device = _device(device, rasterizer)
    rasterizer = choose_rasterizer(device) if rasterizer is None else rasterizer
    began = time.monotonic()
    backdrop = choose_backdrop(views, config)
    photographs = prepare_photographs(views, backdrop, halvings=config.halvings)
    cloud = starting_cloud(
        _hull_points(views, config) if start is None else start,
        degree=config.degree,
        scale=config.start_scale,
        opacity=config.start_opacity,
        flatness=config.start_flatness,
    )
    run = SplatRun(cloud.to(device), photographs, backdrop, config, rasterizer=rasterizer)
    keeper = _Keeper(None if checkpoint is None else Path(checkpoint), fingerprint(views, cloud, config))
    keeper.resume(run)
    try:
        while run.step < config.steps:
            loss, rendering, target = run.advance()
            last, every = run.step == config.steps, max(_TELL_EVERY, run.losses_every)
            if progress is not None and (last or run.step % every == 0):
                likeness = psnr(rendering.color, target.image)
                elapsed = time.monotonic() - began
                progress(SplatProgress(run.step, config.steps, float(loss), likeness, elapsed, run.cloud))
            keeper.look(run)
    except KeyboardInterrupt:
        # During a step's changes, only the state saved before it is consistent.
        if run.whole:
            keeper.save(run)
        raise
    keeper.save(run)
    return keep_object(run.cloud, views, rasterizer=rasterizer).to("cpu")


class _Keeper:
    """Saves a run's state at intervals."""

    def __init__(self, path: Path | None, fingerprint: str) -> None:
        self.path, self.saved_at = path, time.monotonic()
        self.identity = {"view, initial point or setting": fingerprint}

    def resume(self, run: SplatRun) -> None:
        state = (
            None
            if self.path is None
            else read_checkpoint(self.path, self.identity, what="fit of Gaussians", raising=SceneError)
        )
        if state is not None:
            run.resume(state["run"])

    def look(self, run: SplatRun) -> None:
        if time.monotonic() - self.saved_at > _CHECKPOINT_SECONDS:
            self.save(run)

    def save(self, run: SplatRun) -> None:
        if self.path is None:
            return
        try:
            write_checkpoint(self.path, {"run": run.state()}, self.identity, raising=SceneError)
        except SceneError as error:
            # A full disk costs the checkpoint, not the run.
            message = f"the fit of the Gaussians continues without a new checkpoint: {error}"
            warnings.warn(AvmsfWarning(message, file=error.file, value=error.value), stacklevel=3)
        self.saved_at = time.monotonic()


def _hull_points(views: Sequence[View], config: SplatConfig) -> StartPoints:
    hull = visual_hull(views, points=config.start_points, dissent=config.wrong_masks)
    colors = photographed_colors(hull.points, views, spacing=hull.spacing)
    return StartPoints(hull.points, colors, hull.normals)


def _device(device: torch.device | str | None, rasterizer: Rasterizer | None) -> torch.device:
    if device is not None:
        return torch.device(device)
    usable = torch.cuda.is_available() and importlib.util.find_spec("gsplat") is not None
    return torch.device("cuda" if usable and rasterizer is None else "cpu")
