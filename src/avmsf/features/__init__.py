"""Image features on the surface of an object: computed, lifted, reduced, pooled over symmetries, and kept in a file.

In go views (`avmsf.photographs`) and points of the object, Gaussians or a mesh's; out comes a `FeatureField`: points,
each with a vector of about unit size, which the gain models of `avmsf.field` read.

- `encoder.Encoder` turns an image into a map of features: DINOv2 (Oquab et al. 2023; `dino`), EfficientNet-Lite0 (Tan
  and Le 2019; `efficientnet`), or descriptors of color, orientation and curvature that need no download
  (`encoder.ImageDescriptors`). All see the object's colors continued over the background (pull-push, Gortler et al.
  1996; `encoder.continue_outside`).
- `lift.lift` and `lift.lift_points` give each point the weighted mean of the maps at its places in the views that see
  it, by a depth test against the Gaussians or the mesh (`avmsf.gaussians.visibility`; paper, section 3.2).
  `lift.supported` leaves out points that no view shows on the surface.
- `feature_field` holds the points with their features: principal components (`reduce`), scale (`resize`), positions
  next to them (`with_positions`), nearest points and k-means regions (paper, eq. 7); and their safetensors file, with
  a JSON header.
- `pooling.refine` takes means over the orbits of rotations and over mirror images (paper, eq. 16 and 17).

To start reading: `feature_field`, then `lift`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
