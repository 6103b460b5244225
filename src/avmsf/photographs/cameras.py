"""Pinhole cameras, and views: images with the cameras that took them. OpenCV's axes, world to camera."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from avmsf._utils.arrays import short_repr
from avmsf.errors import CaptureError

MIN_VIEWS = 3
"""Views of an object below which nothing is made of them: two bound a shape on two sides alone."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion: x to the right, y down, z forward.

    A pixel's center lies half a pixel from its edges, so that the image spans (0, 0) to (width, height).
    """

    world_to_camera: Float[Tensor, "4 4"]
    """Rigid transform of the object frame, meters, into the camera's; float64."""
    focal: tuple[float, float]
    """Focal lengths along x and y, pixels."""
    principal: tuple[float, float]
    """Where the optical axis meets the image, pixels."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""

    def __post_init__(self) -> None:
        numbers = [*self.focal, *self.principal, *self.world_to_camera.flatten().tolist()]
        if not all(map(math.isfinite, numbers)) or min(self.focal) <= 0 or min(self.width, self.height) < 1:
            wanted = "finite numbers, positive focal lengths and a size in pixels"
            got = f"focal lengths {self.focal}, principal point {self.principal}, size {self.width} x {self.height}"
            values, advice = [*numbers[:4], self.width, self.height], "check the file that holds the cameras"
            raise CaptureError.expected(wanted, values, got=got, name="camera", advice=advice)

    @classmethod
    def looking(
        cls,
        position: Float[Tensor, " 3"],
        target: Float[Tensor, " 3"],
        *,
        up: Float[Tensor, " 3"],
        focal: float,
        width: int,
        height: int,
    ) -> "Camera":
        """Return a camera at `position` that sees `target` in the middle of its image, with `up` upwards in it.

        Raises CaptureError where position and target are equal, or `up` is parallel to the viewing direction.
        """
        position, target, up = position.double(), target.double(), up.double()
        forward = target - position
        right = torch.linalg.cross(forward, up)
        if float(right.norm()) < 1e-9 * max(float(forward.norm()) * float(up.norm()), 1e-300):
            wanted = f"an up direction across the line of sight {forward.tolist()}"
            advice = "choose another up, or another target than the camera's position"
            raise CaptureError.expected(wanted, up.tolist(), name="up", advice=advice)
        forward, right = forward / forward.norm(), right / right.norm()
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position
        return cls(pose, (focal, focal), (width / 2, height / 2), width, height)

    @cached_property
    def position(self) -> Float[Tensor, " 3"]:
        """The camera's position in the object frame, meters."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    @cached_property
    def intrinsics(self) -> Float[Tensor, "3 3"]:
        """The matrix that takes the camera's frame to homogeneous pixels."""
        return torch.tensor(
            [[self.focal[0], 0.0, self.principal[0]], [0.0, self.focal[1], self.principal[1]], [0.0, 0.0, 1.0]],
            dtype=torch.float64,
        )

    @cached_property
    def projection(self) -> Float[Tensor, "3 4"]:
        """The matrix that takes homogeneous positions in the object frame to homogeneous pixels times their depth."""
        return self.intrinsics @ self.world_to_camera[:3]

    def project(self, points: Float[Tensor, "points 3"]) -> tuple[Float[Tensor, "points 2"], Float[Tensor, " points"]]:
        """Return the points' positions in the image, pixels, and their depths along the optical axis, meters; float64.

        A point at or behind the camera has no position: its pixels are NaN.
        """
        inside = points.double() @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        depth = inside[:, 2]
        ahead = torch.where(depth > 0, depth, torch.nan)
        scale = inside.new_tensor(self.focal)
        return inside[:, :2] / ahead[:, None] * scale + inside.new_tensor(self.principal), depth

    def contains(self, pixels: Float[Tensor, "points 2"]) -> Bool[Tensor, " points"]:
        """Return which positions in the image, as `project` gives them, lie within its edges; NaN does not."""
        return ((pixels >= 0) & (pixels < pixels.new_tensor([self.width, self.height]))).all(dim=1)

    def rays(self) -> Float[Tensor, "height width 3"]:
        """Return the unit viewing direction of each pixel's center in the object frame; float64."""
        across = (torch.arange(self.width, dtype=torch.float64) + 0.5 - self.principal[0]) / self.focal[0]
        down = (torch.arange(self.height, dtype=torch.float64) + 0.5 - self.principal[1]) / self.focal[1]
        directions = torch.ones(self.height, self.width, 3, dtype=torch.float64)
        directions[..., 0], directions[..., 1] = across[None, :], down[:, None]
        directions = directions @ self.world_to_camera[:3, :3]
        return directions / directions.norm(dim=-1, keepdim=True)

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera of the same image with another number of pixels."""
        across, down = width / self.width, height / self.height
        return replace(
            self,
            focal=(self.focal[0] * across, self.focal[1] * down),
            principal=(self.principal[0] * across, self.principal[1] * down),
            width=width,
            height=height,
        )


@dataclass(frozen=True, eq=False)
class View:
    """One photograph with the camera that took it."""

    __repr__ = short_repr

    name: str
    """The file's name, or another by which a message can speak of it."""
    image: UInt8[Tensor, "height width 3"]
    """Red, green, blue as displayed (sRGB)."""
    camera: Camera
    mask: UInt8[Tensor, "height width"] | None = None
    """How much of each pixel the object covers, 255 for all of it; None if unknown."""

    def __post_init__(self) -> None:
        width, height = self.camera.width, self.camera.height
        for kind, pixels in (("an image", self.image), ("a mask", self.mask)):
            if pixels is not None and pixels.shape[:2] != (height, width):
                found, wanted = list(pixels.shape[:2]), f"{kind} of the camera's {width} x {height} pixels"
                got, advice = f"{found[1]} x {found[0]}", "give the camera of this image"
                raise CaptureError.expected(wanted, found, got=got, name=self.name, advice=advice)

    @property
    def color(self) -> Float[Tensor, "height width 3"]:
        """The image as numbers from 0 to 1, float32."""
        return self.image.float() / 255

    @property
    def foreground(self) -> Bool[np.ndarray, "height width"]:
        """Which pixels the object is known to cover by more than half: none where there is no mask."""
        return np.zeros(self.image.shape[:2], dtype=bool) if self.mask is None else self.mask.numpy() > 127

    @property
    def coverage(self) -> Float[Tensor, "height width"] | None:
        """The mask as numbers from 0 to 1, float32."""
        return None if self.mask is None else self.mask.float() / 255
