"""How Gaussians are fitted to views: one flat record, which is the command line's options too."""

import math
from dataclasses import dataclass
from typing import Literal

from avmsf.errors import SceneError

_LEAST = {
    "steps": 1,
    "start_points": 100,
    "gaussians": 100,
    "halvings": 0,
    "densify_every": 1,
    "reset_every": 0,
    "dissimilarity_weight": 0,
    "mask_weight": 0,
    "flat_weight": 0,
    "growth": 0,
    "large": 0,
    "seed": 0,
}
_RATES = (
    "center_rate",
    "rotation_rate",
    "scale_rate",
    "opacity_rate",
    "color_rate",
    "shade_rate",
    "final_center_rate",
    "final_rate",
    "start_scale",
    "start_flatness",
)
_PARTS = ("coarse_until", "degree_every", "densify_from", "densify_until", "least_opacity", "dissent")


@dataclass(frozen=True)
class SplatConfig:
    """Settings of a splatting. The defaults are what a short run on a processor does best with."""

    steps: int = 2000
    """Steps of the optimizer, one view each; all schedules stretch with them."""
    degree: Literal[0, 1, 2, 3] = 2
    """Degree of the spherical harmonics: how a color depends on the direction of view."""
    start_points: int = 15_000
    """Points on the visual hull that the Gaussians start at."""
    start_scale: float = 1.0
    """First standard deviation of a Gaussian, in mean distances to its three nearest neighbors."""
    start_opacity: float = 0.5
    """First opacity."""
    gaussians: int = 30_000
    """Gaussians at most."""
    dissimilarity_weight: float = 0.2
    """Part of the loss on the image that is 1 - SSIM; the rest is the absolute difference (3DGS: .2)."""
    mask_weight: float = 0.1
    """Weight of the absolute difference between coverage and mask, where masks are known."""
    flat_weight: float = 0.1
    """Weight of the Gaussians' mean thickness, their smallest scale, in half diagonals: thick ones sink below the
    surface, for none may stand out from the object's outline."""
    start_flatness: float = 0.3
    """First thickness of a Gaussian whose normal is known, in parts of its width."""
    background: tuple[float, float, float] | Literal["found", "random"] = "found"
    """Red, green, blue behind the object, 0 to 1. `random` puts the masked object before another color every step;
    `found` takes the color around the masks where it is plain, and `random` where it is not."""
    halvings: int = 2
    """How often the first images are halved."""
    coarse_until: float = 0.5
    """Part of the steps by which the images have come to full size, in equal spans."""
    degree_every: float = 0.1
    """Part of the steps after which the harmonics gain a degree."""
    center_rate: float = 6e-3
    """Adam's step of the centers at the start, in half diagonals of the object's bounding box."""
    final_center_rate: float = 0.02
    """Part of it that is left at the end; it falls exponentially."""
    rotation_rate: float = 5e-3
    """Adam's step of the quaternions."""
    scale_rate: float = 2e-2
    """Adam's step of the logarithms of the scales."""
    opacity_rate: float = 0.1
    """Adam's step of the opacities' logits."""
    color_rate: float = 1e-2
    """Adam's step of the harmonics of degree 0."""
    shade_rate: float = 1e-3
    """Adam's step of the harmonics above."""
    final_rate: float = 0.5
    """Part of these steps that is left at the end; they fall exponentially."""
    densify_from: float = 0.05
    """Part of the steps after which Gaussians are first added and removed."""
    densify_until: float = 0.7
    """Part of the steps after which no more are added."""
    densify_every: int = 100
    """Steps between additions."""
    growth: float = 2e-4
    """Mean slope of the loss by a Gaussian's place in the image, in half images, above which it is doubled."""
    large: float = 0.01
    """Largest scale, in half diagonals, up to which a doubled Gaussian is copied; above, it is split."""
    least_opacity: float = 0.1
    """Opacity below which a Gaussian is removed."""
    reset_every: int = 0
    """Steps between resets of all opacities to twice the least; 0 never resets them."""
    dissent: float = 0.05
    """Part of the views that may say otherwise about what belongs to the object: wrong masks."""
    seed: int = 0
    """Start of all chance: the order of the views, backgrounds and splits."""

    def __post_init__(self) -> None:
        for name, least in _LEAST.items():
            value = getattr(self, name)
            if not least <= value < math.inf:
                raise SceneError(f"{name} = {value}: expected {least} or more")
        for name in _RATES:
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise SceneError(f"{name} = {value}: expected more than 0")
        for name in _PARTS:
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise SceneError(f"{name} = {value}: expected 0 to 1")
        if self.degree not in (0, 1, 2, 3):
            raise SceneError(f"degree = {self.degree}: expected 0, 1, 2 or 3")
        if self.seed >= 2**63:
            raise SceneError(f"seed = {self.seed}: expected less than 2^63")
        if not 0 < self.start_opacity < 1:
            raise SceneError(f"start_opacity = {self.start_opacity}: expected more than 0 and less than 1")
        if isinstance(self.background, str):
            if self.background not in ("found", "random"):
                raise SceneError(f"background = {self.background!r}: expected found, random or three numbers")
        elif not all(0 <= value <= 1 for value in self.background):
            raise SceneError(f"background = {self.background}: expected red, green and blue from 0 to 1")
