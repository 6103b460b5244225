"""Gaussians for a field without any: a flat disc on the surface at each of its points."""

import numpy as np
import torch
from scipy.spatial import cKDTree

from avmsf.export.sampled_field import SampledField
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.initialize import ZEROTH

_GRAY = 0.7


def discs(field: SampledField) -> GaussianCloud:
    """Return a flat gray Gaussian at each point, tangent to the surface, as wide as the distance between points."""
    places = field.points.double().numpy()
    if len(places) > 1:
        apart = np.median(cKDTree(places).query(places, k=min(4, len(places)))[0][:, 1:], axis=1)
    else:
        apart = np.ones(1) * 0.01
    width = torch.from_numpy(np.maximum(apart, 1e-6)).float() * 0.6
    scales = torch.stack([width, width, 0.1 * width], dim=1)
    # The rotation of the third axis onto the normal, as a quaternion.
    turned = torch.cat([1.0 + field.normals[:, 2:], -field.normals[:, 1:2], field.normals[:, :1]], dim=1)
    turned = torch.cat([turned, torch.zeros(len(field), 1)], dim=1)
    below = field.normals[:, 2] < -1 + 1e-6
    turned[below] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    return GaussianCloud(
        field.points.float(),
        torch.nn.functional.normalize(turned, dim=1),
        scales.log(),
        torch.full((len(field),), 3.0),
        torch.full((len(field), 1, 3), (_GRAY - 0.5) / ZEROTH),
    )
