"""Kernels of visual features: their formula, and gains shared by places that look alike."""

import torch

from avmsf.field.gains.fitting import MeasuredGains, fit_mixture
from avmsf.field.gains.kernels import Sites, Unstructured, Visual
from avmsf.field.gains.mixture_gains import MixtureGains

SIZE = 1.0


def sites(points: torch.Tensor) -> Sites:
    return Sites(points, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(len(points), 3))


def object_points() -> tuple[torch.Tensor, torch.Tensor]:
    """Return a line of points whose looks repeat after half of it."""
    along = torch.linspace(0.0, 1.0, 41)[:-1]
    points = torch.stack([along, torch.zeros(40), torch.zeros(40)], dim=1)
    angle = 4 * torch.pi * along
    return points, torch.stack([angle.cos(), angle.sin()], dim=1)


def fit(known: Sites, values: torch.Tensor) -> MixtureGains:
    modes = values.shape[1]
    frequency = 100.0 * torch.arange(1, modes + 1, dtype=torch.float64)
    gains = MeasuredGains(values, torch.zeros(modes, dtype=torch.float64), frequency, torch.ones_like(frequency))
    families = [Unstructured(known, SIZE), Visual(known, SIZE, *object_points())]
    return fit_mixture(families, gains, object_points()[0], directional=False)


def test_kernels_are_the_written_ones() -> None:
    """Features by the root mean square distance between those of points, alone and times those of positions."""
    points, features = object_points()
    known = sites(points[::7].double())
    squares = torch.cdist(features.double(), features.double()).square()
    similar = [torch.exp(-0.5 * squares / squares.mean() / length**2)[::7, ::7] for length in (0.25, 0.5, 1.0)]
    apart = torch.cdist(known.points, known.points).square()
    near = [torch.exp(-0.5 * apart / (length * SIZE) ** 2) for length in (0.2, 0.4, 0.8)]
    expected = torch.stack(similar + [one * other for one in near for other in similar])
    # Whatever the unit of the features.
    for unit in (1.0, 100.0):
        found = Visual(known, SIZE, points, unit * features).kernels()
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=0.0)


def test_places_that_look_alike_share_gains() -> None:
    points, features = object_points()
    known = sites(points[:20:2].double())
    values = features[:20:2, :1].to(torch.complex128) * torch.tensor([1.0, 2.0j], dtype=torch.complex128)
    far = points[20::2].double()
    predicted = fit(known, values).predict(far)
    torch.testing.assert_close(predicted.mean[:, 0].real, values[:, 0].real.float(), atol=0.1, rtol=0.0)
    torch.testing.assert_close(predicted.mean[:, 1].imag, values[:, 1].imag.float(), atol=0.2, rtol=0.0)
