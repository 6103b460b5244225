"""From views to Gaussians: 3D Gaussian Splatting (Kerbl et al. 2023), in steps that a processor can afford."""

import importlib.util
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avmsf._utils.caching import content_digest
from avmsf._utils.checkpoint import Checkpoint
from avmsf._utils.device import steps_between_losses
from avmsf.errors import SceneError
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.density import Density, keep_object
from avmsf.gaussians.rasterizer.rasterizers import Rasterizer, Rendering, choose_rasterizer
from avmsf.gaussians.ssim import psnr, ssim
from avmsf.gaussians.start_points import StartPoints, starting_cloud, visual_hull
from avmsf.gaussians.targets import choose_background, comparable_views, pyramid
from avmsf.photographs.cameras import View

_MIN_PROGRESS_STEPS = 10
"""Least number of steps between reports of progress."""
_CHECKPOINT_VERSION = 3
_BETAS, _EPSILON = (0.9, 0.999), 1e-15
"""Adam's, as in 3DGS."""


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


@torch.enable_grad()
def splat(
    views: Sequence[View],
    config: SplatConfig | None = None,
    *,
    start: StartPoints | None = None,
    device: torch.device | str | None = None,
    progress: Callable[[SplatProgress], None] | None = None,
    checkpoint: str | Path | None = None,
) -> GaussianCloud:
    """Fit Gaussians to views and return those that lie on the object.

    They start at the points of `start`, or on the visual hull of the views' masks. Without a `device` they are fitted
    on a CUDA device if there is one and gsplat is installed, else on the CPU; they are returned on the CPU. There the
    same views, config and start give the same Gaussians on the same machine.

    With `checkpoint`, the state is saved there while it runs, on interruption and at the end, and a call with the
    same arguments continues from it to the same result; delete the file once the Gaussians are written. Raises
    `SceneError` for views or settings that nothing can be made of, and for a checkpoint that is not of these.
    """
    config = SplatConfig() if config is None else config
    usable = torch.cuda.is_available() and importlib.util.find_spec("gsplat") is not None
    device = torch.device(device or ("cuda" if usable else "cpu"))
    rasterizer = choose_rasterizer(device)
    began = time.monotonic()
    background = choose_background(views, config)
    photographs = comparable_views(views, background)
    if start is None:
        start = visual_hull(views, points=config.start_points, wrong_fraction=config.wrong_masks)
    cloud = starting_cloud(
        start,
        degree=config.degree,
        scale=config.start_scale,
        opacity=config.start_opacity,
        flatness=config.start_flatness,
    )
    run = _Run(cloud.to(device), photographs, background, config, rasterizer=rasterizer)
    identity = {"view, initial point or setting": _fingerprint(views, cloud, config)}
    kept = Checkpoint(checkpoint, identity, what="the fit of the Gaussians", raising=SceneError)
    if (state := kept.read()) is not None:
        run.resume(state)
    try:
        while run.step < config.steps:
            loss, rendered, photograph = run.train_step()
            last = run.step == config.steps
            if progress is not None and (last or run.step % max(_MIN_PROGRESS_STEPS, run.losses_every) == 0):
                likeness = psnr(rendered, photograph)
                progress(
                    SplatProgress(run.step, config.steps, float(loss), likeness, time.monotonic() - began, run.cloud)
                )
            if kept.due or (last and checkpoint is not None):
                kept.save(run.state())
    except KeyboardInterrupt:
        # During a step's changes, only the state saved before it is consistent.
        if run.whole and checkpoint is not None:
            kept.save(run.state())
        raise
    return keep_object(run.cloud, views, rasterizer=rasterizer).to("cpu")


def _fingerprint(views: Sequence[View], cloud: GaussianCloud, config: SplatConfig) -> str:
    """Return a digest of a fit's views, start and settings."""
    seen = [(view.name, view.camera.projection, view.image, view.mask) for view in views]
    return content_digest(_CHECKPOINT_VERSION, asdict(config), *chain.from_iterable(seen), *vars(cloud).values())


