"""The plate against Navier's series, Rayleigh's law, a recursive filter and its own symmetries."""

import math

import numpy as np
import torch

from oracles.plate import Plate, plate_modes, plate_surface_points, sample_contacts


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def undamped(**changes: float) -> Plate:
    return Plate(alpha=0.0, beta=0.0, **changes)


def test_frequencies_are_naviers():
    plate = undamped(length=0.5, width=0.3, thickness=0.004, young=7e10, density=2700.0, poisson=0.33)
    modes = plate_modes(plate, sample_contacts(plate, 1, generator=seeded()), highest=3000.0)
    rigidity = 7e10 * 0.004**3 / 12 / (1 - 0.33**2)
    every = sorted(
        (math.pi / 2 * math.sqrt(rigidity / (2700.0 * 0.004)) * ((m / 0.5) ** 2 + (n / 0.3) ** 2), m, n)
        for m in range(1, 40)
        for n in range(1, 40)
    )
    heard = [mode for mode in every if mode[0] <= 3000.0]
    assert len(heard) > 15
    np.testing.assert_allclose(modes.frequency.numpy(), [mode[0] for mode in heard], rtol=1e-13)
    assert modes.numbers.tolist() == [[m, n] for _, m, n in heard]


def test_damping_is_rayleighs_and_lowers_the_frequency():
    contact = torch.tensor([[0.1, 0.05, 0.0]])
    free = plate_modes(undamped(), contact)
    damped = plate_modes(Plate(alpha=40.0, beta=2e-6), contact)
    omega = 2 * math.pi * free.frequency
    assert torch.allclose(damped.damping, 20.0 + 1e-6 * omega**2, rtol=1e-13)
    assert torch.allclose((2 * math.pi * damped.frequency) ** 2 + damped.damping**2, omega**2, rtol=1e-12)


def test_gains_are_mass_normal_shapes_at_both_ends():
    plate = Plate()
    # Integrals of products of shapes over the plate by the midpoint rule, exact for these sines.
    grid = plate_surface_points(plate, 6000)
    modes = plate_modes(plate, grid)
    area = plate.length * plate.width / len(grid)
    inner = plate.density * plate.thickness * area * modes.gains.T @ modes.gains
    pickup = torch.tensor([[0.095 * plate.length, 0.134 * plate.width, 0.0]], dtype=torch.float64)
    # At the pick-up itself the gain is the shape's square there, and the shape has unit mass.
    heard = plate_modes(plate, pickup).gains[0]
    assert torch.allclose(torch.diagonal(inner), heard, rtol=1e-10)
    assert float((inner - torch.diag(torch.diagonal(inner))).abs().max()) < 1e-10 * float(heard.max())


def test_a_hammers_half_sine_excites_each_mode_by_its_spectrum():
    plate = Plate()
    contacts = torch.tensor([[0.05, 0.06, 0.0]], dtype=torch.float64)
    impulse = plate_modes(plate, contacts)
    pushed = plate_modes(plate, contacts, contact_time=1e-3)
    times = torch.linspace(0, 1e-3, 20001, dtype=torch.float64)
    pulse = torch.sin(math.pi * times / 1e-3)
    turning = torch.cos(2 * math.pi * impulse.frequency[:, None] * (times - 0.5e-3))
    spectrum = torch.trapezoid(pulse * turning, times) / torch.trapezoid(pulse, times)
    # The trapezoid rule over 20,000 steps is good to about 1e-7 at 8 kHz.
    torch.testing.assert_close(pushed.gains / impulse.gains, spectrum[None], rtol=0, atol=1e-6)
