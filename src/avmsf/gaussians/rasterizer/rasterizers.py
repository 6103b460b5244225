"""What turns Gaussians into images: one interface; numba kernels on tiles of 8 x 8 pixels for CPUs, gsplat for GPUs."""

import importlib
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.errors import SceneError, from_extra
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.rasterizer.blending import Blending
from avmsf.gaussians.rasterizer.ellipses import MIN_DEPTH_M
from avmsf.gaussians.rasterizer.projection import project
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


def choose_rasterizer(device: torch.device | str) -> Rasterizer:
    """Return what renders clouds whose tensors lie on `device`: numba kernels on the CPU, gsplat on CUDA.

    Raises SceneError for any other device, and for CUDA where gsplat or the device is missing.
    """
    kind = torch.device(device).type
    if kind == "cpu":
        return NumbaRasterizer()
    if kind != "cuda":
        raise SceneError.expected("cpu or cuda", str(device), name="device", advice="move the Gaussians to one")
    if not torch.cuda.is_available():
        advice = "choose cpu, or install the PyTorch build for your GPU"
        raise SceneError.expected(
            "a CUDA device that PyTorch can use", str(device), got="none", name="device", advice=advice
        )
    return GsplatRasterizer()


class NumbaRasterizer:
    """Renders clouds on the CPU in float32, with as many threads as numba is given (`NUMBA_NUM_THREADS`).

    The same cloud gives the same image and the same gradients to the last bit, whatever the number of threads. The
    first use on a machine compiles, which takes some ten seconds; what was compiled is kept for the next time.
    """

    def __call__(self, cloud: GaussianCloud, camera: Camera, *, background: Float[Tensor, " 3"]) -> Rendering:
        """Return what `camera` sees before a `background` color.

        Raises SceneError for tensors that are not float32 on the CPU, and for Gaussians with numbers that are not
        finite or rotations without length.
        """
        _expect_plain(cloud, background)
        screen, ellipses, opacities, colors, depths, radii, remainders = project(cloud, camera)
        if bool(torch.isnan(radii).any()):
            raise _fault(cloud, int(torch.nonzero(torch.isnan(radii[:, 0]))[0]))
        color, alpha, depth = Blending.apply(  # type: ignore[no-untyped-call]
            screen, ellipses, opacities, colors, depths, radii, remainders, background, (camera.width, camera.height)
        )
        return Rendering(color, alpha, depth, screen, radii[:, 0])


def _expect_plain(cloud: GaussianCloud, background: Float[Tensor, " 3"]) -> None:
    for name, tensor in {**vars(cloud), "background": background}.items():
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            found = [str(tensor.dtype).removeprefix("torch."), str(tensor.device)]
            advice = "convert it, or use the rasterizer of `choose_rasterizer` for that device"
            raise SceneError.expected("float32 numbers on the CPU", found, name=name, advice=advice)


def _fault(cloud: GaussianCloud, row: int) -> SceneError:
    """Return the error of one Gaussian."""
    for name, values in vars(cloud).items():
        if not bool(torch.isfinite(values[row]).all()):
            advice = "remove it with `GaussianCloud.take`, or lower the learning rate if training made it"
            return SceneError.expected("finite numbers", values[row].tolist(), row=row, name=name, advice=advice)
    value, advice = cloud.rotations[row].tolist(), "write 1, 0, 0, 0 for no rotation"
    return SceneError.expected("a quaternion of a length above 0", value, row=row, name="rotations", advice=advice)


class GsplatRasterizer:
    """Renders clouds where they lie, on a CUDA device, by gsplat."""

    def __init__(self) -> None:
        """Raise SceneError where gsplat cannot be imported."""
        with from_extra("gpu", "gsplat", raising=SceneError, instead="render on the CPU"):
            self._gsplat: Any = importlib.import_module("gsplat")

    def __call__(self, cloud: GaussianCloud, camera: Camera, *, background: Float[Tensor, " 3"]) -> Rendering:
        """Return what `camera` sees before a `background` color.

        Raises SceneError for a cloud or background that is not on a CUDA device.
        """
        centers = cloud.centers
        for name, tensor in (("cloud", centers), ("background", background)):
            if not is_on_gpu(tensor):
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
            near_plane=MIN_DEPTH_M,
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
            screen=_with_gradient(found["means2d"]),
            # One for each axis of the image since gsplat 1.5.
            radii=(radii.amax(-1) if radii.ndim == 2 else radii).to(centers.dtype),
        )


def is_on_gpu(tensor: Tensor) -> bool:
    """Return whether a tensor is on a CUDA device."""
    return tensor.device.type == "cuda"


def _with_gradient(places: Float[Tensor, "cameras points 2"]) -> Float[Tensor, "points 2"]:
    """Return the one camera's places as a tensor whose `grad` is filled when theirs is computed.

    A slice of `places` would get no gradient, for the image does not come from the slice.
    """
    screen = places.detach()[0]
    if places.requires_grad:
        screen.requires_grad_()

        def keep(slope: Tensor) -> None:
            screen.grad = slope[0] if screen.grad is None else screen.grad + slope[0]

        places.register_hook(keep)  # type: ignore[no-untyped-call]
    return screen
