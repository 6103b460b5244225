"""The rasterizer for graphics cards: gsplat's kernels (extra `gpu`)."""

import importlib
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.errors import SceneError
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.rasterizer.ellipses import NEAR
from avmsf.gaussians.rasterizer.protocol import Rendering
from avmsf.photographs.cameras import Camera


class GsplatRasterizer:
    """Renders clouds where they lie, on a CUDA device, by gsplat."""

    def __init__(self) -> None:
        """Raise SceneError where gsplat cannot be imported."""
        try:
            self._gsplat: Any = importlib.import_module("gsplat")
        except ImportError as error:
            advice = "pip install 'avmsf[gpu]', or render on the CPU"
            got = f"an import error ({error})"
            raise SceneError.expected("the package gsplat", got=got, name="gsplat", advice=advice) from error

    def __call__(self, cloud: GaussianCloud, camera: Camera, *, background: Float[Tensor, " 3"]) -> Rendering:
        """Return what `camera` sees before a `background` color.

        Raises SceneError for a cloud or background that is not on a CUDA device.
        """
        centers = cloud.centers
        for name, tensor in (("cloud", centers), ("background", background)):
            if not _lies_on_card(tensor):
                advice = "move it, or use the rasterizer of `choose_rasterizer` for that device"
                raise SceneError.expected("a CUDA device", str(tensor.device), name=name, advice=advice)
        painted, covered, found = self._gsplat.rasterization(
            means=centers,
            quats=cloud.rotations,
            scales=torch.exp(cloud.log_scales),
            opacities=cloud.opacities,
            colors=cloud.harmonics,
            viewmats=camera.world_to_camera.to(centers, non_blocking=True)[None],
            Ks=camera.intrinsics.to(centers, non_blocking=True)[None],
            width=camera.width,
            height=camera.height,
            near_plane=NEAR,
            sh_degree=cloud.degree,
            packed=False,
            backgrounds=background[None],
            render_mode="RGB+ED",
        )
        radii = found["radii"][0]
        return Rendering(
            color=painted[0, ..., :3],
            alpha=covered[0, ..., 0],
            depth=painted[0, ..., 3],
            screen=_tapped(found["means2d"]),
            # One for each axis of the image since gsplat 1.5.
            radii=(radii.amax(-1) if radii.ndim == 2 else radii).to(centers.dtype),
        )


def _lies_on_card(tensor: Tensor) -> bool:
    return tensor.device.type == "cuda"


def _tapped(places: Float[Tensor, "cameras points 2"]) -> Float[Tensor, "points 2"]:
    """Return the one camera's places as a tensor whose `grad` is filled when theirs is reckoned.

    A slice of `places` would get no gradient, for the image does not come from the slice.
    """
    screen = places.detach()[0]
    if places.requires_grad:
        screen.requires_grad_()

        def keep(slope: Tensor) -> None:
            screen.grad = slope[0] if screen.grad is None else screen.grad + slope[0]

        places.register_hook(keep)  # type: ignore[no-untyped-call]
    return screen
