"""A body that can be struck anywhere: its damped modes, and what a microphone hears of each for any blow."""

from dataclasses import dataclass

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from avmsf.fem.damping import Vibration
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.simulate.hammer import contact_times, peak_forces, pulse_spectrum
from avmsf.simulate.recipe import Hammer


@dataclass(frozen=True, eq=False)
class SoundingBody:
    """Elastic modes, how they die away, and how they are heard."""

    elastic: ElasticModes
    vibration: Vibration
    heard: Complex128[Tensor, " modes"]
    """Pressure of each damped mode for a push of one newton second on it alone, pascals."""
    hammer: Hammer
    delay: float = 0.0
    """Time that sound takes from the nearest point of the surface to the microphone, seconds."""

    def gains(
        self,
        places: Float64[Tensor, "contacts 3"],
        directions: Float64[Tensor, "contacts 3"],
        *,
        speeds: Float64[Tensor, " contacts"] | None = None,
        contact_times: Float64[Tensor, " contacts"] | None = None,
    ) -> Complex128[Tensor, "contacts modes"]:
        """Return amplitudes A, pascals per newton of peak force: a blow sounds as the real part of A exp(pole t).

        `places` are taken to the nearest points of the surface; `directions` are unit vectors; `speeds` are relative
        to the hammer's and `contact_times` to those of these speeds, 1 without them. Time counts from when the sound of
        the hammer's first touch arrives at the microphone, and the sound is the one that goes on once the hammer has
        left, continued back to that moment.
        """
        times = self.times(self._speeds(places, speeds))
        if contact_times is not None:
            times = contact_times * times
        pushed = self.elastic.gains(places, directions).to(torch.complex128) @ self.vibration.pushes.T
        return 2.0 * pushed * self.heard * pulse_spectrum(self.hammer, self.vibration.poles, times)

    def times(self, speeds: Float64[Tensor, " contacts"]) -> Float64[Tensor, " contacts"]:
        """Return how long the hammer stays on the body, seconds, for speeds in m/s."""
        return contact_times(self.hammer, self.elastic.material, mass=self.elastic.mass, speeds=speeds)

    def forces(
        self, speeds: Float64[Tensor, " contacts"], contact_times: Float64[Tensor, " contacts"] | None = None
    ) -> Float64[Tensor, " contacts"]:
        """Return the peak force of blows of these relative speeds and contact times, newtons."""
        speeds = self.hammer.speed * speeds
        times = self.times(speeds) if contact_times is None else contact_times * self.times(speeds)
        return peak_forces(self.hammer, mass=self.elastic.mass, speeds=speeds, times=times)

    def _speeds(
        self, places: Float64[Tensor, "contacts 3"], speeds: Float64[Tensor, " contacts"] | None
    ) -> Float64[Tensor, " contacts"]:
        relative = torch.ones(len(places), dtype=torch.float64) if speeds is None else speeds
        return self.hammer.speed * relative
