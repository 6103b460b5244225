"""Which way of spreading gains suits an object, decided on its training contacts alone."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.errors import AvmsfError, FitError
from avmsf.field.losses import spectral_loss, spectral_target
from avmsf.field.recipes import SHARED, Attention, GainCase, GainRecipe, ThinPlate
from avmsf.field.training import Targets, TrainingRun
from avmsf.modal.synthesis import synthesise_phased
from avmsf.scene.points import farthest_points

FEWEST = 4
"""Training contacts below which there is nothing to decide on."""
FOLDS = 8
"""Most parts that the training contacts are left out in; up to as many contacts each is left out alone."""


@dataclass(frozen=True, eq=False)
class Choice:
    """One of several recipes, and how it came to be chosen."""

    recipe: GainRecipe
    report: dict[str, Any]
    """Under `choice`: each recipe's error at contacts left out in turn, and why those without one have none."""


@dataclass(frozen=True, eq=False)
class Automatic:
    """Leaves training contacts out in turn and takes the recipe that foretells them best."""

    candidates: tuple[GainRecipe, ...] = (Attention(), ThinPlate())
    """Recipes to choose from, the first where there are too few contacts to choose by."""
    unavailable: Mapping[str, str] = field(default_factory=dict)
    """Recipes that could not be had, and why: for the report."""
    tell: Callable[[str], None] | None = None
    """Told, in words, what is tried."""

    def choose(self, case: GainCase) -> Choice:
        """Return the recipe of the least relative STFT error, mean over contacts left out.

        The modes are those of all training recordings; dampings are shared, and nothing is trained end to end, for this
        changes little in what a place tells of its gains. A recipe that cannot be had says why in the report, and takes
        no part. Raises what the first candidate raises where none can be had.
        """
        missing = dict(self.unavailable)
        if len(case.train) < FEWEST or len(self.candidates) == 1:
            for recipe in self.candidates:
                try:
                    recipe.start(case, SHARED)
                except AvmsfError as error:
                    missing[recipe.name] = str(error)
                    continue
                return Choice(recipe, {"choice": {"errors": {}, "missing": missing}})
            return Choice(self.candidates[0], {"choice": {"errors": {}, "missing": missing}})
        errors: dict[str, float] = {}
        # What has to be learnt step by step comes last, and is given up where it is beaten anyway.
        for recipe in sorted(self.candidates, key=lambda each: each.warms_up):
            try:
                errors[recipe.name] = self._error(recipe, case, least=min(errors.values(), default=math.inf))
            except AvmsfError as error:
                missing[recipe.name] = str(error)
        report = {"choice": {"errors": errors, "missing": missing}}
        if not errors:
            return Choice(self.candidates[0], report)
        best = min(self.candidates, key=lambda each: errors.get(each.name, float("inf")))
        return Choice(best, report)

    def _error(self, recipe: GainRecipe, case: GainCase, *, least: float) -> float:
        """Return a recipe's mean error at contacts left out in turn; no error is relative to a silent recording.

        Raises FitError for a network without a warm-up, for an error that is not finite, and as soon as what is left
        out could be foretold without any error and the mean would still be larger than `least`.
        """
        if recipe.warms_up and not case.config.warmup_steps:
            raise FitError("not judged: warmup_steps is 0, so its gains would be judged before they are learnt")
        heard = case.train.sounds.abs().amax(1) > 0
        order = farthest_points(case.train.contacts, len(case.train)).tolist()
        parts = [order[first::FOLDS] for first in range(min(FOLDS, len(order)))]
        total = 0.0
        for number, held in enumerate(parts, start=1):
            if self.tell is not None:
                self.tell(f"choice: {recipe.name}, {number} of {len(parts)}")
            learnt = [row for row in range(len(order)) if row not in held]
            total += float(_errors(recipe, case, learnt, held)[heard[held]].sum())
            if recipe.warms_up and total / int(heard.sum()) > least and number < len(parts):
                raise FitError(
                    f"given up after {number} of {len(parts)} parts: its error is {total / int(heard.sum()):.3g} or "
                    "more, larger than another's"
                )
        error = total / int(heard.sum())
        if not math.isfinite(error):
            raise FitError(f"its error at contacts left out is {error}: lower warmup_rate")
        return error


def _errors(recipe: GainRecipe, case: GainCase, learnt: list[int], held: list[int]) -> Float[Tensor, " contacts"]:
    """Return the relative STFT errors at the contacts held out."""
    part, config = case.take(learnt), case.config
    gains = recipe.start(part, SHARED)
    if recipe.warms_up:
        run = TrainingRun(
            gains,
            part.modes,
            gains=part.gains * part.signs[:, None],
            phase=case.phase,
            sample_rate=case.train.sample_rate,
            samples=case.train.sounds.shape[1],
            config=replace(config, steps=max(1, config.steps)),
        )
        targets = Targets.of(part.train, part.gains * part.signs[:, None], recipe.rows(part), config)
        for _ in range(config.warmup_steps):
            run.advance(targets)
    bank, others = case.modes.bank, case.train.take(held)
    with torch.no_grad():
        known = gains.finished(torch.arange(len(bank))).at(others.contacts, others.directions)
        sounds = synthesise_phased(
            known.mean.float(),
            bank.frequency,
            bank.damping,
            case.phase,
            samples=others.sounds.shape[1],
            sample_rate=others.sample_rate,
            quadrature=known.quadrature,
        )
        sizes, hops, _ = config.resolutions(others.sample_rate)
        errors = []
        for sound, heard in zip(sounds[:, None], others.sounds[:, None], strict=True):
            target = spectral_target(heard, fft_sizes=sizes, hops=hops)
            errors.append(spectral_loss(sound, target) / len(sizes))
    return torch.stack(errors)
