"""The rasterizer for processors: numba kernels over tiles of 8 x 8 pixels."""

from dataclasses import fields

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.errors import SceneError
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.rasterizer.blending import Blending
from avmsf.gaussians.rasterizer.projection import project
from avmsf.gaussians.rasterizer.protocol import Rendering
from avmsf.photographs.cameras import Camera


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
    tensors = {each.name: getattr(cloud, each.name) for each in fields(cloud)}
    for name, tensor in {**tensors, "background": background}.items():
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            found = [str(tensor.dtype).removeprefix("torch."), str(tensor.device)]
            advice = "convert it, or use the rasterizer of `choose_rasterizer` for that device"
            raise SceneError.expected("float32 numbers on the CPU", found, name=name, advice=advice)


def _fault(cloud: GaussianCloud, row: int) -> SceneError:
    """Return the error of one Gaussian."""
    for each in fields(cloud):
        values = getattr(cloud, each.name)[row].detach()
        if not bool(torch.isfinite(values).all()):
            advice = "remove it with `GaussianCloud.take`, or lower the learning rate if training made it"
            return SceneError.expected("finite numbers", values.tolist(), row=row, name=each.name, advice=advice)
    value, advice = cloud.rotations[row].tolist(), "write 1, 0, 0, 0 for no rotation"
    return SceneError.expected("a quaternion of a length above 0", value, row=row, name="rotations", advice=advice)
