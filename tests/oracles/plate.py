"""A simply supported rectangular plate: every frequency, damping, gain and symmetry in closed form.

The thin plate of Kirchhoff and Navier, struck from above. Mode (m, n), m and n = 1, 2, ..., has

    angular frequency   omega = pi^2 sqrt(D / (rho h)) ((m / a)^2 + (n / b)^2),   D = E h^3 / (12 (1 - nu^2)),
    mass-normal shape   phi(x, y) = 2 / sqrt(rho h a b) sin(m pi x / a) sin(n pi y / b),
    Rayleigh damping    d = (alpha + beta omega^2) / 2,
    damped frequency    sqrt(omega^2 - d^2) / (2 pi)

for a plate of a by b meters, h thick. A blow of one newton-second at x moves the pick-up point p by
phi(x) phi(p) / omega_d exp(-d t) sin(omega_d t) meters in each mode, omega_d being the damped angular frequency. What
is heard is the pseudo-velocity, omega_d times that displacement: as loud as the velocity, in the phase of the
displacement. So a sound is exactly the paper's equation 3 with gains phi(x) phi(p), and no mode is lost among others.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.errors import PositionError, SimulationError


@dataclass(frozen=True, eq=False)
class Plate:
    """A plate in the plane z = 0 with a corner at the origin, `length` along x, `width` along y; steel unless told."""

    length: float = 0.24
    """Side along x, meters."""
    width: float = 0.24 / math.cbrt(3.0)
    """Side along y, meters. The square of length over width is irrational, so that no two modes share a frequency; with
    this ratio the closest two of the 43 below 8 kHz lie 23 Hz apart, three times their half-power width."""
    thickness: float = 0.002
    """Meters."""
    young: float = 2e11
    """Young's modulus, pascals."""
    density: float = 7850.0
    """Kilograms per cubic meter."""
    poisson: float = 0.29
    """Poisson's ratio."""
    alpha: float = 5.0
    """Rayleigh damping in proportion to mass, 1/s."""
    beta: float = 3e-8
    """Rayleigh damping in proportion to stiffness, s."""
    pickup: tuple[float, float] = (0.095, 0.134)
    """Where the plate is listened to, as fractions of length and width: near a corner, and
    on no node of any of those 43 modes, the faintest of which is 18 dB below the plain maximum."""


@dataclass(frozen=True, eq=False)
class PlateModes:
    """The truth: modes of a plate by ascending frequency, and how strongly blows at given contacts excite them."""

    frequency: Float64[Tensor, " modes"]
    """Damped frequencies, Hz."""
    damping: Float64[Tensor, " modes"]
    """Amplitude decay rates, 1/s."""
    gains: Float64[Tensor, "contacts modes"]
    """Signed amplitude of exp(-d t) sin(2 pi f t) for a blow of one newton-second, meters per second."""
    numbers: Int[Tensor, "modes 2"]
    """Half waves (m, n) along x and along y."""


def plate_modes(
    plate: Plate, contacts: Float[Tensor, "contacts 3"], *, highest: float = 8000.0, contact_time: float = 0.0
) -> PlateModes:
    """Return all modes of undamped frequency up to `highest` Hz, with the gains of blows at `contacts`.

    A hammer's tip stays on the plate for `contact_time` seconds and pushes with half a sine, which excites a mode of
    frequency f by cos(pi f tau) / (1 - (2 f tau)^2) of what an impulse in its middle does; zero is an impulse.
    Raises PositionError for contacts off the plate and SimulationError for a band that holds no mode.
    """
    places = contacts.double()
    _expect_on_plate(plate, places)
    area_density = plate.density * plate.thickness
    rigidity = plate.young * plate.thickness**3 / (12.0 * (1.0 - plate.poisson**2))
    scale = math.pi**2 * math.sqrt(rigidity / area_density)
    reach = math.sqrt(2.0 * math.pi * highest / scale)
    half_waves = [
        torch.arange(1, math.floor(side * reach) + 1, dtype=torch.long) for side in (plate.length, plate.width)
    ]
    numbers = torch.cartesian_prod(*half_waves).reshape(-1, 2)
    per_meter = numbers.double() / torch.tensor([plate.length, plate.width], dtype=torch.float64)
    omega = scale * per_meter.square().sum(dim=1)
    damping = 0.5 * (plate.alpha + plate.beta * omega**2)
    frequency = torch.sqrt((omega**2 - damping**2).clamp(min=0.0)) / (2.0 * math.pi)
    # A mode that is damped beyond its critical damping creeps back and does not sound.
    heard = torch.nonzero((omega <= 2.0 * math.pi * highest) & (frequency > 0.0)).flatten()
    if len(heard) == 0:
        lowest = scale * (1.0 / plate.length**2 + 1.0 / plate.width**2) / (2.0 * math.pi)
        raise SimulationError(
            f"highest: expected a limit above the plate's lowest mode at {lowest:g} Hz (undamped), got {highest:g} Hz; "
            "raise it, or make the plate larger, thinner or less damped",
            name="highest",
            value=highest,
        )
    heard = heard[torch.argsort(frequency[heard])]
    pickup = torch.tensor([[plate.pickup[0] * plate.length, plate.pickup[1] * plate.width]], dtype=torch.float64)
    gains = _shapes(plate, places[:, :2], per_meter[heard]) * _shapes(plate, pickup, per_meter[heard])
    return PlateModes(
        frequency[heard], damping[heard], gains * _half_sine(frequency[heard] * contact_time), numbers[heard]
    )


