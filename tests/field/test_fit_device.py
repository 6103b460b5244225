"""A fit runs on the device that is asked for, and says where it cannot."""

from dataclasses import fields, replace

import pytest
import torch

from avmsf._utils.device import without_denormals
from avmsf.errors import FitError
from avmsf.field.config import PAPER, FitConfig
from avmsf.field.gains.attention import Attention
from avmsf.field.gains.data import gain_data
from avmsf.field.gains.estimator import MixtureEstimator, RefinedGains
from avmsf.field.losses import Resolution, SpectralTarget
from avmsf.field.training import Targets, TrainingRun
from factories.plate_field import QUICK, few_impacts, plate_fit
from factories.raising import raises

CONFIG = replace(QUICK, warmup_steps=2, steps=2, damping="per-contact", fft_sizes=(256, 128), early=256)
SHARED_PAPER = replace(PAPER, damping="shared")
CUDA = torch.cuda.is_available()


def on_meta(value: object) -> object:
    """Return a tensor, or a record or tuple of tensors, on the device `meta`, which computes shapes alone."""
    if isinstance(value, torch.Tensor):
        return value.to("meta")
    if isinstance(value, tuple):
        return tuple(on_meta(each) for each in value)
    if isinstance(value, Resolution | SpectralTarget | Targets):
        return replace(value, **{each.name: on_meta(getattr(value, each.name)) for each in fields(value)})
    return value


def started(recipe: Attention | MixtureEstimator, config: FitConfig, device: str) -> tuple[TrainingRun, Targets]:
    """Return a run before its first step, and what it is fitted to, on a device."""
    data = gain_data(*few_impacts().values(), replace(config, clusters=4))
    if isinstance(recipe, Attention):
        gains, rows = recipe.start(data)
    else:
        model, rows = recipe.solve(data)
        gains = RefinedGains(model, data.modes.bank)
    targets = Targets.of(data, rows, "cpu" if device == "meta" else device)
    return TrainingRun(gains, data, device), on_meta(targets) if device == "meta" else targets


@pytest.mark.parametrize("recipe", [Attention(), MixtureEstimator()], ids=["network", "mixture"])
def test_every_tensor_of_a_training_step_is_on_the_device_of_the_gains(recipe: Attention | MixtureEstimator) -> None:
    run, targets = started(recipe, CONFIG, "meta")
    # Torch refuses to compute with tensors of two devices.
    loss = run.spectral_loss(targets)
    torch.autograd.backward(loss)
    learned = [run.shift, run.decay, *run.network.parameters()]
    assert {each.device.type for each in (loss, *learned, *(each.grad for each in learned))} == {"meta"}
    # No value is waited for: tensors of this device have none.
    run.step = CONFIG.warmup_steps
    run.advance(targets)
    for each in run.joint:
        each.step(0.5)
        # As a checkpoint has them that was written elsewhere.
        each.resume([[torch.zeros_like(one, device="cpu") for one in known] for known in each.moments])
        each.step(0.5)


@pytest.mark.skipif(not CUDA, reason="needs a CUDA GPU")
# What torch says whenever this mode is set.
@pytest.mark.filterwarnings("ignore:Synchronization debug mode")
@pytest.mark.parametrize("recipe", [Attention(), MixtureEstimator()], ids=["network", "mixture"])
def test_a_step_on_a_gpu_waits_for_nothing_and_is_repeatable(recipe: Attention | MixtureEstimator) -> None:
    results = []
    for _ in range(2):
        run, targets = started(recipe, SHARED_PAPER, "cuda")
        run.step = PAPER.warmup_steps
        run.advance(targets)
        torch.cuda.set_sync_debug_mode("error")
        try:
            losses = [run.advance(targets) for _ in range(3)]
        finally:
            torch.cuda.set_sync_debug_mode("default")
        results.append((losses[-1], run.shift.detach().clone()))
    for one, other in zip(*results, strict=True):
        assert torch.equal(one, other)


def test_denormal_numbers_are_as_they_were_after_a_step() -> None:
    tiny, seen = torch.tensor([1e-40]), []
    for outside in (False, True):
        torch.set_flush_denormal(outside)
        try:
            with without_denormals():
                seen.append(float(tiny * 0.5))
            seen.append(float(tiny * 0.5))
        finally:
            torch.set_flush_denormal(False)
    assert [each == 0.0 for each in seen] == [True, False, True, True]


@pytest.mark.skipif(not CUDA, reason="needs a CUDA GPU")
@pytest.mark.parametrize("recipe", [Attention(), MixtureEstimator()], ids=["network", "mixture"])
def test_a_gpu_gives_the_same_field_up_to_rounding(recipe: Attention | MixtureEstimator) -> None:
    contacts = few_impacts()["train"].contacts
    one, other = (fitted(device, recipe).render(contacts) for device in ("cpu", "cuda"))
    # Rounding of float32, grown over a few steps.
    torch.testing.assert_close(one, other, rtol=0, atol=1e-3 * float(one.abs().max()))


def fitted(device: str | None, recipe: Attention | MixtureEstimator | None = None):
    gains = Attention() if recipe is None else recipe
    return plate_fit(replace(CONFIG, clusters=4), **few_impacts(), gains=gains, device=device)


@pytest.mark.parametrize("device", ["nonesuch", "meta", *([] if CUDA else ["cuda"])])
def test_a_device_that_is_not_there_is_refused(device: str) -> None:
    with raises(FitError, name="device", value=device):
        fitted(device)
