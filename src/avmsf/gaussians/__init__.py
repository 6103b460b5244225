"""3D Gaussians of an object: their files, their fit to photographs, and what they show of its surface.

In go photographs with cameras and masks (`avmsf.photographs`), or a `.ply` of 3DGS (`ply`); out come a `GaussianCloud`,
and images, depth maps and the points that a camera sees (`visibility`) of it.

`fit.splat` is 3D Gaussian Splatting (Kerbl et al. 2023): Gaussians start on the visual hull (`start_points`), images of
them are compared with the photographs (`targets`, SSIM of Wang et al. 2004 in `ssim`), Adam (Kingma & Ba 2015) changes
them, adaptive density control adds and splits them, and those that are not the object's go (`density`).

How a Gaussian's gradient is computed on a CPU, and where: `rasterizer.rasterizers.NumbaRasterizer` is two functions of
PyTorch's autograd, whose loops numba compiles.

1. `rasterizer.projection.Projection` takes each Gaussian to an ellipse in the image (EWA splatting, Zwicker et al.
   2002; `ellipses.project_points`) and to a color (spherical harmonics; `harmonics.shade`).
2. `rasterizer.blending.Blending` lists for each tile of 8 x 8 pixels the Gaussians on it from front to back (`tiles`)
   and blends them (`pixels.blend`), keeping what is left of each pixel's light.
3. Backwards, `pixels.blend_back` takes each tile's list from back to front, divides the light by what each Gaussian
   let through, and writes ten sums a Gaussian and tile. `blending._gather` adds a Gaussian's sums in the order of the
   tiles, so that the bits do not depend on the number of threads.
4. `ellipses.project_points_back` and `harmonics.shade_back` carry these derivatives on to centers, rotations, scales,
   opacities and harmonics by the chain rule, in the steps of `project_points` and `shade` in reverse.

On a GPU gsplat does all of this. To start reading: `cloud`, `fit.splat` and its `config`, `rasterizer.rasterizers`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
