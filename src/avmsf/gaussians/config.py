"""Settings of the fit of Gaussians to views: one flat record, which is also the command line's options."""

import math
from dataclasses import dataclass, field, fields
from typing import Literal

from avmsf.errors import SceneError

_MINIMA = {"steps": 1, "start_points": 100, "gaussians": 100, "densify_every": 1} | dict.fromkeys(
    ("halvings", "growth", "large", "seed", "dissimilarity_weight", "mask_weight", "flat_weight"), 0
)
_POSITIVE = ("start_scale", "start_flatness")
"""Settings above zero, as all learning rates are."""
_FRACTIONS = ("coarse_until", "degree_every", "densify_from", "densify_until", "least_opacity", "wrong_masks")


@dataclass(frozen=True)
class SplatConfig:
    """Settings of the fit of Gaussians to views. The defaults suit a short run on a CPU."""

    steps: int = 2000
    """Optimizer steps, one view each; all schedules scale with them."""
    degree: Literal[0, 1, 2, 3] = 2
    """Degree of the spherical harmonics, by which a color depends on the viewing direction."""
    start_points: int = 15_000
    """Points on the visual hull at which Gaussians are initialized."""
    start_scale: float = 1.0
    """Initial standard deviation of a Gaussian, in mean distances to its three nearest neighbors."""
    start_opacity: float = 0.5
    """Initial opacity."""
    gaussians: int = 30_000
    """Maximum number of Gaussians."""
    dissimilarity_weight: float = 0.2
    """Weight of 1 - SSIM in the loss on the image; the rest is the absolute difference (3DGS: .2)."""
    mask_weight: float = 0.1
    """Weight of the absolute difference between coverage and mask, where masks are known."""
    flat_weight: float = 0.1
    """Weight of the Gaussians' mean thickness, their smallest scale, in half diagonals of the object. Without it, thick
    Gaussians lie below the surface, since none may extend beyond the object's outline."""
    start_flatness: float = 0.3
    """Initial thickness of a Gaussian whose normal is known, relative to its width."""
    background: tuple[float, float, float] | Literal["found", "random"] = field(
        default="found", metadata={"metavar": "R G B|found|random"}
    )
    """Red, green, blue behind the object, 0 to 1. `random` uses another color behind the masked object every step;
    `found` uses the color around the masks if it is plain, else `random`."""
    halvings: int = 2
    """How often the images are halved in size at the start."""
    coarse_until: float = 0.5
    """Fraction of the steps after which the images have full size."""
    degree_every: float = 0.1
    """Fraction of the steps after which the degree of the harmonics increases by one."""
    center_rate: float = 6e-3
    """Initial learning rate of the centers, in half diagonals of the object's bounding box."""
    final_center_rate: float = 0.02
    """Final learning rate of the centers relative to the initial one; it decays exponentially."""
    rotation_rate: float = 5e-3
    """Learning rate of the quaternions."""
    scale_rate: float = 2e-2
    """Learning rate of the logarithms of the scales."""
    opacity_rate: float = 0.1
    """Learning rate of the opacities' logits."""
    color_rate: float = 1e-2
    """Learning rate of the harmonics of degree 0."""
    shade_rate: float = 1e-3
    """Learning rate of the harmonics of higher degrees."""
    final_rate: float = 0.5
    """Final value of these learning rates relative to the initial one; they decay exponentially."""
    densify_from: float = 0.05
    """Fraction of the steps after which Gaussians are first added and removed."""
    densify_until: float = 0.7
    """Fraction of the steps after which no more are added."""
    densify_every: int = 100
    """Steps between additions."""
    growth: float = 2e-4
    """Mean gradient of the loss by a Gaussian's position in the image, in half images, above which it is doubled."""
    large: float = 0.01
    """Largest scale, in half diagonals, up to which a doubled Gaussian is copied; above, it is split."""
    least_opacity: float = 0.1
    """Opacity below which a Gaussian is removed."""
    wrong_masks: float = 0.05
    """Fraction of the views whose masks may be wrong."""
    seed: int = 0
    """Seed of the order of the views, backgrounds and splits."""

    def __post_init__(self) -> None:
        for name in (each.name for each in fields(self)):
            value = getattr(self, name)
            if name in _MINIMA and not _MINIMA[name] <= value < math.inf:
                raise SceneError.expected(f"{_MINIMA[name]} or more", value, name=name)
            if (name in _POSITIVE or name.endswith("_rate")) and not 0 < value < math.inf:
                raise SceneError.expected("more than 0", value, name=name)
            if name in _FRACTIONS and not 0 <= value <= 1:
                raise SceneError.expected("0 to 1", value, name=name)
        if self.degree not in (0, 1, 2, 3):
            raise SceneError.expected("0, 1, 2 or 3", self.degree, name="degree")
        if self.seed >= 2**63:
            raise SceneError.expected("less than 2^63", self.seed, name="seed")
        if not 0 < self.start_opacity < 1:
            raise SceneError.expected("more than 0 and less than 1", self.start_opacity, name="start_opacity")
        if isinstance(self.background, str):
            if self.background not in ("found", "random"):
                raise SceneError.expected("found, random or three numbers", self.background, name="background")
        elif len(self.background) != 3 or not all(0 <= value <= 1 for value in self.background):
            raise SceneError.expected("red, green and blue from 0 to 1", self.background, name="background")
