"""The small SonicGauss: its training from scratch, by one command."""

import time
from pathlib import Path

from avmsf.baselines.sonicgauss.pretraining import PRETRAINING, pretrain, training_objects, training_recipes
from avmsf.baselines.sonicgauss.small import SmallConfig
from avmsf.baselines.sonicgauss.training import TrainingConfig
from benchmarks.report import Report, Table, log

OBJECTS = 40
"""Simulated objects, 32 recordings each."""
_QUICK = SmallConfig(blocks=1, encoder_blocks=1), TrainingConfig(steps=4, batch=8, rate=1e-3)


def train_small(weights: Path, *, quick: bool) -> Report:
    """Make training objects, train on them, write the weights, and return the curve of the loss."""
    sizes, training = _QUICK if quick else (SmallConfig(), PRETRAINING)
    begun = time.process_time()
    objects = list(training_objects(training_recipes(2 if quick else OBJECTS), log=log))
    made = time.process_time() - begun
    found = pretrain(objects, sizes, training, log=log)
    found.write(weights)
    losses = [float(value) for value in found.report["losses"]]
    rows: list[list[str | float]] = [[f"{(place + 1) / len(losses):.0%}", value] for place, value in enumerate(losses)]
    figures = {
        "sonicgauss_small.objects_seconds": made,
        "sonicgauss_small.training_seconds": float(found.report["seconds"]),
        "sonicgauss_small.first_loss": losses[0],
        "sonicgauss_small.last_loss": losses[-1],
    }
    title = f"sonicgauss-small: loss by part of {found.report['steps']} steps, {found.report['clips']} recordings"
    return Report(tables=(Table(title, ("steps", "loss"), rows),), figures=figures)
