"""What turns Gaussians into images: one interface, whoever computes behind it."""

from dataclasses import dataclass
from typing import Protocol

from jaxtyping import Float
from torch import Tensor

from avmsf.capture.cameras import Camera
from avmsf.scene.gaussians import GaussianCloud


@dataclass(frozen=True, eq=False)
class Rendering:
    """What a camera sees of a cloud; differentiable by the cloud's tensors."""

    color: Float[Tensor, "height width 3"]
    """The blended colours over the background, about 0 to 1."""
    alpha: Float[Tensor, "height width"]
    """How much of each pixel the Gaussians cover, 0 to 1."""
    depth: Float[Tensor, "height width"]
    """Mean depth of what covers the pixel, metres along the optical axis; 0 where nothing does."""
    screen: Float[Tensor, "points 2"]
    """The centers' places in the image, pixels. No leaf: `retain_grad` keeps its gradient for densification."""
    radii: Float[Tensor, " points"]
    """Reach of each Gaussian in the image, pixels; 0 for those that the camera does not see."""


class Rasteriser(Protocol):
    """Anything that renders clouds as `Rendering` says, tiles of Gaussians sorted by depth, front to back (3DGS)."""

    def __call__(self, cloud: GaussianCloud, camera: Camera, *, background: Float[Tensor, " 3"]) -> Rendering:
        """Return what `camera` sees before a `background` colour."""
        ...
