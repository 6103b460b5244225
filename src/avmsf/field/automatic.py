"""Which gain model suits an object: the one of the least leave-one-out error on its training contacts."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.errors import AvmsfError
from avmsf.field.losses import spectral_loss, spectral_target
from avmsf.field.recipes import SHARED, GainCase, GainRecipe, ThinPlate
from avmsf.field.refinement import LinearGains, RefinedGains
from avmsf.field.thinplate import places_of
from avmsf.modal.synthesis import synthesise_phased

FEWEST = 4
"""Places below which leaving one out says nothing of the field of all."""


@dataclass(frozen=True, eq=False)
class Choice:
    """One of several recipes, and how it came to be chosen."""

    recipe: GainRecipe
    report: dict[str, Any]
    """Under `choice`: each recipe's leave-one-out error, and why those without one have none."""


@dataclass(frozen=True, eq=False)
class Automatic:
    """Takes the recipe that predicts training contacts best from those at all other places."""

    candidates: tuple[GainRecipe, ...] = (ThinPlate(),)
    """Recipes to choose from, the first one where there are too few places to choose by."""
    unavailable: Mapping[str, str] = field(default_factory=dict)
    """Recipes that could not be had, and why: for the report."""

    def choose(self, case: GainCase) -> Choice:
        """Return the recipe of the least relative STFT error at contacts left out, mean over all that are not silent.

        A place is left out with all of its contacts. Gains are predicted in closed form: each recipe's body, smoothing
        and outliers are those of all training contacts, as are the modes, and nothing is trained end to end. So errors
        are a little too small, of all recipes. A network has no such form: it is taken only where no other recipe can
        be had. A recipe that cannot be had says why in the report. Where none can, the first one is returned.
        """
        errors: dict[str, float] = {}
        missing = dict(self.unavailable)
        usable = []
        enough = int(places_of(case.train.contacts.double()).max()) + 1 >= FEWEST
        for recipe in self.candidates:
            try:
                gains = recipe.start(case, SHARED)
            except AvmsfError as error:
                missing[recipe.name] = str(error)
                continue
            usable.append(recipe)
            if enough and isinstance(gains, RefinedGains):
                errors[recipe.name] = leave_one_out_error(gains.field, case)
        best = min(usable or self.candidates, key=lambda recipe: errors.get(recipe.name, float("inf")))
        return Choice(best, {"choice": {"errors": errors, "missing": missing}})


def leave_one_out_error(gains: LinearGains, case: GainCase) -> float:
    """Return the relative STFT error of sounds rendered of the gains that other places predict, mean over contacts.

    Silent recordings have no part, for nothing is relative to them.
    """
    heard = torch.nonzero(case.train.sounds.abs().amax(1) > 0).flatten()
    predicted, train, bank = gains.leave_one_out()[heard].float(), case.train.take(heard.tolist()), case.modes.bank
    sounds = synthesise_phased(
        predicted[..., 0],
        bank.frequency,
        bank.damping,
        case.phase,
        samples=train.sounds.shape[1],
        sample_rate=train.sample_rate,
        quadrature=predicted[..., 1],
    )
    sizes, hops, _ = case.config.resolutions(train.sample_rate)

    def error(sound: Float[Tensor, "1 samples"], truth: Float[Tensor, "1 samples"]) -> float:
        return float(spectral_loss(sound, spectral_target(truth, fft_sizes=sizes, hops=hops))) / len(sizes)

    pairs = zip(torch.split(sounds, 1), torch.split(train.sounds, 1), strict=True)
    return sum(error(sound, truth) for sound, truth in pairs) / len(heard)
