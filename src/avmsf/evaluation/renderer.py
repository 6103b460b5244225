"""Whatever turns contacts into sounds, and can therefore be evaluated."""

import inspect
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from torch import Tensor

from avmsf.errors import EvaluationError

_WANTED = (
    "an object with a number `sample_rate` (Hz) and a method `render(self, contacts, *, directions=None)` that returns "
    "sounds [contacts, samples]"
)


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


def expect_renderer(given: Any) -> Renderer:
    """Return `given`, or raise EvaluationError that says what a renderer has unless it is one."""
    fault = advice = ""
    rate: Any = getattr(given, "sample_rate", None)
    if isinstance(given, type):
        fault = f"the class {given.__name__}"
        advice = "make an object of it, or give the training recordings as `train`"
    elif not isinstance(given, Renderer):
        lacking = [f"`{each}`" for each in ("sample_rate", "render") if not hasattr(given, each)]
        fault = f"{type(given).__name__} without {' and '.join(lacking)}"
    elif not isinstance(rate, int | float | np.number):
        fault = f"{type(given).__name__} whose `sample_rate` is a {type(rate).__name__}"
    else:
        try:
            inspect.signature(given.render).bind(None, directions=None)
        except ValueError:  # a compiled method has no signature to look at
            pass
        except TypeError as error:
            fault = f"{type(given).__name__} whose `render` does not take these arguments ({error})"
    if fault:
        kind = given if isinstance(given, type) else type(given)
        raise EvaluationError.expected(_WANTED, kind.__name__, got=fault, name="renderer", advice=advice)
    renderer: Renderer = given
    return renderer