def ring(modes: PlateModes, *, sample_rate: float, samples: int) -> Float64[Tensor, "contacts samples"]:
    """Return the noiseless sounds of the blows, meters per second for one newton-second, exact in float64."""
    times = torch.arange(samples, dtype=torch.float64) / sample_rate
    sounds = torch.zeros(len(modes.gains), samples, dtype=torch.float64)
    # A mode at a time: the table of all modes over a long sound would be larger than the sounds.
    for frequency, damping, gains in zip(modes.frequency, modes.damping, modes.gains.T, strict=True):
        sounds += gains[:, None] * (torch.exp(-damping * times) * torch.sin(2.0 * math.pi * frequency * times))
    return sounds


def strike(
    plate: Plate,
    contacts: Float[Tensor, "contacts 3"],
    *,
    sample_rate: float,
    seconds: float,
    generator: torch.Generator,
    noise_db: float | None = None,
    highest: float = 8000.0,
    contact_time: float = 0.0,
) -> Impacts:
    """Record a blow of one newton-second, straight down, at each contact, as `plate_modes` has it.

    `noise_db` is the level of the white Gaussian noise that is added to all sounds: its root mean square over that of
    the noiseless sounds, both taken over all sounds and their whole length, so that -40.0 is noise 40 dB down and one
    recorder's floor for loud and faint blows alike. None adds none. Frequencies in Hz. Raises as `plate_modes`, and
    SimulationError where a mode would alias.
    """
    if highest >= 0.5 * sample_rate:
        raise SimulationError.expected(
            f"less than half the sample rate of {sample_rate:g} Hz", highest, got=f"{highest:g} Hz", name="highest"
        )
    modes = plate_modes(plate, contacts, highest=highest, contact_time=contact_time)
    sounds = ring(modes, sample_rate=sample_rate, samples=round(seconds * sample_rate))
    if noise_db is not None:
        level = sounds.square().mean().sqrt() * 10.0 ** (noise_db / 20.0)
        sounds = sounds + level * torch.randn(sounds.shape, dtype=torch.float64, generator=generator)
    return Impacts(
        contacts=contacts,
        sounds=sounds.float(),
        sample_rate=float(sample_rate),
        names=tuple(f"plate/{row + 1:03d}" for row in range(len(contacts))),
        directions=torch.tensor([[0.0, 0.0, -1.0]]).expand(len(contacts), 3).to(contacts.dtype),
    )


def sample_contacts(plate: Plate, count: int, *, generator: torch.Generator) -> Float64[Tensor, "contacts 3"]:
    """Draw contacts evenly from the plate without a margin of a twentieth of each side, where all modes fall silent."""
    fractions = 0.05 + 0.9 * torch.rand(count, 2, dtype=torch.float64, generator=generator)
    return _on_plate(plate, fractions)


def plate_surface_points(plate: Plate, count: int) -> Float64[Tensor, "points 3"]:
    """Return at most `count` points in rows and columns of one spacing that cover the plate, its edges left out."""
    along = max(1, math.floor(math.sqrt(count * plate.length / plate.width)))
    across = max(1, count // along)
    sides = [(torch.arange(number, dtype=torch.float64) + 0.5) / number for number in (along, across)]
    return _on_plate(plate, torch.cartesian_prod(*sides).reshape(-1, 2))


def _half_sine(cycles: Float64[Tensor, " modes"]) -> Float64[Tensor, " modes"]:
    """Return the Fourier transform of a half-sine pulse of unit area about its middle; `cycles` is f tau."""
    # Zero over zero at half a cycle, where the limit is pi / 4.
    resonant = (cycles - 0.5).abs() < 1e-9
    safe = torch.where(resonant, 0.0, cycles)
    return torch.where(resonant, math.pi / 4, torch.cos(math.pi * safe) / (1.0 - (2.0 * safe).square()))


def _shapes(
    plate: Plate, places: Float64[Tensor, "contacts 2"], per_meter: Float64[Tensor, "modes 2"]
) -> Float64[Tensor, "contacts modes"]:
    """Return mass-normal mode shapes, 1 / sqrt(kg), of modes with `per_meter` half waves a meter along x and y."""
    sines = torch.sin(math.pi * places[:, None, :] * per_meter)
    mass = plate.density * plate.thickness * plate.length * plate.width
    return 2.0 / math.sqrt(mass) * sines.prod(dim=-1)


def _on_plate(plate: Plate, fractions: Float64[Tensor, "points 2"]) -> Float64[Tensor, "points 3"]:
    return fractions @ torch.tensor([[plate.length, 0.0, 0.0], [0.0, plate.width, 0.0]], dtype=torch.float64)


def _expect_on_plate(plate: Plate, places: Float64[Tensor, "contacts 3"]) -> None:
    ends = torch.tensor([plate.length, plate.width, 0.0], dtype=torch.float64)
    slack = 1e-6 * plate.length  # Contacts that went through float32.
    off = torch.nonzero(~((places >= -slack) & (places <= ends + slack)).all(dim=1)).flatten()
    if len(off):
        row = int(off[0])
        value = places[row].tolist()
        raise PositionError.expected(
            f"x from 0 to {plate.length:g} m, y from 0 to {plate.width:g} m and z = 0", value, row=row, name="contacts"
        )
