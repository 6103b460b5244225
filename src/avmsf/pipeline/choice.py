"""Which features a field should read, decided on training contacts alone: looks do not always tell of sounds."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from avmsf.bench.evaluation import evaluate
from avmsf.capture import Impacts
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.modal.extraction import Extraction
from avmsf.scene.features import FeatureField
from avmsf.scene.points import farthest_points

FEWEST = 4
"""Training contacts below which there is nothing to decide on."""
_FOLDS = 4


@dataclass(frozen=True)
class Choice:
    """One of several feature fields, and how well each did."""

    name: str
    errors: Mapping[str, float]
    """Mean relative STFT error at training contacts left out in turn; empty where nothing was decided."""


def choose_features(
    train: Impacts, modes: Extraction, candidates: Mapping[str, FeatureField], config: FitConfig
) -> Choice:
    """Return which of the candidates foretells training contacts best that are left out of the warm-up in turn.

    Of the contacts in farthest-point order the later half is left out, a fourth of it at a time: they lie between the
    earlier ones, as contacts that are struck later mostly do. All share the modes, which come from all training
    recordings. With fewer than four contacts the first candidate is taken. Raises as `fit`.
    """
    first = next(iter(candidates))
    if len(train) < FEWEST or len(candidates) == 1:
        return Choice(first, {})
    between = farthest_points(train.contacts, len(train)).tolist()[len(train) // 2 :]
    # Dampings, noise and the end-to-end stage change little in what a place tells of its gains.
    brief = replace(config, warmup_steps=max(1, config.warmup_steps), steps=0, damping="shared", residual=False)
    errors = dict.fromkeys(candidates, 0.0)
    for fold in range(_FOLDS):
        held = between[fold::_FOLDS]
        if not held:
            continue
        learnt = [row for row in range(len(train)) if row not in held]
        part = replace(modes, gains=modes.gains[learnt], quadrature=modes.quadrature[learnt])
        for name, features in candidates.items():
            fitted = fit(train.take(learnt), features, part, brief)
            error = float(evaluate(fitted, train.take(held)).values["relative_stft"].sum())
            errors[name] += error / len(between)
    return Choice(min(errors, key=lambda name: errors[name]), errors)
