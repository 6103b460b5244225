"""The image of Gaussians in plain torch, gradients by autograd: every Gaussian at every pixel, in any precision.

Written from the definitions of 3D Gaussian Splatting (Kerbl et al. 2023); it shares no line with the package's.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.rasterizer.rasterizers import Rendering
from avmsf.photographs.cameras import Camera

_NEAR, _BLUR, _MARGIN = 0.01, 0.3, 0.3
_FAINTEST, _OPAQUE, _LEAST = 1 / 255, 0.999, 1e-4
_CUT = 2e-4
"""How near a cut, relative, rounding may decide on which side a number lies."""


class Splats(NamedTuple):
    """A cloud's Gaussians in one image."""

    screen: Float[Tensor, "points 2"]
    """Pixels."""
    covariances: Float[Tensor, "points 2 2"]
    """Square pixels, blurred."""
    opacities: Float[Tensor, " points"]
    colors: Float[Tensor, "points 3"]
    depths: Float[Tensor, " points"]
    """Along the optical axis, meters."""


def splats(cloud: GaussianCloud, camera: Camera) -> Splats:
    """Return the cloud's Gaussians as the camera sees them; of those behind its near plane the opacity is zero."""
    pose = camera.world_to_camera.to(cloud.centers)
    turn = pose[:3, :3]
    inside = cloud.centers @ turn.T + pose[:3, 3]
    ahead = inside[:, 2] >= _NEAR
    # What lies behind is put where nothing is divided by zero; its opacity keeps it out.
    inside = torch.where(ahead[:, None], inside, inside.new_tensor([0.0, 0.0, 1.0]))
    x, y, z = inside.unbind(1)
    focal, middle = inside.new_tensor(camera.focal), inside.new_tensor(camera.principal)
    screen = torch.stack([x / z, y / z], 1) * focal + middle
    size = inside.new_tensor([camera.width, camera.height])
    margin = _MARGIN * size / (2 * focal)
    tangents = torch.stack([x / z, y / z], 1)
    tangents = torch.minimum(torch.maximum(tangents, -middle / focal - margin), (size - middle) / focal + margin)
    nothing = torch.zeros_like(z)
    jacobian = torch.stack(
        [focal[0] / z, nothing, -focal[0] * tangents[:, 0] / z, nothing, focal[1] / z, -focal[1] * tangents[:, 1] / z],
        1,
    ).reshape(-1, 2, 3)
    stretched = _matrices(cloud.rotations) * cloud.log_scales.exp()[:, None, :]
    flat = jacobian @ turn @ stretched
    covariances = flat @ flat.mT + _BLUR * torch.eye(2).to(flat)
    position = -turn.T @ pose[:3, 3]
    directions = torch.nn.functional.normalize(cloud.centers - position, dim=1)
    basis = _basis(directions)[:, : cloud.harmonics.shape[1]]
    colors = (torch.einsum("pk,pkc->pc", basis, cloud.harmonics) + 0.5).clamp(min=0)
    return Splats(screen, covariances, cloud.opacities * ahead, colors, z)


