"""One run of fitting Gaussians to photographs: parameters, optimizer, schedules and what one step does."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.device import steps_between_losses
from avmsf.errors import SceneError
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.densify import Density
from avmsf.gaussians.rasterizer.protocol import Rasterizer, Rendering
from avmsf.gaussians.ssim import ssim
from avmsf.gaussians.targets import Backdrop, Photograph

GROUPS = ("centers", "rotations", "log_scales", "logit_opacities", "colors", "shades")
"""Parameters with a rate of their own; colors are the harmonics of degree 0, shades those above."""
_BETAS, _EPSILON = (0.9, 0.999), 1e-15
"""Adam's, as in 3DGS."""


@dataclass(frozen=True, eq=False)
class Target:
    """What one rendering is compared with."""

    image: Float[Tensor, "height width 3"]
    coverage: Float[Tensor, "height width"] | None
    background: Float[Tensor, " 3"]


class SplatRun:
    """Gaussians on their way."""

    def __init__(
        self,
        cloud: GaussianCloud,
        photographs: Sequence[Photograph],
        backdrop: Backdrop,
        config: SplatConfig,
        *,
        rasterizer: Rasterizer,
    ) -> None:
        device = cloud.centers.device
        self.photographs = [each.to(device) for each in photographs]
        self.background = None if backdrop.color is None else backdrop.color.to(device)
        self.config, self.rasterizer, self.losses_every = config, rasterizer, steps_between_losses(device)
        spread = cloud.centers.amax(0) - cloud.centers.amin(0)
        self.half_diagonal = 0.5 * float(spread.norm())
        self.parameters = {name: value.clone() for name, value in _named(cloud).items()}
        self.moments = {
            name: (torch.zeros_like(value), torch.zeros_like(value)) for name, value in self.parameters.items()
        }
        self.generator = torch.Generator().manual_seed(config.seed)
        self.queue: list[int] = []
        self.density = Density.none(cloud)
        self.step = 0
        self.whole = True

    @property
    def cloud(self) -> GaussianCloud:
        """The Gaussians as they are now; they change with the next step."""
        return self._cloud(self.parameters, self.config.degree)

    def advance(self) -> tuple[Float[Tensor, ""], Rendering, Target]:
        """Take one step; return the loss before it, and what was compared.

        Raises `SceneError` where the loss is no finite number, on a graphics card some steps later.
        """
        photograph, level = self.photographs[self._next()], self._level()
        target = self._target(photograph, level)
        leaves = {name: value.detach().requires_grad_() for name, value in self.parameters.items()}
        cloud = self._cloud(leaves, self._degree())
        rendering = self.rasterizer(cloud, photograph.cameras[level], background=target.background)
        growing = self.step < self.config.densify_until * self.config.steps
        if growing:
            rendering.screen.retain_grad()
        loss = self.loss(rendering, target)
        if self.config.flat_weight > 0:
            # The smallest axis lies across the surface, as soon as the photographs know a surface.
            thickness = cloud.log_scales.amin(1).exp().mean()
            loss = loss + self.config.flat_weight / self.half_diagonal * thickness
        loss.backward()  # type: ignore[no-untyped-call]
        # Before densification too, to which there would seem to be no Gaussians.
        done = self.step + 1
        if done == self.config.steps or not done % self.losses_every or not done % self.config.densify_every:
            self._expect_finite(float(loss.detach()))
        self.whole = False
        if growing:
            self.density.note(rendering, photograph.cameras[level])
        self._descend({name: leaf.grad for name, leaf in leaves.items()})
        self.step += 1
        self._change_number()
        self.whole = True
        return loss.detach(), rendering, target

    def _expect_finite(self, loss: float) -> None:
        if not math.isfinite(loss):
            raise SceneError(
                f"expected a finite loss, got {loss} at step {self.step}; lower center_rate, scale_rate and "
                "opacity_rate",
                row=self.step,
                name="loss",
                value=loss,
            )

    def loss(self, rendering: Rendering, target: Target) -> Float[Tensor, ""]:
        """Return the mixture of absolute difference, 1 - SSIM and the mask's error (3DGS, eq. 7, and the mask's)."""
        part = self.config.dissimilarity_weight
        loss = (1.0 - part) * (rendering.color - target.image).abs().mean()
        if part > 0:
            loss = loss + part * (1.0 - ssim(rendering.color, target.image))
        if target.coverage is not None and self.config.mask_weight > 0:
            loss = loss + self.config.mask_weight * (rendering.alpha - target.coverage).abs().mean()
        return loss

    def state(self) -> dict[str, Any]:
        """Return all that decides how the run goes on after its last whole step."""
        return {
            "parameters": self.parameters,
            "moments": {name: list(pair) for name, pair in self.moments.items()},
            "generator": self.generator.get_state(),
            "queue": self.queue,
            "density": self.density.state(),
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

    def _next(self) -> int:
        """Draw the next view, each once before any comes again."""
        if not self.queue:
            self.queue = torch.randperm(len(self.photographs), generator=self.generator).tolist()
        return self.queue.pop()

    def _part(self) -> float:
        return self.step / self.config.steps

    def _level(self) -> int:
        """Return how often the images are halved now."""
        if self._part() >= self.config.coarse_until:
            return 0
        spans = math.ceil(self.config.halvings * (1.0 - self._part() / self.config.coarse_until))
        return min(self.config.halvings, spans)

    def _degree(self) -> int:
        every = self.config.degree_every
        return self.config.degree if every <= 0 else min(self.config.degree, int(self._part() / every))

    def _target(self, photograph: Photograph, level: int) -> Target:
        mask = photograph.masks[level]
        image = photograph.images[level].float() / 255
        coverage = None if mask is None else mask.float() / 255
        if self.background is not None:
            return Target(image, coverage, self.background)
        assert coverage is not None
        background = torch.rand(3, generator=self.generator).to(image, non_blocking=True)
        return Target(torch.lerp(background.expand_as(image), image, coverage[..., None]), coverage, background)

    def _rates(self) -> dict[str, float]:
        config, part = self.config, self._part()
        fall = config.final_rate**part
        return {
            "centers": config.center_rate * self.half_diagonal * config.final_center_rate**part,
            "rotations": config.rotation_rate * fall,
            "log_scales": config.scale_rate * fall,
            "logit_opacities": config.opacity_rate * fall,
            "colors": config.color_rate * fall,
            "shades": config.shade_rate * fall,
        }

    def _descend(self, gradients: dict[str, Tensor | None]) -> None:
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

    def _change_number(self) -> None:
        """Add and remove Gaussians where that is due."""
        config, step = self.config, self.step
        first, last = config.densify_from * config.steps, config.densify_until * config.steps
        if first <= step <= last and step % config.densify_every == 0:
            rows, fresh = self.density.grown(self.cloud, config, self.half_diagonal, generator=self.generator)
            self._rebuild(rows, fresh)
            if config.reset_every and step % config.reset_every == 0 and step < last:
                self._reset_opacities()
        elif step > last and step % config.densify_every == 0:
            faint = self.cloud.opacities < config.least_opacity
            if bool(faint.any()):
                self._rebuild(torch.nonzero(~faint)[:, 0], None)

    def _rebuild(self, rows: Tensor, fresh: GaussianCloud | None) -> None:
        """Keep the given rows, then add new Gaussians, about which the optimizer knows nothing yet."""
        added = {} if fresh is None else _named(fresh)
        for name in GROUPS:
            more = added.get(name, self.parameters[name][:0])
            self.parameters[name] = torch.cat([self.parameters[name][rows], more])
            first, second = self.moments[name]
            blank = torch.zeros_like(more)
            self.moments[name] = (torch.cat([first[rows], blank]), torch.cat([second[rows], blank]))
        count = len(self.parameters["centers"])
        if count < 4:
            raise SceneError(
                f"expected at least 4 Gaussians, got {count} at step {self.step}; check the cameras and that the "
                "initial points are on the object, or lower least_opacity",
                row=self.step,
                name="gaussians",
                value=count,
            )
        self.density = Density.none(self.cloud)

    def _reset_opacities(self) -> None:
        highest = 2.0 * self.config.least_opacity
        self.parameters["logit_opacities"].clamp_(max=math.log(highest / (1.0 - highest)))
        for moment in self.moments["logit_opacities"]:
            moment.zero_()


def _named(cloud: GaussianCloud) -> dict[str, Tensor]:
    return {
        "centers": cloud.centers,
        "rotations": cloud.rotations,
        "log_scales": cloud.log_scales,
        "logit_opacities": cloud.logit_opacities,
        "colors": cloud.harmonics[:, :1],
        "shades": cloud.harmonics[:, 1:],
    }
