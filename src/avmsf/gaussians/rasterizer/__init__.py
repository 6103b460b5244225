"""Rasterizers: from Gaussians to images, and from derivatives by pixels back to derivatives by the Gaussians.

`rasterizers.Rasterizer` is the interface, of which there is one for CPUs, `NumbaRasterizer`, and one for GPUs by
gsplat. The steps on a CPU, forward and backward, are listed in `avmsf.gaussians`:

- `projection`, with the loops of `ellipses` and `harmonics`: each Gaussian to an ellipse and a color.
- `blending`, with the loops of `tiles` and `pixels`: the ellipses to the image. `pixels` has the derivative by alpha.

In all of them `by_x` is the derivative of the loss by x, the backward loop of `blend` is `blend_back`, and a *lane* is
the share of a loop that one thread computes.
"""