def render_everywhere(
    cloud: GaussianCloud, camera: Camera, *, background: Float[Tensor, " 3"], rows: range | None = None
) -> tuple[Rendering, Bool[Tensor, "height width"]]:
    """Return what the camera sees, or some rows of it, and at which pixels rounding could decide what counts.

    There some Gaussian covers 1/255, or would leave 1e-4, within one part in 5,000: float32 may take either side of the
    cut, and no tolerance on the image has a meaning. Memory grows with points times pixels: of a large image ask for a
    few rows at a time. Gaussians four standard deviations from all of them are left out, for they cover less than
    exp(-8), a twelfth of 1/255.
    """
    rows = range(camera.height) if rows is None else rows
    every = splats(cloud, camera)
    spread = 4 * every.covariances[:, 1, 1].sqrt()
    near = (every.screen[:, 1] + spread > rows.start) & (every.screen[:, 1] - spread < rows.stop)
    order = torch.argsort(every.depths, stable=True)
    seen = Splats(*(each[order][near[order]] for each in every))
    down, across = torch.meshgrid(torch.tensor(rows), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack([across.flatten(), down.flatten()], 1).to(every.screen) + 0.5
    covered = _coverage(seen, pixels)
    near_cut = (covered * 255 - 1).abs() < _CUT
    covered = torch.where(covered >= _FAINTEST, covered, 0.0)
    # A row of ones before the first Gaussian, so that an empty cloud is like any other.
    left = torch.cumprod(torch.cat([torch.ones_like(pixels[None, :, 0]), 1 - covered]), 0)
    goes_on = left > _LEAST
    weights = covered * left[:-1] * goes_on[1:]
    undecided = (near_cut & goes_on[:-1]).any(0) | ((left / _LEAST - 1).abs() < _CUT).any(0)
    alpha = 1 - torch.where(goes_on, left, 1.0).amin(0)
    color = weights.T @ seen.colors + (1 - alpha)[:, None] * background.to(pixels)
    depth = torch.where(alpha > 0, weights.T @ seen.depths / alpha.clamp(min=1e-10), 0.0)
    shape = len(rows), camera.width
    color, alpha, depth = color.reshape(*shape, 3), alpha.reshape(shape), depth.reshape(shape)
    return Rendering(color, alpha, depth, every.screen, torch.zeros_like(every.depths)), undecided.reshape(shape)


def _coverage(seen: Splats, pixels: Float[Tensor, "pixels 2"]) -> Float[Tensor, "points pixels"]:
    offsets = pixels[None] - seen.screen[:, None]
    squared = torch.einsum("npi,nij,npj->np", offsets, torch.linalg.inv(seen.covariances), offsets)
    return (seen.opacities[:, None] * torch.exp(-squared / 2)).clamp(max=_OPAQUE)


def _matrices(rotations: Float[Tensor, "points 4"]) -> Float[Tensor, "points 3 3"]:
    """Return I + 2 w [v] + 2 [v]^2 of unit quaternions (w, v), [v] the matrix of the cross product with v."""
    unit = torch.nn.functional.normalize(rotations, dim=1)
    w, (x, y, z) = unit[:, 0], unit[:, 1:].unbind(1)
    nothing = torch.zeros_like(x)
    cross = torch.stack([nothing, -z, y, z, nothing, -x, -y, x, nothing], 1).reshape(-1, 3, 3)
    return torch.eye(3).to(unit) + 2 * w[:, None, None] * cross + 2 * cross @ cross


def _basis(directions: Float[Tensor, "points 3"]) -> Float[Tensor, "points 16"]:
    """Return the real spherical harmonics to degree 3, from their normalized Legendre form."""
    x, y, z = directions.unbind(1)
    one, root = torch.ones_like(x), math.sqrt(1 / math.pi)
    return torch.stack(
        [
            root / 2 * one,
            -math.sqrt(3) / 2 * root * y,
            math.sqrt(3) / 2 * root * z,
            -math.sqrt(3) / 2 * root * x,
            math.sqrt(15) / 2 * root * x * y,
            -math.sqrt(15) / 2 * root * y * z,
            math.sqrt(5) / 4 * root * (3 * z * z - 1),
            -math.sqrt(15) / 2 * root * x * z,
            math.sqrt(15) / 4 * root * (x * x - y * y),
            -math.sqrt(35 / 2) / 4 * root * y * (3 * x * x - y * y),
            math.sqrt(105) / 2 * root * x * y * z,
            -math.sqrt(21 / 2) / 4 * root * y * (5 * z * z - 1),
            math.sqrt(7) / 4 * root * z * (5 * z * z - 3),
            -math.sqrt(21 / 2) / 4 * root * x * (5 * z * z - 1),
            math.sqrt(105) / 4 * root * z * (x * x - y * y),
            -math.sqrt(35 / 2) / 4 * root * x * (x * x - 3 * y * y),
        ],
        1,
    )
