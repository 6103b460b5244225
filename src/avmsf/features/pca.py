"""Features as a gain network wants them: few, of about unit size, and beside the positions where these help."""

import torch

from avmsf.errors import SceneError
from avmsf.features.feature_field import GEOMETRY, FeatureField


def reduce(features: FeatureField, dim: int, *, whitening: float = 1.0) -> FeatureField:
    """Return the features' first `dim` principal components, with the encoder's name followed by what was done.

    `whitening` says how even they become: at 1 each has variance 1 over the points; at 0 they keep the proportions
    that they have, the first having variance 1. A component's sign is that of its largest loading, so that the same
    features give the same components anywhere. Fewer come out where the features vary in fewer directions. Raises
    SceneError for features that are all equal.
    """
    if dim < 1:
        raise SceneError(f"dim: expected at least 1, got {dim}", name="dim", value=dim)
    if not 0.0 <= whitening <= 1.0:
        raise SceneError(f"whitening: expected 0 to 1, got {whitening:g}", name="whitening", value=whitening)
    values = features.features.double()
    values = values - values.mean(0)
    variances, directions = torch.linalg.eigh(values.T @ values / len(values))
    variances, directions = variances.flip(0), directions.flip(1)
    # What is below the rounding of float32 features varies in no direction.
    kept = min(dim, int((variances > 1e-10 * variances[0]).sum()))
    if not float(variances[0]) > 0:
        raise SceneError(
            f"expected features that differ over the object, got {len(values)} equal ones from the encoder "
            f"{features.encoder!r}; use another encoder, or only positions",
            name=features.encoder,
            value=len(values),
        )
    variances, directions = variances[:kept], directions[:, :kept]
    largest = directions.gather(0, directions.abs().argmax(0, keepdim=True))
    sizes = variances ** (whitening / 2) * variances[0] ** ((1 - whitening) / 2)
    reduced = values @ (directions * largest.sign()) / sizes
    return FeatureField(features.points, reduced.float(), f"{features.encoder}, {kept} components")


def resize(features: FeatureField, size: float) -> FeatureField:
    """Return the features times what makes their root mean square length over the points `size`.

    Raises SceneError for features that are all zero.
    """
    length = float(features.features.double().square().sum(1).mean().sqrt())
    if not length > 0:
        raise SceneError(
            f"expected features other than zero, got zeros from the encoder {features.encoder!r}; use another",
            name=features.encoder,
            value=0.0,
        )
    return FeatureField(features.points, features.features * (size / length), features.encoder)


def with_positions(features: FeatureField) -> FeatureField:
    """Return the features with the points' positions before them, as `FeatureField.from_points` has them.

    Color alone does not distinguish a bowl's left from its right; a gain field may need to. Positions have a norm of 1
    at most and a root mean square of about .5; `resize` gives features a comparable size.
    """
    positions = FeatureField.from_points(features.points).features
    joined = torch.cat([positions, features.features.float()], dim=1)
    return FeatureField(features.points, joined, f"{GEOMETRY} and {features.encoder}")
