"""Photographs of an object with their cameras: from a folder, a video or a mesh to views with masks.

In goes a folder of photographs with cameras (`transforms.json`, or COLMAP's sparse model), or a mesh; out come `View`s:
an image without distortion, its pinhole `Camera`, and where known a mask of the object. Poses are world to camera with
OpenCV's axes, lengths in meters, pixels from the image's corner, so that the first pixel's center is at (.5, .5).

Start with `folder.read_views` and `cameras`. On the way to a view:

- `nerf_json`, `colmap`: the two kinds of camera files. Both give a `CameraFile` of `Photograph`s, which `folder` turns
  into views: image and mask are read (`images`), the lens's distortion is removed (`lenses`: Brown's and Kannala and
  Brandt's models, as OpenCV has them), and cameras are fitted to images of another size.
- `segmentation`: masks before a plain background, by color (Otsu's threshold) and the agreement of all views.
- `visual_hull`: the visual hull (Laurentini 1994) by voting on the cells of a `Grid`; `project_votes` is the one loop
  over views and cells, which `reconstruction` and `gaussians` use too.

Where there are no cameras or no photographs:

- `video`: the sharpest frames of a video (variance of the Laplacian).
- `sfm`, `sfm_worker`: cameras by incremental structure from motion (Schönberger and Frahm 2016), in a process of its
  own; needs pycolmap (`pip install 'avmsf[sfm]'`).
- `mesh_views`: views of a textured mesh by ray casting, from the 72 cameras of ObjectFolder's renders; textures are
  read from mipmaps (Williams 1983).

What cannot be used raises CaptureError with the file, frame or image; what can be, with a loss, warns by
CaptureWarning.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
