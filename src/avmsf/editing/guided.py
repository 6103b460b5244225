"""Guided editing: a field's modes are optimized towards a guide's target sounds, with one edit for all contacts."""

import math
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.state import read_checkpoint, write_checkpoint
from avmsf.editing.clips import level
from avmsf.editing.config import GuidedEditConfig
from avmsf.editing.guided_checkpoint import asked
from avmsf.editing.modal_edit import ModalEdit, Struck
from avmsf.editing.parameters import HIERARCHICAL, EditVariables, Parameterization
from avmsf.errors import AvmsfWarning, EditError
from avmsf.field.losses import spectral_loss, spectral_target
from avmsf.field.sound_field import SoundField
from avmsf.gaussians.points import farthest_points
from avmsf.modal.config import scaled_fft_size

_PROBES = 16
"""Contacts, far apart, for the strongest modes, the start and the level."""
_LISTENED = 2000
"""Maximum number of points of the surface that are used as contacts."""
_SPOILT = 20
"""Consecutive steps without a finite target after which the edit ends with an error."""
_CHECKPOINT_SECONDS = 30.0


@runtime_checkable
class Guide(Protocol):
    """Gives target sounds."""

    @property
    def sample_rate(self) -> float:
        """Sample rate of the sounds that it takes and returns, Hz."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return its identifying settings, as plain values, for the edit's report and checkpoint."""
        ...

    def start(self, struck: Struck) -> ModalEdit:
        """Return the initial edit, given the field at contacts far apart."""
        ...

    def targets(
        self, sounds: Float[Tensor, "contacts samples"], step: int, generator: torch.Generator
    ) -> Float[Tensor, "contacts samples"]:
        """Return the targets of rendered sounds, row for row, at their level.

        A row with a sample that is not finite is left out of the step.
        """
        ...


@dataclass(frozen=True, eq=False)
class GuidedEditProgress:
    """Progress of an edit."""

    step: int
    """Number of finished steps."""
    steps: int
    """Number of all steps."""
    loss: float
    """Mean over resolutions of the last step's relative spectral error; NaN where its targets were not finite."""
    pitch: float
    """Present factor on all frequencies."""
    decay: float
    """Present factor on all decay times."""
    preview: Float[Tensor, " samples"] | None
    """The edited field's sound at one contact, at the field's rate, every `preview_every` steps and at the end."""
    place: Float[Tensor, " 3"] | None = None
    """The contact of the preview, object frame, meters."""


def edit_towards(
    field: SoundField,
    guide: Guide,
    *,
    config: GuidedEditConfig | None = None,
    parameters: Parameterization = HIERARCHICAL,
    progress: Callable[[GuidedEditProgress], None] | None = None,
    checkpoint: str | Path | None = None,
    device: torch.device | str = "cpu",
) -> SoundField:
    """Return the field with its modes optimized towards the targets of `guide`; gain ratios between contacts stay.

    Each step renders random contacts, compares the sounds with the guide's targets by the multi-scale spectral loss of
    fitting, and updates the free `parameters`. The level is not edited: the sounds compared, and the field returned,
    have the level of the given one. Rendering and loss run on `device`. With `checkpoint`, the state is stored there
    while the edit runs, on interruption and at the end, and an edit with the same arguments continues from it to the
    same result. Raises `EditError` for a field that is silent, for a guide at another rate, for a checkpoint of another
    edit, and where the guide's targets or the loss are not finite.
    """
    config = GuidedEditConfig() if config is None else config
    run = _Steering(field, guide, config, parameters, None if checkpoint is None else Path(checkpoint), device)
    return run.to_the_end(progress)


