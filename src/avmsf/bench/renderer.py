"""Whatever turns contacts into sounds, and can therefore be evaluated."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor


@runtime_checkable
class Renderer(Protocol):
    """A fitted field, a baseline or a simulation of one object.

    The sound of a contact depends on nothing else: not on the other contacts of a call, not on calls before.
    """

    @property
    def sample_rate(self) -> float:
        """Samples per second of the rendered sounds, Hz."""
        ...

    def render(
        self, contacts: Float[Tensor, "contacts 3"], *, directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts samples"]:
        """Return the sound of a blow at each contact (object frame, meters), in the unit of the training sounds.

        `directions`, unit vectors along which the hammer moves, are for those to heed who know of directions.
        """
        ...
