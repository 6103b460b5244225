"""A fit that is interrupted goes on to the result that it would have had."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import count
from pathlib import Path

import pytest
import torch

from avmsf.errors import FieldFileError, FitError
from avmsf.field.config import FitConfig
from avmsf.field.fit import fingerprint
from avmsf.field.gains.attention import Attention
from avmsf.field.gains.data import gain_data
from avmsf.field.sound_field import SoundField
from avmsf.field.training import AdamW, Progress, TrainingRun
from factories.plate_field import QUICK, few_impacts, plate_features, plate_fit, same
from factories.raising import raises

CONFIG = replace(
    QUICK, damping="validated", warmup_steps=3, steps=11, clusters=4, hidden=16, width=8, fft_sizes=(256,), early=256
)
STAGES = ("trial with shared damping", "trial with per-contact damping", "fit")


def fitted(
    checkpoint: Path | None, progress: Callable[[Progress], None] | None = None, *, config: FitConfig = CONFIG
) -> SoundField:
    return plate_fit(config, **few_impacts(), checkpoint=checkpoint, progress=progress)


@cache
def uninterrupted() -> SoundField:
    return fitted(None)


def expect_same(field: SoundField, other: SoundField) -> None:
    assert same(field, other)
    assert field.origin == other.origin


class Interruption:
    """Presses the keys at the given steps of a fit, each once."""

    def __init__(self, *moments: tuple[str, int]) -> None:
        self.moments, self.told = set(moments), []

    def __call__(self, progress: Progress) -> None:
        self.told.append((progress.stage, progress.step))
        if (progress.stage, progress.step) in self.moments:
            self.moments.remove((progress.stage, progress.step))
            raise KeyboardInterrupt


# In warm-up, at the change of stages, amid the steps end to end, at the last one.
@pytest.mark.parametrize(
    ("stage", "step"), [(STAGES[0], 1), (STAGES[0], 3), (STAGES[1], 8), (STAGES[2], 13), (STAGES[2], 14)]
)
def test_an_interrupted_fit_goes_on_to_the_same_result(tmp_path, stage, step):
    checkpoint, keys = tmp_path / "fit.checkpoint", Interruption((stage, step))
    with pytest.raises(KeyboardInterrupt):
        fitted(checkpoint, keys)
    # Of another fit it is refused, and kept.
    with raises(FieldFileError, file="fit.checkpoint", value=["input, configuration or version"]):
        fitted(checkpoint, config=replace(CONFIG, seed=1))
    done = len(keys.told)
    expect_same(fitted(checkpoint, keys), uninterrupted())
    # It went on from there: no step was taken twice.
    assert keys.told[done:] == [(each, number) for each in STAGES for number in range(1, 15)][done:]
    # The finished fit's state stays until its field is saved, and gives the field again without a step.
    done = len(keys.told)
    expect_same(fitted(checkpoint, keys), uninterrupted())
    assert keys.told[done:] == []


def interrupt(patch: pytest.MonkeyPatch, owner: type, name: str, *, call: int) -> None:
    """Press the keys at the end of the given call of a method."""
    original, calls = getattr(owner, name), count(1)

    def interrupted(self, *given, **named):
        result = original(self, *given, **named)
        if next(calls) == call:
            raise KeyboardInterrupt
        return result

    patch.setattr(owner, name, interrupted)


@pytest.mark.parametrize(("owner", "name"), [(TrainingRun, "sounds"), (TrainingRun, "spectral_loss"), (AdamW, "step")])
def test_an_interruption_in_the_middle_of_a_step_loses_no_more_than_it(tmp_path, monkeypatch, owner, name):
    """Ctrl-C falls inside the arithmetic nearly always: noise drawn, gradients made, parameters half moved."""
    checkpoint = tmp_path / "fit.checkpoint"
    with monkeypatch.context() as patch:
        interrupt(patch, owner, name, call=6)
        with pytest.raises(KeyboardInterrupt):
            fitted(checkpoint)
    # Half-moved parameters are no state to go on from: such a fit starts from what was saved before, here nothing.
    assert checkpoint.exists() == (name != "step")
    expect_same(fitted(checkpoint), uninterrupted())


def test_the_state_is_kept_while_the_fit_runs(tmp_path, monkeypatch):
    """A fit that is killed leaves a checkpoint behind as well, from the last time that one was due."""
    monkeypatch.setattr("avmsf._utils.checkpoint.SAVE_SECONDS", 0.0)
    checkpoint, copies = tmp_path / "fit.checkpoint", {}

    def copy(progress: Progress) -> None:
        if checkpoint.exists():
            copies[progress.stage, progress.step] = checkpoint.read_bytes()

    fitted(checkpoint, copy)
    assert len(copies) == 3 * 14 - 1
    for moment in [(STAGES[1], 1), (STAGES[2], 14)]:
        checkpoint.write_bytes(copies[moment])
        expect_same(fitted(checkpoint), uninterrupted())


def test_a_fit_that_diverged_between_two_reads_of_the_loss_leaves_no_checkpoint(tmp_path, monkeypatch):
    monkeypatch.setattr("avmsf._utils.checkpoint.SAVE_SECONDS", 0.0)
    # As on a GPU.
    monkeypatch.setattr("avmsf.field.training.steps_between_losses", lambda device: 100)
    with raises(FitError, name=STAGES[0]):
        fitted(tmp_path / "state", config=replace(CONFIG, warmup_steps=0, learning_rate=1e30))
    kept = torch.load(tmp_path / "state", weights_only=True) if (tmp_path / "state").exists() else None
    tensors = [] if kept is None else list(kept["state"]["running"]["run"]["parameters"].values())
    assert all(bool(each.isfinite().all()) for each in tensors)


def test_all_that_decides_a_fit_tells_its_checkpoint_from_others():
    impacts, features, modes = few_impacts().values()
    other_bank = replace(modes, bank=replace(modes.bank, damping=2 * modes.bank.damping))
    other_noise = replace(modes, residual=replace(modes.residual, magnitude=2 * modes.residual.magnitude))
    directions = (impacts.directions, -impacts.directions, None)
    fits = [
        *((replace(impacts, directions=each), features, modes, CONFIG) for each in directions),
        (replace(impacts, sounds=impacts.sounds * 1.5), features, modes, CONFIG),
        (replace(impacts, sample_rate=9000.0), features, modes, CONFIG),
        (impacts, plate_features(50), modes, CONFIG),
        *((impacts, features, each, CONFIG) for each in (other_bank, other_noise)),
        (impacts, features, modes, replace(CONFIG, seed=1)),
    ]
    keys = [fingerprint(gain_data(*each), Attention()) for each in fits]
    assert len(set(keys)) == len(fits)
    assert fingerprint(gain_data(impacts, features, modes, CONFIG), Attention()) == keys[0]
