"""The plate against Navier's series, Rayleigh's law, a recursive filter and its own symmetries."""

import math
import re

import numpy as np
import pytest
import scipy.signal
import torch

from avmsf.errors import PositionError, SimulationError
from factories.raising import raises
from oracles.plate import Plate, plate_modes, plate_surface_points, ring, sample_contacts, strike


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


def test_a_square_meter_of_steel_sounds_where_the_handbook_has_it():
    # Leissa: omega a^2 sqrt(rho / D) is 19.739 for the first mode of a simply supported square plate, 2 pi^2.
    plate = undamped(length=1.0, width=1.0, thickness=0.01, young=2e11, density=7850.0, poisson=0.3)
    modes = plate_modes(plate, torch.tensor([[0.4, 0.3, 0.0]]), highest=100.0)
    rigidity = 2e11 * 0.01**3 / (12 * 0.91)
    factor = 2 * math.pi * float(modes.frequency[0]) * math.sqrt(7850.0 * 0.01 / rigidity)
    assert factor == pytest.approx(19.739, abs=5e-4)


def test_damping_is_rayleighs_and_lowers_the_frequency():
    contact = torch.tensor([[0.1, 0.05, 0.0]])
    free = plate_modes(undamped(), contact)
    damped = plate_modes(Plate(alpha=40.0, beta=2e-6), contact)
    omega = 2 * math.pi * free.frequency
    assert torch.allclose(damped.damping, 20.0 + 1e-6 * omega**2, rtol=1e-13)
    assert torch.allclose((2 * math.pi * damped.frequency) ** 2 + damped.damping**2, omega**2, rtol=1e-12)


def test_modes_beyond_critical_damping_do_not_sound():
    contact = torch.tensor([[0.1, 0.05, 0.0]])
    # beta omega / 2 = 1 at 2 kHz: modes above creep.
    modes = plate_modes(Plate(alpha=0.0, beta=2 / (2 * math.pi * 2000.0)), contact)
    free = plate_modes(undamped(), contact)
    assert len(modes.frequency) == int((free.frequency < 2000.0).sum())


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


def test_blow_and_pickup_may_change_places():
    plate = Plate()
    contact = torch.tensor([[0.3 * plate.length, 0.41 * plate.width, 0.0]], dtype=torch.float64)
    there = plate_modes(plate, contact)
    swapped = Plate(pickup=(0.3, 0.41))
    back = torch.tensor([[0.095 * plate.length, 0.134 * plate.width, 0.0]], dtype=torch.float64)
    assert torch.allclose(there.gains, plate_modes(swapped, back).gains, rtol=1e-11)


def test_mirrored_contacts_have_mirrored_gains():
    plate = Plate()
    contacts = sample_contacts(plate, 20, generator=seeded())
    ends = torch.tensor([plate.length, plate.width, 0.0], dtype=torch.float64)
    modes = plate_modes(plate, contacts)
    across = plate_modes(plate, torch.stack([ends[0] - contacts[:, 0], contacts[:, 1], contacts[:, 2]], dim=1))
    along = plate_modes(plate, torch.stack([contacts[:, 0], ends[1] - contacts[:, 1], contacts[:, 2]], dim=1))
    # A half wave more changes the sign at the far side: + for odd, - for even numbers.
    sign_x, sign_y = (1.0 - 2.0 * ((modes.numbers[:, axis] + 1) % 2) for axis in (0, 1))
    largest = float(modes.gains.abs().max())
    assert torch.allclose(across.gains, sign_x * modes.gains, atol=1e-12 * largest)
    assert torch.allclose(along.gains, sign_y * modes.gains, atol=1e-12 * largest)
    assert {float(value) for value in sign_x} == {-1.0, 1.0}


def test_the_default_plate_hides_no_mode():
    plate = Plate()
    modes = plate_modes(plate, plate_surface_points(plate, 400))
    assert len(modes.frequency) == 43
    width = modes.damping[1:] / math.pi
    assert float(modes.frequency.diff().min()) == pytest.approx(23.4, abs=0.1)
    assert float((modes.frequency.diff() / width).min()) > 3.0
    level = 20 * torch.log10(modes.gains.square().mean(dim=0).sqrt())
    assert float(level.max() - level.min()) < 20.0