class _Run:
    """One run: parameters, optimizer, schedules and what one step does."""

    def __init__(
        self,
        cloud: GaussianCloud,
        photographs: Sequence[View],
        background: Float[Tensor, " 3"] | None,
        config: SplatConfig,
        *,
        rasterizer: Rasterizer,
    ) -> None:
        device = cloud.centers.device
        self.photographs = [
            [_on_device(level, device) for level in pyramid(view, halvings=config.halvings)] for view in photographs
        ]
        self.background = None if background is None else background.to(device)
        self.config, self.rasterizer, self.losses_every = config, rasterizer, steps_between_losses(device)
        self.half_diagonal = 0.5 * float((cloud.centers.amax(0) - cloud.centers.amin(0)).norm())
        self.parameters = {name: value.clone() for name, value in _named(cloud).items()}
        self.moments = {
            name: (torch.zeros_like(value), torch.zeros_like(value)) for name, value in self.parameters.items()
        }
        self.generator = torch.Generator().manual_seed(config.seed)
        self.queue: list[int] = []
        self.density = Density.zeros(cloud)
        self.step = 0
        self.whole = True

    @property
    def cloud(self) -> GaussianCloud:
        """The Gaussians as they are now; they change with the next step."""
        return self._cloud(self.parameters, self.config.degree)

    def train_step(self) -> tuple[Float[Tensor, ""], Float[Tensor, "height width 3"], Float[Tensor, "height width 3"]]:
        """Take one step; return the loss before it, the image rendered, and the one that it was compared with.

        Raises `SceneError` where the loss is no finite number, on a GPU some steps later.
        """
        config, done = self.config, self.step + 1
        view = self._next_view()
        photograph, background = self._compose(view)
        leaves = {name: value.detach().requires_grad_() for name, value in self.parameters.items()}
        cloud = self._cloud(leaves, self._degree())
        rendering = self.rasterizer(cloud, view.camera, background=background)
        growing = self.step < config.densify_until * config.steps
        if growing:
            rendering.screen.retain_grad()
        loss = self._loss(cloud, rendering, photograph, view.coverage)
        loss.backward()  # type: ignore[no-untyped-call]
        # Before densification too, to which there would seem to be no Gaussians.
        if done == config.steps or not done % self.losses_every or not done % config.densify_every:
            value = float(loss.detach())
            if not math.isfinite(value):
                advice = "lower center_rate, scale_rate and opacity_rate"
                raise SceneError.expected("a finite number", value, row=self.step, name="loss", advice=advice)
        self.whole = False
        if growing:
            self.density.add_view(rendering, view.camera)
        self._adam_step({name: leaf.grad for name, leaf in leaves.items()})
        self.step = done
        self._densify_and_prune()
        self.whole = True
        return loss.detach(), rendering.color, photograph

    def _loss(
        self,
        cloud: GaussianCloud,
        rendering: Rendering,
        photograph: Float[Tensor, "height width 3"],
        coverage: Float[Tensor, "height width"] | None,
    ) -> Float[Tensor, ""]:
        """Return the absolute difference and 1 - SSIM (3DGS, eq. 7), the mask's error and the mean thickness."""
        config, part = self.config, self.config.dissimilarity_weight
        loss = (1.0 - part) * (rendering.color - photograph).abs().mean()
        if part > 0:
            loss = loss + part * (1.0 - ssim(rendering.color, photograph))
        if coverage is not None and config.mask_weight > 0:
            loss = loss + config.mask_weight * (rendering.alpha - coverage).abs().mean()
        if config.flat_weight > 0:
            # The smallest axis lies across the surface, as soon as the photographs know a surface.
            thickness = cloud.log_scales.amin(1).exp().mean()
            loss = loss + config.flat_weight / self.half_diagonal * thickness
        return loss

    def state(self) -> dict[str, Any]:
        """Return all that decides how the run goes on after its last whole step."""
        return {
            "parameters": self.parameters,
            "moments": {name: list(pair) for name, pair in self.moments.items()},
            "generator": self.generator.get_state(),
            "queue": self.queue,
            "density": dict(vars(self.density)),
            "step": self.step,
        }

    def resume(self, state: dict[str, Any]) -> None:
        """Go on from a `state`."""
        device = self.parameters["centers"].device
        self.parameters = {name: value.to(device) for name, value in state["parameters"].items()}
        self.moments = {name: (one.to(device), two.to(device)) for name, (one, two) in state["moments"].items()}
        self.generator.set_state(state["generator"])
        self.queue, self.step = list(state["queue"]), state["step"]
        self.density = Density(**{name: value.to(device) for name, value in state["density"].items()})

    def _cloud(self, values: dict[str, Tensor], degree: int) -> GaussianCloud:
        above = (degree + 1) ** 2 - 1
        harmonics = torch.cat([values["colors"], values["shades"][:, :above]], dim=1) if above else values["colors"]
        return GaussianCloud(
            values["centers"], values["rotations"], values["log_scales"], values["logit_opacities"], harmonics
        )

    def _next_view(self) -> View:
        """Draw the next view, each once before any comes again, halved as often as it is due at this step."""
        if not self.queue:
            self.queue = torch.randperm(len(self.photographs), generator=self.generator).tolist()
        levels, until, halvings = self.photographs[self.queue.pop()], self.config.coarse_until, self.config.halvings
        if self._fraction() >= until:
            return levels[0]
        return levels[min(halvings, math.ceil(halvings * (1.0 - self._fraction() / until)))]

    def _fraction(self) -> float:
        return self.step / self.config.steps

    def _degree(self) -> int:
        every = self.config.degree_every
        return self.config.degree if every <= 0 else min(self.config.degree, int(self._fraction() / every))

    def _compose(self, view: View) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, " 3"]]:
        """Return a photograph, and the background to render: the one color, or another one, put into both."""
        if self.background is not None:
            return view.color, self.background
        coverage = view.coverage
        assert coverage is not None
        background = torch.rand(3, generator=self.generator).to(coverage, non_blocking=True)
        return torch.lerp(background.expand_as(view.image), view.color, coverage[..., None]), background

    def _rates(self) -> dict[str, float]:
        config, part = self.config, self._fraction()
        fall = config.final_rate**part
        return {
            "centers": config.center_rate * self.half_diagonal * config.final_center_rate**part,
            "rotations": config.rotation_rate * fall,
            "log_scales": config.scale_rate * fall,
            "logit_opacities": config.opacity_rate * fall,
            "colors": config.color_rate * fall,
            "shades": config.shade_rate * fall,
        }

    def _adam_step(self, gradients: dict[str, Tensor | None]) -> None:
        """Take Adam's step (Kingma & Ba 2015); what has no gradient, shades before their degree's time, stays."""
        (by_mean, by_square), count, rates = _BETAS, self.step + 1, self._rates()
        known = {name: gradient for name, gradient in gradients.items() if gradient is not None}
        slopes = list(known.values())
        means, squares = ([self.moments[name][place] for name in known] for place in range(2))
        torch._foreach_lerp_(means, slopes, 1.0 - by_mean)
        torch._foreach_mul_(squares, by_square)
        torch._foreach_addcmul_(squares, slopes, slopes, 1.0 - by_square)
        spreads = torch._foreach_mul(squares, 1.0 / (1.0 - by_square**count))
        torch._foreach_sqrt_(spreads)
        torch._foreach_add_(spreads, _EPSILON)
        steps = [-rates[name] / (1.0 - by_mean**count) for name in known]
        torch._foreach_addcdiv_([self.parameters[name] for name in known], means, spreads, steps)

    def _densify_and_prune(self) -> None:
        """Add and remove Gaussians where that is due."""
        config, step = self.config, self.step
        if step % config.densify_every:
            return
        cloud = self.cloud
        if step > config.densify_until * config.steps:
            rows = torch.nonzero(cloud.opacities >= config.least_opacity)[:, 0]
            if len(rows) < len(cloud):
                self._rebuild(rows, cloud.take(rows[:0]))
        elif step >= config.densify_from * config.steps:
            self._rebuild(*self.density.densify(cloud, config, self.half_diagonal, generator=self.generator))

    def _rebuild(self, rows: Int[Tensor, " kept"], added: GaussianCloud) -> None:
        """Keep the given rows, then add new Gaussians, about which the optimizer knows nothing yet."""
        for name, fresh in _named(added).items():
            blank = torch.zeros_like(fresh)
            self.parameters[name] = torch.cat([self.parameters[name][rows], fresh])
            first, second = self.moments[name]
            self.moments[name] = (torch.cat([first[rows], blank]), torch.cat([second[rows], blank]))
        count = len(self.parameters["centers"])
        if count < 4:
            advice = "check cameras and that the initial points are on the object, or lower least_opacity"
            raise SceneError.expected("at least 4", count, row=self.step, name="gaussians", advice=advice)
        self.density = Density.zeros(self.cloud)


def _named(cloud: GaussianCloud) -> dict[str, Tensor]:
    """Return the parameters with rates of their own; colors are the harmonics of degree 0, shades those above."""
    return {
        "centers": cloud.centers,
        "rotations": cloud.rotations,
        "log_scales": cloud.log_scales,
        "logit_opacities": cloud.logit_opacities,
        "colors": cloud.harmonics[:, :1],
        "shades": cloud.harmonics[:, 1:],
    }


def _on_device(view: View, device: torch.device) -> View:
    return replace(view, image=view.image.to(device), mask=None if view.mask is None else view.mask.to(device))
