"""The gain field of elastic shapes, on a plate whose shapes are sines."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch

from avmsf.field.elasticpoints import ElasticPoints
from avmsf.field.hypotheses import NOISES, REMAINDERS, WIDTHS, row_of
from avmsf.field.modalbasis import REACH, ModalBasis, fit_modal_basis, remainder_kernel, sites_of
from avmsf.field.thinplategains import thin_plate_gains
from avmsf.simulate.plate import Plate, plate_modes, plate_surface_points, sample_contacts

PLATE = Plate()
DOWN = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)


def turned() -> torch.Tensor:
    """Return a rotation about all axes."""
    half = torch.tensor([[0.0, -0.3, 0.7], [0.3, 0, -1.1], [-0.7, 1.1, 0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(half)


@cache
def surface() -> ElasticPoints:
    points = plate_surface_points(PLATE, 2000)
    sines = plate_modes(PLATE, points, highest=6000.0).gains
    shapes = (sines / sines.square().mean(0).sqrt())[..., None] * DOWN
    return ElasticPoints(points.float(), DOWN.float().expand(len(points), 3), shapes.float())


def elastic() -> torch.Tensor:
    return plate_modes(PLATE, plate_surface_points(PLATE, 4), highest=6000.0).frequency


def struck(count: int, *, seed: int = 0, noise: float = 0.02) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return contacts, noisy gains in two parts, and the gains without noise."""
    generator = torch.Generator().manual_seed(seed)
    contacts = sample_contacts(PLATE, count, generator=generator)
    sines = plate_modes(PLATE, contacts, highest=5000.0).gains
    clean = torch.stack([sines, 0.3 * sines], dim=2)
    size = clean.square().mean(0, keepdim=True).sqrt()
    return contacts, clean + noise * size * torch.randn(clean.shape, dtype=torch.float64, generator=generator), clean


def fitted(contacts: torch.Tensor, values: torch.Tensor, **changes) -> ModalBasis:
    directions = changes.pop("directions", DOWN.expand(len(contacts), 3))
    settings = {"frequency": 1.02 * elastic()[: values.shape[1]], "floor": values.new_zeros(values.shape[:2])}
    return fit_modal_basis(surface(), elastic(), contacts, directions, values, **(settings | changes))


def parts(field: ModalBasis, contacts: torch.Tensor, directions: torch.Tensor | None = None) -> torch.Tensor:
    gains = field.at(contacts, directions)
    return torch.stack([gains.mean, gains.quadrature], dim=2).double()


@cache
def field() -> ModalBasis:
    contacts, values, _ = struck(10)
    return fitted(contacts, values)


def test_ten_blows_tell_of_a_plate_what_splines_cannot_and_the_doubt_is_true():
    contacts, values, _ = struck(10)
    places, _, truth = struck(60, seed=1)
    size = truth.square().mean((0, 2))
    errors = parts(field(), places) - truth
    spline = thin_plate_gains(contacts, values, importance=torch.ones(values.shape[1]).double(), points=contacts)
    gains = spline.at(places)
    others = torch.stack([gains.mean, gains.quadrature], dim=2) - truth
    own, other = (float((each.square().mean((0, 2)) / size).mean().sqrt()) for each in (errors, others))
    assert own < 0.35 * other
    doubt = field().deviation(places)
    # Shapes that are exact leave less to doubt than the hypotheses allow for.
    assert float((errors.abs() < 1.645 * doubt).double().mean()) > 0.88
    # Where errors are larger there is more doubt.
    ranks = torch.corrcoef(torch.stack([errors.abs().log().flatten(), doubt.double().log().flatten()]))
    assert float(ranks[0, 1]) > 0.2


def test_a_blow_from_the_other_side_has_the_opposite_gain():
    places, _, _ = struck(20, seed=2)
    down = parts(field(), places, DOWN.expand(20, 3))
    assert torch.allclose(parts(field(), places, -DOWN.expand(20, 3)), -down)
    assert torch.allclose(parts(field(), places), down, rtol=1e-5)
    aslant = torch.nn.functional.normalize(torch.tensor([0.5, 0.0, -1.0], dtype=torch.float64), dim=0)
    assert torch.allclose(parts(field(), places, aslant.expand(20, 3)), -aslant[2] * down, rtol=1e-5)
    assert torch.allclose(parts(field(), places, torch.zeros(20, 3)), down, rtol=1e-5)
    assert torch.allclose(field().deviation(places, -DOWN.expand(20, 3)), field().deviation(places), rtol=1e-5)


