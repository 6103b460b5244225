"""Guided editing: a field's modes are optimized towards a guide's target sounds, with one edit for all contacts."""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf._utils.caching import content_digest, source_digest
from avmsf._utils.checkpoint import Checkpoint
from avmsf.editing.config import GuidedEditConfig
from avmsf.editing.modal_edit import FieldAtContacts, ModalEdit
from avmsf.errors import EditError
from avmsf.field.losses import spectral_loss, spectral_target
from avmsf.field.sound_field import SoundField
from avmsf.mesh.points import farthest_points
from avmsf.modal.config import scaled_fft_size
from avmsf.modal.spectra import Sounds, level

_DEVIATIONS = {"shift": 0.05, "damping_shift": 0.3, "scale": 1.0}
"""Standard deviations of what single modes have of their own, logarithms: of frequencies, almost a semitone; of
dampings; and of gain factors, without the common level."""


@dataclass(frozen=True)
class Parameterization:
    """What of an edit moves, and how fast.

    The penalty on a quantity of single modes is half the mean square over modes of its value over its standard
    deviation (.05 of shift, .3 of damping_shift, 1 of scale), times `stiffness`, in the unit of the loss, which is a
    relative error.
    """

    name: str
    """Name in the edit's report."""
    rates: Mapping[str, float]
    """Adam's, by quantities of `ModalEdit`, in logarithms a step, falling to a twentieth; others stay as they are."""
    stiffness: float
    """Weight of the penalty on single modes."""
    searches: bool = True
    """Whether the guide proposes the initial edit; otherwise the unedited object."""
    gains_follow: bool = False
    """Whether gains of a mode from f1 to f2 Hz are multiplied by f1 / f2 when the edit ends (paper, section 3.6)."""


_OWN_RATES = {"shift": 0.003, "damping_shift": 0.01, "scale": 0.02}
HIERARCHICAL = Parameterization("hierarchical", {"pitch": 0.02, "damping": 0.02, **_OWN_RATES}, 0.05)
"""The paper's factor on all frequencies, and ours: one on all dampings, penalties on single modes, a search first."""
PUBLISHED = Parameterization("published", {"pitch": 0.02, **_OWN_RATES}, 0.0, searches=False, gains_follow=True)
"""The paper's: f = exp(log alpha + log f0 + delta), dampings and gains of single modes, no penalty.

The rates, which the paper does not state, are those of `HIERARCHICAL`.
"""
INDEPENDENT = Parameterization("independent", dict.fromkeys(_DEVIATIONS, 0.02), 0.0, searches=False)
"""The paper's baseline, after Audio-SDS: independent frequencies, dampings and gains, no common factors.

The rates are this package's, those of the common factors above; Audio-SDS states .05 for its parameters.
"""
SEARCHED = replace(INDEPENDENT, name="searched", searches=True)
"""Independent modes, initialized by the search for common factors: what remains is the effect of the hierarchy."""

PARAMETERIZATIONS = {each.name: each for each in (HIERARCHICAL, PUBLISHED, INDEPENDENT, SEARCHED)}
"""All of them, by name."""


_MAX_PROBES = 16
"""Contacts, far apart, for the strongest modes, the start and the level."""
_MAX_POINTS = 2000
"""Maximum number of points of the surface that are used as contacts."""
_MAX_FAILED_STEPS = 20
"""Consecutive steps without a finite target after which the edit ends with an error."""


@runtime_checkable
class Guide(Protocol):
    """Gives target sounds."""

    @property
    def sample_rate(self) -> float:
        """Sample rate of the sounds that it takes and returns, Hz."""

    def describe(self) -> dict[str, Any]:
        """Return its identifying settings, as plain values, for the edit's report and checkpoint."""

    def start(self, rendered: FieldAtContacts) -> ModalEdit:
        """Return the initial edit, given the field at contacts far apart."""

    def targets(self, sounds: Sounds, step: int, generator: torch.Generator) -> Sounds:
        """Return the targets of rendered sounds, row for row, at their level.

        A row with a sample that is not finite is left out of the step.
        """


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


CLAP = "clap"
"""The key of the previews' scores in an edit's report: `model`, `steps`, of which 0 is before it, and `scores`."""


@dataclass(frozen=True, eq=False)
class PreviewScore:
    """A network's score of the previews of an edit."""

    of: Callable[[Float[Tensor, " samples"]], float]
    """Returns that of a sound at the field's rate."""
    network: str
    """Its name in the report."""
    digest: str
    """Of its weights: scores by others are not mixed."""


