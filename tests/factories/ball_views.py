"""Photographs of a ball, ray by ray in closed form: a scene whose surface and colors are known everywhere."""

import math

import torch
from torch import Tensor

from avmsf.photographs.cameras import Camera, View

RADIUS = 0.05
"""Meters."""
MIDDLE = (0.01, -0.02, 0.03)
"""Off the origin, so that nothing works by being there."""


def ball_color(normals: Tensor) -> Tensor:
    """Return smooth colors, from .2 to .8, of points with these unit normals."""
    return 0.5 + 0.3 * torch.sin(normals * torch.tensor([4.0, 5.0, 6.0], dtype=normals.dtype) + 1.0)


def ball_normals(count: int) -> Tensor:
    """Return random directions, evenly over all; points of the ball lie at `MIDDLE + RADIUS` times these."""
    normals = torch.randn(count, 3, generator=torch.Generator().manual_seed(1))
    return torch.nn.functional.normalize(normals, dim=1)


def ball_cameras(count: int, *, size: int = 64, aim: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> list[Camera]:
    """Return cameras on a spiral around the ball, .3 m away, whose image it fills by two thirds."""
    middle, cameras = torch.tensor(MIDDLE, dtype=torch.float64), []
    for place in range(count):
        height = 0.9 * (2.0 * (place + 0.5) / count - 1.0)
        turn = place * math.pi * (3.0 - math.sqrt(5.0))
        flat = math.sqrt(1.0 - height * height)
        towards = torch.tensor([flat * math.cos(turn), flat * math.sin(turn), height], dtype=torch.float64)
        target = middle + torch.tensor(aim, dtype=torch.float64)
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        cameras.append(Camera.looking(middle + 0.3 * towards, target, up=up, focal=2.0 * size, width=size, height=size))
    return cameras


def ball_view(camera: Camera, *, name: str = "ball", background: float = 0.0, masked: bool = True) -> View:
    """Return what a camera sees of the ball before a gray background; 3 x 3 rays a pixel, so that the rim is soft."""
    fine = camera.resized(3 * camera.width, 3 * camera.height)
    rays, middle = fine.rays(), torch.tensor(MIDDLE, dtype=torch.float64)
    offset = camera.position - middle
    along = (rays * offset).sum(-1)
    inside = along.square() - offset.square().sum() + RADIUS**2
    hit = inside > 0
    distance = -along - torch.sqrt(inside.clamp(min=0))
    normals = (offset + distance[..., None] * rays) / RADIUS
    color = torch.where(hit[..., None], ball_color(normals), background)
    pooled = color.reshape(camera.height, 3, camera.width, 3, 3).mean((1, 3))
    covered = hit.double().reshape(camera.height, 3, camera.width, 3).mean((1, 3))
    mask = (covered * 255).round().to(torch.uint8) if masked else None
    return View(name, (pooled * 255).round().to(torch.uint8), camera, mask)


def ball_views(count: int, *, size: int = 64, background: float = 0.0, masked: bool = True) -> list[View]:
    """Return the ball from `count` cameras."""
    return [
        ball_view(camera, name=f"{place:02d}.png", background=background, masked=masked)
        for place, camera in enumerate(ball_cameras(count, size=size))
    ]