class _Steering:
    """The state of an edit."""

    def __init__(
        self,
        field: SoundField,
        guide: Guide,
        config: GuidedEditConfig,
        parameters: Parameterization,
        checkpoint: Path | None,
        device: torch.device | str,
    ) -> None:
        if guide.sample_rate != field.sample_rate:
            raise EditError(
                f"guide: expected the field's sample rate of {field.sample_rate:g} Hz, got {guide.sample_rate:g} Hz",
                name="sample_rate",
                value=guide.sample_rate,
            )
        self.field, self.guide, self.config, self.parameters = field, guide, config, parameters
        self.checkpoint, self.device, self.saved_at = checkpoint, torch.device(device), time.monotonic()
        points = field.gain_field.points
        self.places = (
            points[farthest_points(points, min(len(points), _LISTENED))] if len(points) > _LISTENED else points
        )
        probes = self.places[farthest_points(self.places, min(len(self.places), _PROBES))]
        self.probes = self._struck(probes)
        self.loudness = self._expect_sound()
        self.loudest_place = probes[int(self.loudness.argmax())]
        self.sizes = [scaled_fft_size(size, sample_rate=field.sample_rate) for size in config.fft_sizes]
        self.told = {**guide.describe(), "parameters": parameters.name, **asdict(config)}
        self.step, self.spoilt = 0, 0
        self.whole = True
        """False while parameters are being moved: an interruption then leaves a state that nothing can go on from."""
        settings = {**asdict(config), **asdict(parameters)}
        # The interval of previews does not change the result.
        del settings["preview_every"]
        self.asked = asked(field, probes, guide.describe(), settings)
        state = (
            None if checkpoint is None else read_checkpoint(checkpoint, self.asked, what="an edit", raising=EditError)
        )
        searching = state is None and parameters.searches
        start = guide.start(self.probes) if searching else ModalEdit.none(self.probes.bank)
        self.variables = EditVariables(start, self.probes.loudest(config.free_modes), parameters)
        if state is not None:
            self.variables.resume(state["variables"])
            self.step, self.spoilt = state["step"], state["spoilt"]

    def to_the_end(self, progress: Callable[[GuidedEditProgress], None] | None) -> SoundField:
        """Take the steps that are left and return the edited field."""
        try:
            while self.step < self.config.steps:
                loss = self._advance()
                if progress is not None:
                    edit, every = self.variables.edit(), self.config.preview_every
                    due = every > 0 and (self.step % every == 0 or self.step == self.config.steps)
                    preview = self._preview() if due else None
                    factors, place = (edit.pitch_factor, edit.decay_factor), self.loudest_place if due else None
                    progress(GuidedEditProgress(self.step, self.config.steps, loss, *factors, preview, place))
                if time.monotonic() - self.saved_at > _CHECKPOINT_SECONDS:
                    self._save()
        except KeyboardInterrupt:
            # Amid a step's changes there is nothing to keep but what was saved before.
            if self.whole:
                self._save()
            raise
        self._save()
        return self._levelled().of(self.field, told=self.told)

    def _advance(self) -> float:
        """Take one step and return the loss before it."""
        # All chance of a step hangs on its number, so that an edit goes on as if it had never been interrupted.
        generator = torch.Generator().manual_seed(self.config.seed * 1_000_003 + self.step)
        rows = torch.randperm(len(self.places), generator=generator)[: self.config.contacts_per_step]
        struck = self._struck(self.places[rows])
        before = level(struck.sounds(ModalEdit.none(struck.bank)), sample_rate=struck.sample_rate)
        sounds = struck.sounds(self.variables.edit())
        after = level(sounds, sample_rate=struck.sample_rate)
        sounds = sounds * (before.square().sum() / after.square().sum()).sqrt()
        with torch.no_grad():
            targets = self.guide.targets(sounds.detach(), self.step, generator).to(sounds)
        usable = torch.isfinite(targets).all(dim=1)
        loss = math.nan
        if bool(usable.any()):
            loss = self._descend(sounds[usable], targets[usable])
            self.spoilt = 0
        else:
            self.spoilt += 1
            if self.spoilt >= _SPOILT:
                raise EditError(
                    f"expected finite target sounds, got NaN or inf in {self.spoilt} consecutive steps; lower the "
                    "guidance, or compute in float32",
                    name="targets",
                    value=self.spoilt,
                )
        self.step += 1
        self.whole = True
        return loss

    def _descend(self, sounds: Float[Tensor, "usable samples"], targets: Float[Tensor, "usable samples"]) -> float:
        target = spectral_target(targets, fft_sizes=self.sizes, hops=[size // 4 for size in self.sizes])
        error = spectral_loss(sounds, target) / len(self.sizes)
        if not (self.variables.differentiate(error) and bool(torch.isfinite(error))):
            raise EditError(
                f"step {self.step}: expected a finite loss and gradient, got a loss of {float(error)}; lower the "
                "learning rates",
                row=self.step,
                name="loss",
                value=float(error),
            )
        self.whole = False
        self.variables.move(done=self.step / self.config.steps)
        return float(error.detach())

    def _preview(self) -> Float[Tensor, " samples"]:
        """Return the edited field's sound, noise and all, where the unedited one is loudest."""
        return self._levelled().of(self.field).render(self.loudest_place[None])[0]

    def _levelled(self) -> ModalEdit:
        """Return the edit as it stands, as loud at the probes as the field was."""
        with torch.no_grad():
            edit = self.variables.edit()
            if self.parameters.gains_follow:
                edit = edit.following(self.probes.bank)
            after = level(self.probes.sounds(edit), sample_rate=self.field.sample_rate)
            factor = (self.loudness.square().sum() / after.square().sum()).sqrt()
            return edit.louder(factor).to("cpu")

    def _struck(self, contacts: Float[Tensor, "contacts 3"]) -> Struck:
        seconds = self.config.seconds
        samples = self.field.samples if seconds is None else round(seconds * self.field.sample_rate)
        return Struck.at(self.field, contacts, samples=max(1, samples), device=self.device)

    def _expect_sound(self) -> Float[Tensor, " contacts"]:
        sounds = self.probes.sounds(ModalEdit.none(self.probes.bank))
        if not bool(torch.isfinite(sounds).all()) or float(sounds.abs().max()) == 0.0:
            raise EditError(
                "field: expected audible modes, got silence at all contacts; fit it again", name="field", value=0.0
            )
        return level(sounds, sample_rate=self.field.sample_rate)

    def _save(self) -> None:
        if self.checkpoint is None:
            return
        state = {
            "variables": self.variables.state(),
            "step": self.step,
            "spoilt": self.spoilt,
        }
        try:
            write_checkpoint(self.checkpoint, state, self.asked, raising=EditError)
        except EditError as error:
            # A full disk costs the checkpoint, not the edit.
            warnings.warn(
                AvmsfWarning(f"the edit continues without a checkpoint: {error}", **error.attributes), stacklevel=2
            )
        self.saved_at = time.monotonic()