@torch.enable_grad()
def edit_towards(
    field: SoundField,
    guide: Guide,
    *,
    config: GuidedEditConfig | None = None,
    parameters: Parameterization = HIERARCHICAL,
    progress: Callable[[GuidedEditProgress], None] | None = None,
    score: PreviewScore | None = None,
    checkpoint: str | Path | None = None,
) -> SoundField:
    """Return the field with its modes optimized towards the targets of `guide`; gain ratios between contacts stay.

    Each step renders random contacts, compares the sounds with the guide's targets by the multi-scale spectral loss of
    fitting, and updates the free `parameters`. The level is not edited: the sounds compared, and the field returned,
    have the level of the given one. The `score` of the field before and of all previews, but for silence, goes to the
    edit's report. With `checkpoint`, the state is stored there while the edit runs, on interruption and at the end, and
    an edit with the same arguments continues from it to the same result. Raises `EditError` for a field that is silent,
    for a guide at another rate, for a checkpoint of another edit, and where the guide's targets or the loss are not
    finite.
    """
    config = GuidedEditConfig() if config is None else config
    return _Optimization(field, guide, config, parameters, score, checkpoint).finish(progress)


class _Optimization:
    """The state of an edit."""

    def __init__(
        self,
        field: SoundField,
        guide: Guide,
        config: GuidedEditConfig,
        parameters: Parameterization,
        score: PreviewScore | None,
        checkpoint: str | Path | None,
    ) -> None:
        if guide.sample_rate != field.sample_rate:
            raise EditError.expected(f"the field's {field.sample_rate:g} Hz", guide.sample_rate, name="sample_rate")
        self.field, self.guide, self.config, self.parameters, self.score = field, guide, config, parameters, score
        points = field.gain_field.points
        self.points = points if len(points) <= _MAX_POINTS else points[farthest_points(points, _MAX_POINTS)]
        probes = self.points[farthest_points(self.points, min(len(self.points), _MAX_PROBES))]
        self.probes = self._at(probes)
        sounds = self.probes.sounds()
        if not bool(torch.isfinite(sounds).all()) or float(sounds.abs().max()) == 0.0:
            got = "silence at all contacts"
            raise EditError.expected("audible modes", 0.0, got=got, name="field", advice="fit it again")
        self.loudness = level(sounds, sample_rate=field.sample_rate)
        self.loudest_point = probes[int(self.loudness.argmax())]
        self.sizes = [scaled_fft_size(size, sample_rate=field.sample_rate) for size in config.fft_sizes]
        self.settings = {**guide.describe(), "parameters": parameters.name, **asdict(config)}
        self.step, self.failed = 0, 0
        self.consistent = True
        """False while parameters are being moved: an interruption then leaves a state that nothing can go on from."""
        self.checkpoint = Checkpoint(checkpoint, self._identity(), what="the edit", raising=EditError)
        state = self.checkpoint.read()
        self.scores: dict[int, float] = {} if state is None else state["scores"]
        searching = state is None and parameters.searches
        start = guide.start(self.probes) if searching else ModalEdit.none(self.field.bank)
        self.edited = self.probes.loudest(config.free_modes)
        """The modes that move by themselves; the others follow the common factors alone."""
        self.values = {name: each.detach().clone() for name, each in vars(start).items()}
        self.optimizer = self._optimizer()
        if state is not None:
            with torch.no_grad():
                for name, value in self.values.items():
                    value.copy_(state["variables"]["values"][name])
            self.optimizer.load_state_dict(state["variables"]["optimizer"])
            self.step, self.failed = state["step"], state["failed"]

    def _identity(self) -> dict[str, str]:
        """Return a digest of each thing that decides the result, by what errors call it."""
        field, settings = self.field, {**asdict(self.config), **asdict(self.parameters)}
        # The interval of previews does not change the result.
        del settings["preview_every"]
        tensors = {f"bank.{name}": each for name, each in vars(field.bank).items()} | vars(self.probes.known)
        content = content_digest(*tensors, *tensors.values(), field.phase, field.gain_field.points)
        made_by = [version("avmsf"), source_digest("avmsf.editing.guided")]
        values = {"field": [field.sample_rate, field.samples, content], "guide": self.guide.describe()}
        values |= {"settings": settings, "version of avmsf": made_by}
        identity = {name: content_digest(name, each) for name, each in values.items()}
        return identity if self.score is None else identity | {"network": self.score.digest}

    def _optimizer(self) -> torch.optim.Adam:
        """Return an optimizer of the values; those without a rate stay where they begin."""
        own = torch.zeros(len(self.field.bank), dtype=torch.bool).index_fill(0, self.edited, True)
        groups = []
        for name, rate in self.parameters.rates.items():
            value = self.values[name].requires_grad_()
            groups.append({"params": [value], "lr": rate, "rate": rate})
            if value.ndim:
                value.register_hook(lambda gradient: torch.where(own, gradient, 0.0))
        # Targets change from step to step: a long memory of the gradient's square would brake what chance once pushed.
        return torch.optim.Adam(groups, betas=(0.9, 0.99))

    def finish(self, progress: Callable[[GuidedEditProgress], None] | None) -> SoundField:
        """Take the steps that are left and return the edited field."""
        try:
            while self.step < self.config.steps:
                loss = self._take_step()
                edit, every, preview = ModalEdit(**self.values), self.config.preview_every, None
                watched = every > 0 and (progress is not None or self.score is not None)
                if watched and (self.step % every == 0 or self.step == self.config.steps):
                    preview = self._preview(self._normalized_edit().of(self.field))
                    if self.score is not None:
                        # The field before the edit is scored with the first preview.
                        sounds = ({} if self.scores else {0: self._preview(self.field)}) | {self.step: preview}
                        self.scores |= {step: self.score.of(sound) for step, sound in sounds.items() if sound.any()}
                if progress is not None:
                    factors = edit.pitch_factor, edit.decay_factor
                    progress(GuidedEditProgress(self.step, self.config.steps, loss, *factors, preview))
                if self.checkpoint.due:
                    self._save()
        except KeyboardInterrupt:
            # Amid a step's changes there is nothing to keep but what was saved before.
            if self.consistent:
                self._save()
            raise
        self._save()
        if self.score is not None:
            record = {"model": self.score.network, "steps": [*self.scores], "scores": [*self.scores.values()]}
            self.settings[CLAP] = record
        return self._normalized_edit().of(self.field, settings=self.settings)

    def _take_step(self) -> float:
        """Take one step and return the loss before it."""
        # All chance of a step hangs on its number, so that an edit goes on as if it had never been interrupted.
        generator = torch.Generator().manual_seed(self.config.seed * 1_000_003 + self.step)
        rows = torch.randperm(len(self.points), generator=generator)[: self.config.contacts_per_step]
        rendered = self._at(self.points[rows])
        before = level(rendered.sounds(), sample_rate=self.field.sample_rate)
        sounds = rendered.sounds(ModalEdit(**self.values))
        after = level(sounds, sample_rate=self.field.sample_rate)
        sounds = sounds * (before.square().sum() / after.square().sum()).sqrt()
        with torch.no_grad():
            targets = self.guide.targets(sounds.detach(), self.step, generator).to(sounds)
        usable = torch.isfinite(targets).all(dim=1)
        loss = math.nan
        if bool(usable.any()):
            loss = self._update(sounds[usable], targets[usable])
            self.failed = 0
        else:
            self.failed += 1
            if self.failed >= _MAX_FAILED_STEPS:
                got = f"NaN or inf in {self.failed} consecutive steps"
                advice = "lower the guidance, or compute in float32"
                raise EditError.expected("finite sounds", self.failed, got=got, name="targets", advice=advice)
        self.step += 1
        self.consistent = True
        return loss

    def _update(self, sounds: Sounds, targets: Sounds) -> float:
        target = spectral_target(targets, fft_sizes=self.sizes, hops=[size // 4 for size in self.sizes])
        error = spectral_loss(sounds, target) / len(self.sizes)
        self.optimizer.zero_grad()
        torch.autograd.backward(error + self._penalty())
        gradients = [value.grad for value in self.values.values() if value.grad is not None]
        if not all(bool(torch.isfinite(each).all()) for each in (error, *gradients)):
            wanted, advice = "a finite value and gradient", "lower the learning rates"
            raise EditError.expected(wanted, float(error), row=self.step, name="loss", advice=advice)
        self.consistent = False
        for group in self.optimizer.param_groups:
            group["lr"] = group["rate"] * (0.525 + 0.475 * math.cos(math.pi * self.step / self.config.steps))
        self.optimizer.step()
        return float(error.detach())

    def _penalty(self) -> Float64[Tensor, ""]:
        """Return the penalty on single modes, in the unit of the loss."""
        own = {name: self.values[name][self.edited] for name in _DEVIATIONS}
        own["scale"] = own["scale"] - own["scale"].mean()
        parts = [(own[name] / deviation).square().mean() for name, deviation in _DEVIATIONS.items()]
        return 0.5 * self.parameters.stiffness * torch.stack(parts).sum()

    def _preview(self, field: SoundField) -> Float[Tensor, " samples"]:
        """Return a field's sound, noise and all, where the unedited one is loudest."""
        return field.render(self.loudest_point[None])[0]

    def _normalized_edit(self) -> ModalEdit:
        """Return the edit as it stands, as loud at the probes as the field was."""
        with torch.no_grad():
            edit = ModalEdit(**self.values)
            if self.parameters.gains_follow:
                edit = edit.following(self.probes.field.bank)
            after = level(self.probes.sounds(edit), sample_rate=self.field.sample_rate)
            factor = (self.loudness.square().sum() / after.square().sum()).sqrt()
            return replace(edit, scale=edit.scale + factor.double().log())

    def _at(self, contacts: Float[Tensor, "contacts 3"]) -> FieldAtContacts:
        seconds = self.config.seconds
        samples = self.field.samples if seconds is None else round(seconds * self.field.sample_rate)
        return FieldAtContacts(self.field, self.field.known(contacts), max(1, samples))

    def _save(self) -> None:
        values = {name: value.detach() for name, value in self.values.items()}
        variables = {"values": values, "optimizer": self.optimizer.state_dict()}
        self.checkpoint.save({"variables": variables, "step": self.step, "failed": self.failed, "scores": self.scores})
