"""Damping, hammers, radiation, damped sines and room noise against closed forms and independent oracles."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.signal
import torch

from avmsf.errors import SimulationError
from avmsf.fem.material import CERAMIC, STEEL
from avmsf.fem.vibration import AIR_DENSITY, SOUND_SPEED, damped, radiated, rayleigh
from avmsf.simulate.hammer import contact_times, peak_forces, pulse_spectrum
from avmsf.simulate.imperfections import damping_matrix, frequency_factors, smooth_field, support_places
from avmsf.simulate.recipe import Hammer, Imperfections
from avmsf.simulate.shapes.body import stream
from avmsf.simulate.simulation import SoundingBody, room_noise
from factories.made_modes import breathing_sphere, sliding_plate
from factories.raising import raises

LEGS = torch.tensor([[0.11, 0.03, -0.002], [-0.05, 0.07, -0.002], [-0.03, -0.08, -0.002]], dtype=torch.float64)


def test_coupled_modes_move_as_the_equation_of_motion_integrated():
    # Two frequencies are close, and the damping matrix is far from diagonal.
    generator = torch.Generator().manual_seed(0)
    frequency = torch.sort(300.0 + 4000.0 * torch.rand(8, generator=generator, dtype=torch.float64))[0]
    frequency[1] = frequency[0] + 3.0
    root = torch.randn(8, 8, generator=generator, dtype=torch.float64)
    damping = 20.0 * torch.eye(8, dtype=torch.float64) + 5.0 * root @ root.T
    vibration = damped(frequency, damping, highest=20000.0)
    push = torch.linspace(-1.0, 2.0, len(frequency), dtype=torch.float64)
    weights = vibration.accelerations * (vibration.pushes @ push.to(torch.complex128))
    omega = 2 * math.pi * frequency.numpy()
    zero = np.zeros((len(omega), len(omega)))
    # In plain displacement and velocity, unlike the code, and by a matrix exponential in place of eigenvectors.
    system = np.block([[zero, np.eye(len(omega))], [-np.diag(omega**2), -damping.numpy()]])
    for moment in (1e-5, 1e-3, 0.02):
        state = scipy.linalg.expm(system * moment) @ np.concatenate([np.zeros(len(omega)), push.numpy()])
        found = 2 * (weights * torch.exp(vibration.poles * moment)).real.sum(dim=1)
        expected = (system @ state)[len(omega) :]
        np.testing.assert_allclose(found.numpy(), expected, atol=1e-8 * np.abs(expected).max())


def test_modes_that_hardly_ring_are_left_out_and_none_left_is_an_error():
    frequency = torch.tensor([500.0, 900.0, 3000.0], dtype=torch.float64)
    omega = 2 * math.pi * frequency
    # Three, six and more than a hundred per cent of the critical damping.
    damping = torch.diag(omega * torch.tensor([0.06, 0.12, 2.5]))
    vibration = damped(frequency, damping, highest=20000.0)
    assert vibration.frequency.tolist() == pytest.approx([500.0 * math.sqrt(1 - 0.03**2)])
    with raises(SimulationError, name="frequency", value=pytest.approx(500.0)):
        damped(frequency, damping, highest=400.0)


@pytest.mark.parametrize("pulse", ["hertz", "half-sine"])
def test_pulse_spectrum_is_the_integral_of_the_pulse(pulse):
    hammer, contact = Hammer(pulse=pulse), 4e-4
    power = 1.5 if pulse == "hertz" else 1.0
    # In the last the half sine has a limit: half a cycle without damping.
    poles = [-30 + 2j * math.pi * 200, -200 + 2j * math.pi * 1900, -900 + 2j * math.pi * 12000, 2j * math.pi * 1250]
    given = torch.tensor(poles, dtype=torch.complex128), torch.tensor([contact], dtype=torch.float64)
    found = pulse_spectrum(hammer, *given)[0]
    for pole, value in zip(poles, found.tolist(), strict=True):
        parts = [
            scipy.integrate.quad(
                lambda t, part=part: part(np.exp(-pole * t)) * np.sin(math.pi * t / contact) ** power,  # noqa: B023
                0, contact, limit=400, epsabs=1e-14,
            )[0]
            for part in (np.real, np.imag)
        ]  # fmt: skip
        assert value == pytest.approx(complex(*parts), abs=1e-8 * contact)


def test_contact_time_of_a_steel_ball_is_hertzs():
    # A ball of 20 mm on a massive steel block: Hertz's law integrated numerically, m x'' = -4/3 E* sqrt(R) x^(3/2).
    mass, radius, speed = 7850 * 4 / 3 * math.pi * 0.01**3, 0.01, 0.3
    hammer = Hammer(mass=mass, radius=radius, young=2e11, poisson=0.29, speed=speed)
    joint = 1 / (2 * (1 - 0.29**2) / 2e11)
    stiffness = 4 / 3 * joint * math.sqrt(radius)

    def motion(_: float, state: np.ndarray) -> list[float]:
        return [state[1], -stiffness * max(state[0], 0.0) ** 1.5 / mass]

    def parted(_: float, state: np.ndarray) -> float:
        return state[0]

    parted.terminal, parted.direction = True, -1  # type: ignore[attr-defined]
    solved = scipy.integrate.solve_ivp(motion, (0, 1e-3), [0, speed], events=parted, rtol=1e-10, atol=1e-16)
    speeds = torch.tensor([speed], dtype=torch.float64)
    times = contact_times(hammer, STEEL, mass=1e9, speeds=speeds)
    assert float(times) == pytest.approx(solved.t_events[0][0], rel=2e-4)
    # The pulse sin^(3/2) stands for Hertz's within 3 % at its peak.
    peak = stiffness * solved.y[0].max() ** 1.5
    assert float(peak_forces(hammer, mass=1e9, speeds=speeds, times=times)) == pytest.approx(peak, rel=0.03)


def test_flat_tip_is_a_mass_on_a_spring():
    hammer = Hammer(pulse="half-sine", mass=0.1, radius=0.005, young=1e7, poisson=0.45)
    joint = 1 / ((1 - 0.45**2) / 1e7 + (1 - 0.29**2) / 2e11)
    period = 2 * math.pi * math.sqrt(0.1 / (2 * 0.005 * joint))
    speeds = torch.tensor([0.2, 2.0], dtype=torch.float64)
    times = contact_times(hammer, STEEL, mass=1e12, speeds=speeds)
    assert times.tolist() == pytest.approx([period / 2] * 2)
    forces = peak_forces(hammer, mass=1e12, speeds=speeds, times=times)
    assert forces.tolist() == pytest.approx([0.1 * speed * 2 * math.pi / period for speed in (0.2, 2.0)])


def test_a_cushion_is_no_hammer():
    speeds = torch.ones(1, dtype=torch.float64)
    with raises(SimulationError, name="hammer") as caught:
        contact_times(Hammer(young=1e3, mass=1.0), CERAMIC, mass=1.0, speeds=speeds)
    assert caught.value.value > 0.02


@pytest.mark.parametrize("place", [(0.0, 2.0, 0.0), (0.0, 0.0, 2.0), (0.0, 0.0, -4.0)])
def test_a_small_breathing_ball_is_a_monopole(place: tuple[float, float, float]):
    radius, frequency, distance = 0.01, 200.0, max(map(abs, place))
    modes = breathing_sphere(radius, frequency)
    vibration = damped(modes.frequency, torch.tensor([[2.0]], dtype=torch.float64), highest=20000.0)
    heard = complex(radiated(modes, vibration, torch.tensor(place, dtype=torch.float64))[0])
    # Volume acceleration over 4 pi r, exact for ka = .04 to the second order of ka; the ball's own area is the mesh's.
    expected = AIR_DENSITY * radius**2 * complex(vibration.accelerations[0, 0]) / distance
    assert abs(heard) == pytest.approx(abs(expected), rel=5e-3)
    # The time from the nearest point is left out; what is left is less than from the middle.
    assert abs(np.angle(heard / expected)) < 2.5 * 2 * math.pi * frequency * radius / SOUND_SPEED


def test_a_thin_wall_sounds_though_its_faces_move_together():
    modes = sliding_plate((2000.0,))
    vibration = damped(modes.frequency, torch.tensor([[2.0]], dtype=torch.float64), highest=20000.0)
    microphone = torch.tensor([0.09, 0.06, 0.4], dtype=torch.float64)
    thick = abs(complex(radiated(modes, vibration, microphone)[0]))
    # The same face moving at the same speed, a tenth as far from the other: almost as loud.
    thinner = sliding_plate((2000.0,), sides=(0.24, 0.17, 0.0004))
    thin = abs(complex(radiated(thinner, vibration, microphone)[0])) * math.sqrt(0.1)
    assert thin == pytest.approx(thick, rel=0.1)


def test_a_microphone_in_the_object_is_refused():
    modes = breathing_sphere(0.05, 500.0)
    vibration = damped(modes.frequency, torch.tensor([[2.0]], dtype=torch.float64), highest=20000.0)
    with raises(SimulationError, name="microphone", value=pytest.approx(0.005, abs=0.001)):
        radiated(modes, vibration, torch.tensor([0.0, 0.0, 0.055], dtype=torch.float64))


def test_room_noise_has_unit_power_falls_with_frequency_and_has_no_hum():
    noise = room_noise(30, 48000, sample_rate=48000.0, generator=np.random.default_rng(0))
    # The rumble's few strong bins make the power of one second uncertain by a fifth, of thirty by a twenty-fifth.
    assert float(np.sqrt((noise**2).mean())) == pytest.approx(1.0, rel=0.05)
    assert abs(noise.mean()) < 1e-3
    frequency, power = scipy.signal.welch(noise, 48000.0, nperseg=8192, axis=1)
    power = power.mean(axis=0)
    level = [power[(frequency > low) & (frequency < 2 * low)].mean() for low in (60, 250, 1000)]
    # Pink noise falls by 4 from 250 to 1000 Hz; the rumble makes 60 Hz louder still.
    assert 3.0 < level[1] / level[2] < 5.0
    assert level[0] / level[1] > 5.0
    hum = power[np.abs(frequency - 100.0) < 6].mean() / power[np.abs(np.abs(frequency - 100.0) - 18.0) < 6].mean()
    assert 0.7 < hum < 1.4


def plate_body(imperfections: Imperfections, *, hammer: Hammer | None = None) -> SoundingBody:
    modes = sliding_plate()
    matrix = damping_matrix(modes, imperfections, supports=LEGS, generator=stream(3, "coupling"))
    vibration = damped(modes.frequency, matrix, highest=20000.0)
    heard = radiated(modes, vibration, torch.tensor([0.3, -0.2, 0.4], dtype=torch.float64))
    return SoundingBody(modes, vibration, heard, hammer or Hammer())


def blows(count: int = 20, *, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    places = torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
    places = places * torch.tensor([0.24, 0.17, 0.0], dtype=torch.float64)
    places[:, 2] = 0.002
    return places, torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand(count, 3)


def test_without_coupling_damping_is_proportional_and_all_places_of_a_mode_move_in_step():
    body = plate_body(Imperfections.none())
    own = rayleigh(body.elastic.frequency, CERAMIC)
    assert torch.allclose(body.vibration.damping, own / 2, rtol=1e-10)
    gains = body.gains(*blows())
    for mode in range(len(body.vibration.poles)):
        phases = torch.angle(gains[:, mode] / gains[0, mode])
        assert float(torch.minimum(phases.abs(), (phases.abs() - math.pi).abs()).max()) < 1e-8
    # And they follow the shape that was struck.
    shapes = body.elastic.gains(*blows())
    ratio = (gains / shapes).abs()
    assert torch.allclose(ratio, ratio[:1].expand_as(ratio), rtol=1e-8)


def test_coupling_brings_close_modes_out_of_step_and_leaves_the_sum_of_dampings():
    loose, tied = plate_body(Imperfections.none()), plate_body(replace(Imperfections.none(), coupling=0.5))
    gains = tied.gains(*blows())
    phases = torch.angle(gains / gains[:1])
    spread = torch.minimum(phases.abs(), (phases.abs() - math.pi).abs()).amax(dim=0)
    # Modes 2 and 3 lie 20 Hz apart, the others hundreds.
    assert float(spread[2:4].min()) > 5 * float(spread[[0, 1, 4, 5]].max())
    assert float(tied.vibration.damping.sum()) == pytest.approx(float(loose.vibration.damping.sum()), rel=1e-9)


def test_reciprocity_holds_with_coupling_and_supports():
    body = plate_body(Imperfections(coupling=0.6, support=40.0, support_damping=0.3))
    here, there = (body.elastic.gains(*blows(12, seed=seed)).to(torch.complex128) for seed in (1, 2))
    vibration = body.vibration
    # Displacement at one place per newton second at the other, mode by mode.
    moved = vibration.accelerations / vibration.poles.square()

    def response(struck: torch.Tensor, watched: torch.Tensor) -> torch.Tensor:
        return (watched @ moved) * (struck @ vibration.pushes.T)

    forth, back = response(here, there), response(there, here)
    assert float((forth - back).abs().max()) < 1e-9 * float(forth.abs().max())


def test_dampers_under_the_object_take_energy_out_of_every_mode():
    free = plate_body(Imperfections.none())
    held = plate_body(replace(Imperfections.none(), support=10.0, support_damping=0.02))
    # By the shapes at the legs: c |shapes|^2 / 2 each, to first order.
    shapes = free.elastic.at(LEGS)
    damper = 2 * 0.02 * free.elastic.mass * 2 * math.pi * 10.0 / 3
    added = 0.5 * damper * shapes.square().sum(dim=(0, 2))
    assert float(added.min()) > 0.1
    assert torch.allclose(held.vibration.damping - free.vibration.damping, added, rtol=0.05)


def test_smooth_fields_have_the_asked_spread_vary_slowly_and_are_switched_off():
    places = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    spreads = []
    for seed in range(20):
        factors = smooth_field(places, 0.05, diagonal=math.sqrt(3), generator=stream(seed, "stiffness"))
        spreads.append(float(factors.log().square().mean().sqrt()))
        shifted = smooth_field(places + 0.01, 0.05, diagonal=math.sqrt(3), generator=stream(seed, "stiffness"))
        assert float((shifted - factors).abs().max()) < 0.02
    assert float(np.mean(spreads)) == pytest.approx(0.05, rel=0.15)
    assert smooth_field(places, 0.0, diagonal=1.0, generator=stream(0, "x")).unique().tolist() == [1.0]


def test_an_object_stands_on_three_low_places_around_its_middle():
    modes = sliding_plate(sides=(0.2, 0.2, 0.02))
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    legs = support_places(modes.nodes, up, generator=stream(0, "supports"))
    assert float(legs[:, 2].max()) == pytest.approx(-0.01)
    gaps = torch.pdist(legs)
    assert float(gaps.min()) > 0.12


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        (Hammer, "mass", 0.0), (Hammer, "poisson", 0.5), (Hammer, "contact_time", 1.0), (Hammer, "speed", math.nan),
        (Imperfections, "coupling", 1.5), (Imperfections, "stiffness", -0.1), (Imperfections, "support", math.inf),
        (Imperfections, "thickness", math.nan), (Imperfections, "pretrigger", 11.0), (Imperfections, "jitter", -0.001),
        (Imperfections, "propagation", 1.5), (Imperfections, "contact_time", math.nan),
    ],
)  # fmt: skip
def test_impossible_hammers_and_imperfections_are_refused(kind, name, value):
    with raises(SimulationError, name=f"{kind.__name__.lower()}.{name}", value=pytest.approx(value, nan_ok=True)):
        kind(**{name: value})


def test_a_roving_mass_shifts_frequencies_as_it_does_in_the_equations_of_motion():
    plate = sliding_plate()
    places = torch.tensor([[0.11, 0.03, 0.002], [-0.05, 0.07, 0.002]], dtype=torch.float64)
    vibration = damped(plate.frequency, 1e-3 * torch.eye(len(plate), dtype=torch.float64), highest=20000.0)
    share = 1e-4
    found = frequency_factors(plate, vibration, places, replace(Imperfections.none(), sensor=share, warming=0.01))
    for place, factor, warm in zip(places, found, (1.0, 0.99), strict=True):
        shape = plate.gains(place[None], torch.tensor([[0.0, 0.0, 1.0]]))[0].numpy()
        mass = np.eye(len(shape)) + share * plate.mass * np.outer(shape, shape)
        squares = scipy.linalg.eigh(np.diag(plate.frequency.numpy() ** 2), mass, eigvals_only=True)
        np.testing.assert_allclose(factor.numpy(), warm * np.sqrt(squares) / plate.frequency.numpy(), rtol=1e-6)
    # A heavy one does not turn them below zero.
    assert (frequency_factors(plate, vibration, places, replace(Imperfections.none(), sensor=0.5)) > 0).all()
