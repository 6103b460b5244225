"""What a method gets, and what it makes: training data of one object, and a renderer."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Complex, Float
from torch import Tensor

from avmsf.baselines.diffsound.body_family import BodyFamily
from avmsf.capture.impacts import Impacts
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import EvaluationError
from avmsf.evaluation.registry import VisualInput
from avmsf.features.feature_field import FeatureField
from avmsf.fem.candidate_bodies import CandidateBodies
from avmsf.field.sound_field import SoundField
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.modal.extraction.extract import Extraction
from avmsf.symmetry.symmetries import Symmetries

Contacts = Float[Tensor, "contacts 3"]
"""Points in the object frame, meters; or as directions, unit vectors."""
Sounds = Float[Tensor, "contacts samples"]
Amplitudes = Complex[Tensor, "contacts modes"]


@runtime_checkable
class Renderer(Protocol):
    """A fitted field, a baseline or a simulation of one object.

    The sound of a contact depends on nothing else: not on the other contacts of a call, not on calls before.
    """

    @property
    def sample_rate(self) -> float:
        """Samples per second of the rendered sounds, Hz."""

    def render(self, contacts: Contacts, *, directions: Contacts | None = None) -> Sounds:
        """Return the sound of an impact at each contact (object frame, meters), in the unit of the training sounds.

        `directions`, unit vectors along which the hammer moves, are for renderers that use them.
        """


def expect_renderer(given: Any) -> Renderer:
    """Return `given`, or raise EvaluationError that says what a renderer has unless it is one."""
    kind = given if isinstance(given, type) else type(given)
    fault, advice = "the class itself", "make an object of it, or give the training recordings as `train`"
    if given is not kind:
        fault, advice = "", ""
        try:
            if not isinstance(given.sample_rate, int | float | np.number):
                fault = f"one whose `sample_rate` is a {type(given.sample_rate).__name__}"
            inspect.signature(given.render).bind(None, directions=None)
        except (AttributeError, TypeError) as error:
            fault = str(error)
        except ValueError:  # a compiled method has no signature to look at
            pass
    if not fault:
        renderer: Renderer = given
        return renderer
    wanted = (
        "an object with a number `sample_rate` (Hz) and a method `render(self, contacts, *, directions=None)` that "
        "returns sounds [contacts, samples]"
    )
    got = f"{kind.__name__}: {fault}"
    raise EvaluationError.expected(wanted, kind.__name__, got=got, name="renderer", advice=advice)


def report_of(renderer: Renderer) -> dict[str, Any]:
    """Return what a method chose on its way to a renderer, as plain values; empty where it had no choice."""
    return dict(getattr(getattr(renderer, "origin", renderer), "report", {}))


@dataclass(frozen=True, eq=False)
class Task:
    """One object and one choice of training contacts.

    Slow inputs are cached functions, so that methods that do not use them take no time for them.
    """

    name: str
    """Name of the object, in messages and as the folder of other systems' sounds."""
    train: Impacts
    """The training recordings."""
    contacts: Contacts
    """Contacts of all recordings of the object, training and test, meters."""
    names: tuple[str, ...]
    """Names of their recordings, row for row."""
    seed: int
    """Random seed of the method."""
    modes: Callable[[], Extraction]
    """Extracts the modes of `train`, row for row."""
    features: Callable[[VisualInput], FeatureField]
    """Computes the features of the object's points. Raises SceneError without visual input."""
    bodies: Callable[[], CandidateBodies]
    """Computes the candidate FE models of the object. Raises AvmsfError where its shape is unknown or unfit."""
    symmetries: Callable[[], Symmetries | None]
    """Finds the symmetries of the object's shape; None where nothing shows it."""
    settings: CaptureSettings
    """Of the capture that the recordings are of."""
    other_recording: Callable[[], Float[Tensor, " samples"]]
    """Draws, by `seed`, the recording of another object, at the sample rate and of the length of `train`. Raises
    EvaluationError where there is no other object."""
    family: Callable[[], BodyFamily]
    """Computes the FE models of the object's surface, of any material. Raises AvmsfError likewise."""
    gaussians: Callable[[], GaussianCloud]
    """Fits Gaussians to the object's views. Raises AvmsfError without views."""
    field: Callable[[str], SoundField]
    """Fits the field of the method with that name to the case's recordings, once for all methods. Raises AvmsfError."""
    material: str | None = None
    """Material of the object in the dataset, in lower case; None where it is unknown."""
    device: str | None = None
    """Device to train on; None for a GPU where there is one."""


@runtime_checkable
class Method(Protocol):
    """A method that predicts an object's sounds from its training recordings."""

    @property
    def name(self) -> str:
        """Name in tables and on the command line, joined by hyphens."""

    def fit(self, task: Task) -> Renderer:
        """Fit a renderer to the task's training recordings. Raises AvmsfError where it cannot."""
