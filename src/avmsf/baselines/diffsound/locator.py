"""Localization by DiffSound: gains simulated at points of the mesh against those in a recording.

As Li et al. compare with it: the gain of every mode at every vertex of the object's mesh, and the cosine distance.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.baselines.diffsound.renderer import DiffSound
from avmsf.errors import LocationError
from avmsf.localization.cosine_distance import cosine_distance
from avmsf.modal.extraction.least_squares import fit_gains


@dataclass(frozen=True, eq=False)
class DiffSoundLocator:
    """Simulated gains at candidate points."""

    renderer: DiffSound
    points: Float64[Tensor, "points 3"]
    """Object frame, meters."""
    gains: Float64[Tensor, "points modes"]

    @classmethod
    def of(
        cls,
        renderer: DiffSound,
        points: Float[Tensor, "points 3"],
        *,
        directions: Float[Tensor, "points 3"] | None = None,
    ) -> "DiffSoundLocator":
        """Return the locator over points, struck along `directions` (unit vectors) or straight into the surface."""
        places = points.detach().cpu().double()
        gains = renderer.gains(places, directions=directions)
        return cls(renderer, places, gains)

    def distance(self, sound: Float[Tensor, " samples"]) -> Float64[Tensor, " points"]:
        """Return the cosine distance of each point's gains from a sound's, 0 to 1 (see `cosine_distance`).

        The sound starts about at its onset and has the renderer's sample rate. Raises LocationError where it is silent
        or not finite.
        """
        heard = sound.detach().cpu()[: self.renderer.samples].double()
        if not bool(torch.isfinite(heard).all()) or not bool(heard.any()):
            raise LocationError(
                "sound: expected finite samples that are not all 0, got others; record the impact again", name="sound"
            )
        sine, cosine = fit_gains(heard[None], self.renderer.bank, sample_rate=self.renderer.sample_rate)
        return cosine_distance(
            self.gains.to(torch.complex64), torch.complex(sine[0], cosine[0]), self.renderer.bank.frequency
        )

    def place(self, sound: Float[Tensor, " samples"]) -> Float64[Tensor, " 3"]:
        """Return the point of the least distance, meters."""
        return self.points[int(self.distance(sound).argmin())]
