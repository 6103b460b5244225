"""The cosine distance of gains at the best delay."""

import math

import pytest
import torch

from avmsf.modal.cosine_distance import LARGEST_DELAY, cosine_distance

FREQUENCY = torch.tensor([310.0, 870.0, 1900.0, 3400.0, 5200.0, 8100.0], dtype=torch.float64)
GAINS = torch.randn(40, 6, 2, generator=torch.Generator().manual_seed(0))


def gains() -> torch.Tensor:
    return torch.view_as_complex(GAINS)


def delayed(values: torch.Tensor, seconds: float) -> torch.Tensor:
    turns = torch.polar(torch.ones(6, dtype=torch.float64), 2.0 * math.pi * seconds * FREQUENCY)
    return values.to(torch.complex128) * turns


@pytest.mark.parametrize("delay", [0.0, 1e-5, -1.37e-4, 0.98 * LARGEST_DELAY])
@pytest.mark.parametrize("factor", [1.0, -250.0])
def test_a_point_has_no_distance_from_its_own_gains_of_any_delay_and_sign(delay: float, factor: float) -> None:
    found = cosine_distance(gains(), delayed(factor * gains()[7], delay), FREQUENCY)
    assert int(found.argmin()) == 7
    assert float(found[7]) < 0.01


def test_it_is_the_least_of_a_fine_search_over_delays() -> None:
    recorded = gains()[3].to(torch.complex128) + 0.7 * gains()[9]
    delays = torch.linspace(-LARGEST_DELAY, LARGEST_DELAY, 8001, dtype=torch.float64).tolist()
    turned = torch.stack([delayed(recorded, delay) for delay in delays])
    own = gains().to(torch.complex128)
    match = (own.conj() @ turned.T).real.abs().amax(1) / own.norm(dim=1) / recorded.norm()
    torch.testing.assert_close(cosine_distance(gains(), recorded, FREQUENCY), 1.0 - match, atol=0.01, rtol=0.0)


def test_nothing_is_at_the_greatest_distance() -> None:
    assert bool((cosine_distance(gains(), torch.zeros(6, dtype=torch.complex128), FREQUENCY) == 1.0).all())
    assert float(cosine_distance(0.0 * gains()[:1], delayed(gains()[0], 0.0), FREQUENCY)) == 1.0