def test_sounds_are_those_of_two_pole_filters():
    plate, rate, samples = Plate(), 44100.0, 30000
    contacts = sample_contacts(plate, 2, generator=seeded())
    modes = plate_modes(plate, contacts)
    impulse = np.zeros(samples)
    impulse[0] = 1.0
    expected = np.zeros((2, samples))
    for frequency, damping, gains in zip(modes.frequency, modes.damping, modes.gains.T, strict=True):
        radius, angle = math.exp(-float(damping) / rate), 2 * math.pi * float(frequency) / rate
        atom = scipy.signal.lfilter(
            [0.0, radius * math.sin(angle)], [1.0, -2 * radius * math.cos(angle), radius**2], impulse
        )
        expected += gains.numpy()[:, None] * atom
    sounds = ring(modes, sample_rate=rate, samples=samples).numpy()
    # The recursion's rounding grows with its 30,000 steps.
    np.testing.assert_allclose(sounds, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_a_strike_is_the_ringing_and_noise_of_the_level_asked():
    plate = Plate()
    contacts = sample_contacts(plate, 10, generator=seeded(1))
    clean = strike(plate, contacts, sample_rate=44100.0, seconds=0.5, generator=seeded())
    assert clean.sounds.shape == (10, 22050)
    assert clean.sounds.dtype == torch.float32
    truth = ring(plate_modes(plate, contacts), sample_rate=44100.0, samples=22050)
    assert torch.allclose(clean.sounds.double(), truth, atol=1e-7 * float(truth.abs().max()))
    noisy = strike(plate, contacts, sample_rate=44100.0, seconds=0.5, generator=seeded(), noise_db=-40.0)
    difference = noisy.sounds.double() - truth
    level = 10 * math.log10(float(difference.square().mean() / truth.square().mean()))
    # 220,500 samples: the level's standard error is .013 dB.
    assert level == pytest.approx(-40.0, abs=0.05)
    # One floor for all: each row's level, of 22,050 samples, within four standard errors of .041 dB.
    rows = 10 * torch.log10(difference.square().mean(dim=1) / difference.square().mean())
    assert float(rows.abs().max()) < 0.17


def test_the_generator_decides_the_noise():
    plate = Plate()
    contacts = sample_contacts(plate, 2, generator=seeded())

    def record(seed: int) -> torch.Tensor:
        impacts = strike(plate, contacts, sample_rate=20000.0, seconds=0.1, generator=seeded(seed), noise_db=-30.0)
        return impacts.sounds

    assert torch.equal(record(5), record(5))
    assert not torch.equal(record(5), record(6))


def test_contacts_are_drawn_evenly_off_the_edge():
    plate = Plate()
    contacts = sample_contacts(plate, 4000, generator=seeded())
    assert torch.equal(contacts, sample_contacts(plate, 4000, generator=seeded()))
    fractions = contacts / torch.tensor([plate.length, plate.width, 1.0], dtype=torch.float64)
    assert float(fractions[:, :2].min()) >= 0.05
    assert float(fractions[:, :2].max()) <= 0.95
    assert float(contacts[:, 2].abs().max()) == 0.0
    # A mean of 4000 even draws over .9: four standard errors.
    assert torch.allclose(
        fractions.mean(dim=0)[:2], torch.tensor(0.5, dtype=torch.float64), atol=4 * 0.9 / 12**0.5 / 63
    )


def test_surface_points_cover_the_plate_with_one_spacing():
    plate = Plate()
    points = plate_surface_points(plate, 500)
    assert 400 <= len(points) <= 500
    xs, ys = points[:, 0].unique(), points[:, 1].unique()
    assert len(xs) * len(ys) == len(points)
    assert float(xs.diff().mean() / ys.diff().mean()) == pytest.approx(1.0, abs=0.1)
    assert float(xs[0]) == pytest.approx(float(xs.diff().mean()) / 2, rel=1e-9)


def test_directions_and_names_come_with_the_strikes():
    plate = Plate()
    impacts = strike(
        plate, sample_contacts(plate, 3, generator=seeded()), sample_rate=44100.0, seconds=0.01, generator=seeded()
    )
    assert impacts.directions is not None
    assert impacts.directions.tolist() == [[0.0, 0.0, -1.0]] * 3
    assert impacts.names == ("plate/001", "plate/002", "plate/003")
    assert impacts.take([2]).names == ("plate/003",)


def test_what_no_plate_can_do_is_refused():
    plate = Plate()
    for row, place in ((1, [0.3, 0.05, 0.0]), (0, [0.1, -0.001, 0.0]), (0, [0.1, math.nan, 0.0])):
        contacts = torch.tensor([[0.1, 0.05, 0.0]] * row + [place])
        with raises(PositionError, name="contacts", row=row, value=pytest.approx(place, nan_ok=True)):
            plate_modes(plate, contacts)
    with raises(SimulationError, name="highest", value=200.0) as caught:
        plate_modes(plate, torch.tensor([[0.1, 0.05, 0.0]]), highest=200.0)
    assert re.search(r"255\.\d+ Hz", str(caught.value))
    with raises(SimulationError, name="highest", value=8000.0) as caught:
        strike(plate, torch.tensor([[0.1, 0.05, 0.0]]), sample_rate=16000.0, seconds=1.0, generator=seeded())
    assert "16000 Hz" in str(caught.value)


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
