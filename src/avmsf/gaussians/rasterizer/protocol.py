"""What turns Gaussians into images: one interface, whoever computes behind it."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from avmsf.gaussians.cloud import GaussianCloud
from avmsf.photographs.cameras import Camera


@dataclass(frozen=True, eq=False)
class Rendering:
    """What a camera sees of a cloud; differentiable by the cloud's tensors."""

    color: Float[Tensor, "height width 3"]
    """The blended colors over the background, about 0 to 1."""
    alpha: Float[Tensor, "height width"]
    """How much of each pixel the Gaussians cover, 0 to 1."""
    depth: Float[Tensor, "height width"]
    """Mean depth of what covers the pixel, meters along the optical axis; 0 where nothing does."""
    screen: Float[Tensor, "points 2"]
    """The centers' places in the image, pixels. After `retain_grad`, the backward pass leaves the loss's derivative by
    them in `grad`, for densification."""
    radii: Float[Tensor, " points"]
    """Reach of each Gaussian in the image, pixels; 0 for those that the camera does not see."""


@runtime_checkable
class Rasterizer(Protocol):
    """Anything that renders clouds as `Rendering` says: Gaussians sorted by depth, blended front to back (3DGS).

    `choose_rasterizer` gives the one for a device. Derivatives are those by the cloud's tensors; camera and background
    have none.
    """

    def __call__(self, cloud: GaussianCloud, camera: Camera, *, background: Float[Tensor, " 3"]) -> Rendering:
        """Return what `camera` sees before a `background` color."""
        ...
