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
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.capture.impacts import Impacts


@dataclass(frozen=True, eq=False)
class Plate:
    """A plate in the plane z = 0 with a corner at the origin, `length` along x, `width` along y; steel unless told."""

    length: float = 0.24
    width: float = 0.24 / math.cbrt(3.0)
    """Meters. The square of length over width is irrational, so that no two modes share a frequency; with this ratio
    the closest two of the 43 below 8 kHz lie 23 Hz apart, three times their half-power width."""
    thickness: float = 0.002
    young: float = 2e11
    """Pascals."""
    density: float = 7850.0
    poisson: float = 0.29
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


def plate_modes(
    plate: Plate, contacts: Float[Tensor, "contacts 3"], *, highest: float = 8000.0, contact_time: float = 0.0
) -> PlateModes:
    """Return all modes of undamped frequency up to `highest` Hz, with the gains of blows at `contacts`.

    A hammer's tip stays on the plate for `contact_time` seconds and pushes with half a sine, which excites a mode of
    frequency f by cos(pi f tau) / (1 - (2 f tau)^2) of what an impulse in its middle does; zero is an impulse.
    """
    sides = torch.tensor([plate.length, plate.width], dtype=torch.float64)
    area_density = plate.density * plate.thickness
    rigidity = plate.young * plate.thickness**3 / (12.0 * (1.0 - plate.poisson**2))
    scale = math.pi**2 * math.sqrt(rigidity / area_density)
    reach = math.sqrt(2.0 * math.pi * highest / scale)
    half_waves = [torch.arange(1, math.floor(side * reach) + 1) for side in (plate.length, plate.width)]
    per_meter = torch.cartesian_prod(*half_waves).reshape(-1, 2) / sides
    omega = scale * per_meter.square().sum(dim=1)
    damping = 0.5 * (plate.alpha + plate.beta * omega**2)
    frequency = torch.sqrt((omega**2 - damping**2).clamp(min=0.0)) / (2.0 * math.pi)
    # A mode that is damped beyond its critical damping creeps back and does not sound.
    heard = torch.nonzero((omega <= 2.0 * math.pi * highest) & (frequency > 0.0)).flatten()
    heard = heard[torch.argsort(frequency[heard])]
    places = torch.cat([torch.tensor([plate.pickup], dtype=torch.float64) * sides, contacts.double()[:, :2]])
    sines = torch.sin(math.pi * places[:, None, :] * per_meter[heard])
    shapes = 2.0 / math.sqrt(area_density * plate.length * plate.width) * sines.prod(dim=-1)
    cycles = frequency[heard] * contact_time
    # Zero over zero at half a cycle, where the limit is pi / 4.
    push = torch.cos(math.pi * cycles) / (1.0 - (2.0 * cycles).square())
    push = torch.where((cycles - 0.5).abs() < 1e-9, math.pi / 4, push)
    return PlateModes(frequency[heard], damping[heard], shapes[1:] * shapes[:1] * push)


def strike(
    plate: Plate,
    count: int,
    *,
    sample_rate: float,
    seconds: float,
    seed: int,
    noise_db: float | None = None,
    highest: float = 8000.0,
    contact_time: float = 0.0,
) -> Impacts:
    """Record blows of one newton-second, straight down, at `count` drawn contacts, as `plate_modes` has them.

    `noise_db` is the level of the white Gaussian noise that is added to all sounds: its root mean square over that of
    the noiseless sounds, both taken over all sounds and their whole length, so that -40.0 is noise 40 dB down and one
    recorder's floor for loud and faint blows alike. None adds none. Frequencies in Hz.
    """
    generator = torch.Generator().manual_seed(seed)
    contacts = sample_contacts(plate, count, generator=generator)
    modes = plate_modes(plate, contacts, highest=highest, contact_time=contact_time)
    times = torch.arange(round(seconds * sample_rate), dtype=torch.float64) / sample_rate
    sounds = torch.zeros(len(contacts), len(times), dtype=torch.float64)
    # A mode at a time: the table of all modes over a long sound would be larger than the sounds.
    for frequency, damping, gains in zip(modes.frequency, modes.damping, modes.gains.T, strict=True):
        sounds += gains[:, None] * (torch.exp(-damping * times) * torch.sin(2.0 * math.pi * frequency * times))
    if noise_db is not None:
        level = sounds.square().mean().sqrt() * 10.0 ** (noise_db / 20.0)
        sounds = sounds + level * torch.randn(sounds.shape, dtype=torch.float64, generator=generator)
    names = tuple(f"plate/{row + 1:03d}" for row in range(len(contacts)))
    directions = torch.tensor([[0.0, 0.0, -1.0]]).expand(len(contacts), 3).to(contacts.dtype)
    return Impacts(contacts, sounds.float(), float(sample_rate), names, directions=directions)


def sample_contacts(plate: Plate, count: int, *, generator: torch.Generator) -> Float64[Tensor, "contacts 3"]:
    """Draw contacts evenly from the plate without a margin of a twentieth of each side, where all modes fall silent."""
    return _on_plate(plate, 0.05 + 0.9 * torch.rand(count, 2, dtype=torch.float64, generator=generator))


def plate_surface_points(plate: Plate, count: int) -> Float64[Tensor, "points 3"]:
    """Return at most `count` points in rows and columns of one spacing that cover the plate, its edges left out."""
    along = max(1, math.floor(math.sqrt(count * plate.length / plate.width)))
    across = max(1, count // along)
    sides = [(torch.arange(number, dtype=torch.float64) + 0.5) / number for number in (along, across)]
    return _on_plate(plate, torch.cartesian_prod(*sides).reshape(-1, 2))


def _on_plate(plate: Plate, fractions: Float64[Tensor, "points 2"]) -> Float64[Tensor, "points 3"]:
    return fractions @ torch.tensor([[plate.length, 0.0, 0.0], [0.0, plate.width, 0.0]], dtype=torch.float64)