def test_blows_from_both_sides_make_the_field_of_blows_from_one():
    contacts, values, _ = struck(10)
    signs = torch.tensor([1.0, -1, 1, 1, -1, 1, -1, -1, 1, 1], dtype=torch.float64)
    both = fitted(contacts, signs[:, None, None] * values, directions=signs[:, None] * DOWN)
    places, _, _ = struck(20, seed=2)
    assert torch.allclose(parts(both, places), parts(field(), places), rtol=1e-4, atol=1e-6)


def test_an_object_turned_round_with_its_contacts_has_the_same_gains():
    contacts, values, _ = struck(10)
    rotation, shift = turned(), torch.tensor([0.3, -2.0, 0.1], dtype=torch.float64)
    known = surface()
    moved = ElasticPoints(
        (known.points.double() @ rotation.T + shift).float(),
        (known.inward.double() @ rotation.T).float(),
        (known.shapes.double() @ rotation.T).float(),
    )
    there = fit_modal_basis(
        moved,
        elastic(),
        contacts @ rotation.T + shift,
        (DOWN @ rotation.T).expand(10, 3),
        values,
        frequency=1.02 * elastic()[: values.shape[1]],
        floor=values.new_zeros(values.shape[:2]),
    )
    places, _, truth = struck(20, seed=2)
    # The box around the points, of which the remainder's reach is a part, turns with them only nearly.
    apart = parts(there, places @ rotation.T + shift) - parts(field(), places)
    assert float(apart.square().mean() / truth.square().mean()) < 0.02**2


def test_without_directions_blows_go_straight_in():
    contacts, values, _ = struck(10)
    assert torch.allclose(fitted(contacts, values, directions=None).directions, DOWN.expand(10, 3))


def test_what_the_field_says_at_its_contacts_is_what_its_smoother_does():
    contacts, values, _ = struck(10)
    smoothed = torch.einsum("mdce,emd->cmd", field().smoother(), values)
    found = parts(field(), contacts, field().directions)
    assert torch.allclose(found, smoothed, atol=1e-5 * float(values.abs().max()))


def test_the_covariance_with_the_contacts_is_that_of_the_contacts_without_noise():
    one = (WIDTHS.index(0.2), REMAINDERS.index(0.1), NOISES.index(0.1))
    known, surface = field().regression.hypotheses, field().surface
    whole = known.covariance(torch.arange(known.prior.shape[0]), torch.tensor([row_of(*one)]))[0]
    found, _ = sites_of(surface, field().contacts, field().directions)
    cross = known.kernel(found.shapes, found.remainder, *one[:2])
    assert torch.allclose(whole - cross, 0.1 * torch.eye(10, dtype=torch.float64).expand_as(whole), atol=1e-12)


def test_the_remainder_fades_with_distance_and_with_the_angle_between_blows():
    contacts = torch.tensor([[0.0, 0, 0], [0.3, 0, 0]], dtype=torch.float64)
    directions = torch.tensor([[0.0, 0, 1], [0, math.sin(1.0), math.cos(1.0)]], dtype=torch.float64)
    kernel = remainder_kernel(contacts, directions, contacts, directions, reach=0.2)
    assert kernel.diagonal().tolist() == pytest.approx([1.0, 1.0])
    assert float(kernel[0, 1]) == pytest.approx(math.exp(-0.5 * 1.5**2) * math.cos(1.0))
    assert 0 < REACH < 1


def test_a_field_comes_back_from_its_tensors():
    known = replace(field(), report={"body": "a plate"})
    tensors = known.tensors()
    skeleton = ModalBasis.skeleton(known.record())
    assert {name: (each.shape, each.dtype) for name, each in skeleton.items()} == {
        name: (each.shape, each.dtype) for name, each in tensors.items()
    }
    back = ModalBasis.restore(known.record(), tensors)
    places, _, _ = struck(20, seed=2)
    assert torch.equal(parts(back, places), parts(known, places))
    assert torch.equal(back.deviation(places), known.deviation(places))
    with pytest.raises(ValueError, match="hypotheses is 3, not 72"):
        ModalBasis.skeleton(known.record() | {"hypotheses": 3})
    with pytest.raises(ValueError, match="contacts is 0"):
        ModalBasis.skeleton(known.record() | {"contacts": 0})


def test_modes_are_taken_in_the_given_order_and_other_values_scale_the_field():
    places, _, _ = struck(20, seed=2)
    rows = torch.tensor([3, 0, 7])
    whole = parts(field(), places)
    assert torch.allclose(parts(field().take(rows), places), whole[:, rows])
    assert torch.allclose(parts(field().with_values(3 * field().values), places), 3 * whole)
