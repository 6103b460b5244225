"""What a fit is asked with: whether it fits together, and by what it is known again."""

import hashlib
import json
from dataclasses import asdict
from importlib.metadata import version

import torch

from avmsf._utils.caching import source_digest
from avmsf.capture.impacts import Impacts
from avmsf.errors import FitError
from avmsf.field.recipes import GainCase, GainRecipe
from avmsf.modal.extraction.extract import Extraction


def expect_fitting(train: Impacts, modes: Extraction) -> None:
    """Raise `FitError` for recordings and modes that no field can be fitted to."""
    if len(train) == 0:
        raise FitError("expected recordings to fit a field to, found none: strike the object in some places")
    for name, sound, contact in zip(train.names, train.sounds, train.contacts, strict=True):
        if not bool(torch.isfinite(sound).all() and torch.isfinite(contact).all()):
            raise FitError(
                f"{name}: expected finite samples and coordinates, found NaN or infinity: leave the recording out or "
                "read it again"
            )
    if train.directions is not None and not bool(torch.isfinite(train.directions).all()):
        row = int(torch.nonzero(~torch.isfinite(train.directions).all(1))[0])
        raise FitError(
            f"{train.names[row]}: expected a finite direction, got {train.directions[row].tolist()}: give the way the "
            "hammer moves, or zeros where it is not known"
        )
    if float(train.sounds.abs().max()) == 0.0:
        raise FitError("all recordings are silent: there is nothing to fit; check the channel that was read")
    if len(modes.gains) != len(train):
        raise FitError(
            f"the modes were extracted from {len(modes.gains)} recordings, the field is to be fitted to {len(train)}: "
            "extract them from the recordings that the field is fitted to"
        )
    if len(modes.bank) == 0:
        raise FitError("expected modes, found none: a field of noise alone is the same everywhere")
    highest = float(modes.bank.frequency.max())
    if highest >= train.sample_rate / 2:
        raise FitError(
            f"the highest mode is at {highest:g} Hz, the recordings reach {train.sample_rate / 2:g} Hz: extract the "
            "modes from the recordings that the field is fitted to"
        )


def fingerprint(case: GainCase, recipe: GainRecipe) -> str:
    """Return a digest of all that decides a fit's result, this package's version and code among it."""
    train, modes = case.train, case.modes
    words = [version("avmsf"), source_digest(), asdict(case.config), recipe.name, recipe.digest()]
    words += [train.digest(), case.features.digest()]
    digest = hashlib.sha256(json.dumps(words, sort_keys=True).encode())
    tensors = [modes.bank.frequency, modes.bank.damping, modes.residual.magnitude]
    # Phases, and without a warm-up how strong the modes are, are those of the extraction.
    for tensor in (*tensors, modes.gains, modes.quadrature):
        digest.update(f"{tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
