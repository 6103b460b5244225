"""The protocol of editing: transitions between materials, their prompts, and single edits."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from avmsf.editing.reference import Reference
from avmsf.errors import EvaluationError
from avmsf.evaluation.editing_objects import KnownObject

_LISTENED = 8
"""Contacts at which an edited object is rendered."""
PROMPTS: Mapping[str, tuple[str, str]] = {
    "wood": ("a single knock on a wooden object, short and dull", "tapping a hollow wooden bowl with a mallet"),
    "glass": ("a single tap on a wine glass, clear and bright", "a glass bottle is struck once and rings"),
    "metal": ("a single strike on a metal object, ringing for long", "a hammer hits a metal pan once"),
    "steel": ("a single strike on a steel object, ringing for long", "a hammer hits a steel pipe once"),
    "iron": ("a single strike on a cast iron object, heavy and ringing", "a hammer hits an iron skillet once"),
    "plastic": ("a single knock on a plastic object, light and dull", "tapping a hollow plastic bowl with a stick"),
    "polycarbonate": (
        "a single knock on a hard polycarbonate object, short and dry",
        "tapping a polycarbonate box with a stick",
    ),
    "ceramic": ("a single tap on a ceramic cup, a short bright clink", "a porcelain bowl is struck once with a stick"),
}
"""Two prompts for each target material. The paper has two a transition and prints none: these are ours."""


@dataclass(frozen=True)
class Transition:
    """From one material to another."""

    source: str
    target: str

    @property
    def prompts(self) -> tuple[str, str]:
        """Prompts for the target. Raises EvaluationError for a material without prompts."""
        if self.target not in PROMPTS:
            raise EvaluationError(
                f"expected a target with prompts, {', '.join(PROMPTS)}, got {self.target!r}",
                name="target",
                value=self.target,
            )
        return PROMPTS[self.target]


RECORDED_TRANSITIONS = (
    Transition("ceramic", "wood"),
    Transition("wood", "ceramic"),
    Transition("wood", "glass"),
    Transition("glass", "metal"),
)
"""Contrasting pairs for the 26 objects. The paper shows the first two and calls the others contrastive: ours."""
SIMULATED_TRANSITIONS = (Transition("ceramic", "wood"), Transition("glass", "steel"), Transition("wood", "glass"))
"""Those that are evaluated with recordings as target and several seeds."""
_RING = ("ceramic", "wood", "glass", "steel", "plastic", "iron", "polycarbonate")
SEVEN_TRANSITIONS = tuple(Transition(*pair) for pair in zip(_RING, (*_RING[1:], _RING[0]), strict=True))
"""Every one of the seven simulated materials is left once and reached once, by a neighbor that it contrasts with."""


@dataclass(frozen=True, eq=False)
class EditTask:
    """One requested edit."""

    object: KnownObject
    target: str
    """Material."""
    prompt: str | None = None
    """Text prompt, for methods that use it."""
    reference: Reference | None = None
    """Target sounds, for methods that use them; the spectral distance is computed to them."""
    seed: int = 0

    @property
    def contacts(self) -> Float[Tensor, "contacts 3"]:
        """Contacts of the rendered sounds."""
        return self.object.impacts.contacts[:_LISTENED]

    def words(self) -> str:
        """Return the prompt. Raises EvaluationError where there is none."""
        if self.prompt is None:
            raise EvaluationError.expected(
                f"one for {self.object.name} to {self.target}", name="prompt", advice="give the task one"
            )
        return self.prompt


def prompted_tasks(
    objects: Sequence[KnownObject], transitions: Sequence[Transition], *, seed: int = 0
) -> tuple[EditTask, ...]:
    """Return every object of a transition's source material, with each of the two prompts."""
    return tuple(
        EditTask(each, transition.target, prompt=prompt, seed=seed)
        for transition in transitions
        for each in objects
        if each.material == transition.source
        for prompt in transition.prompts
    )
