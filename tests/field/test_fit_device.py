"""A fit runs on the device that is asked for, and says where it cannot."""

from dataclasses import fields, replace

import pytest
import torch

from avmsf.cli import main
from avmsf.config import PipelineConfig
from avmsf.errors import FitError
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.losses import SpectralTarget
from avmsf.field.recipes import Attention, GainRecipe, gain_case
from avmsf.field.training import Targets, TrainingRun
from avmsf.pipeline.record import with_record
from avmsf.scene import features
from plate_capture import fill_plate
from plate_field import QUICK, plate_extraction, plate_features, plate_impacts
from raising import raises

CONFIG = replace(QUICK, warmup_steps=2, steps=2, damping="per-contact", fft_sizes=(256, 128), early=256)
CUDA = torch.cuda.is_available()


def on_meta(value: object) -> object:
    """Return a tensor, or a record or tuple of tensors, on the device `meta`, which computes shapes alone."""
    if isinstance(value, torch.Tensor):
        return value.to("meta")
    if isinstance(value, tuple):
        return tuple(on_meta(each) for each in value)
    if isinstance(value, SpectralTarget | Targets):
        return replace(value, **{each.name: on_meta(getattr(value, each.name)) for each in fields(value)})
    return value


@pytest.mark.parametrize("recipe", [Attention(), MixtureEstimator()], ids=["network", "mixture"])
def test_every_tensor_of_a_training_step_is_on_the_device_of_the_gains(
    recipe: GainRecipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The object's size is a number, which the points on that device do not have.
    monkeypatch.setattr(features, "_half_diagonal", lambda points: 0.2)
    impacts = plate_impacts(6, seconds=0.1)
    case = gain_case(impacts, plate_features(60), plate_extraction(impacts), replace(CONFIG, clusters=4))
    run = TrainingRun(
        recipe.start(case, "per-contact"),
        case.modes,
        gains=case.gains.to("meta"),
        phase=case.phase,
        sample_rate=impacts.sample_rate,
        samples=impacts.sounds.shape[1],
        config=case.config,
    )
    targets = on_meta(Targets.of(case.train, case.gains, recipe.rows(case), case.config))
    # Torch refuses to compute with tensors of two devices.
    loss = run.spectral_loss(targets)
    torch.autograd.backward(loss)
    learned = [run.shift, run.decay, *run.network.parameters()]
    assert {each.device.type for each in (loss, *learned, *(each.grad for each in learned))} == {"meta"}
    run.joint.step(0.5)
    # As a checkpoint has them that was written elsewhere.
    known = run.joint.moments
    moved = [[[torch.zeros_like(one, device="cpu") for one in each] for each in group] for group in known]
    run.joint.resume(moved)
    run.joint.step(0.5)


def test_the_cpu_is_as_good_as_no_choice() -> None:
    if CUDA:
        pytest.skip("the choice here is a GPU")
    fields_ = [fitted(device) for device in (None, "cpu")]
    contacts = plate_impacts(6, seconds=0.1).contacts
    assert torch.equal(*(each.render(contacts) for each in fields_))
    assert fields_[0].origin == fields_[1].origin


@pytest.mark.skipif(not CUDA, reason="needs a CUDA GPU")
@pytest.mark.parametrize("recipe", [Attention(), MixtureEstimator()], ids=["network", "mixture"])
def test_a_gpu_gives_the_same_field_up_to_rounding(recipe: GainRecipe) -> None:
    contacts = plate_impacts(6, seconds=0.1).contacts
    one, other = (fitted(device, recipe).render(contacts) for device in ("cpu", "cuda"))
    # Rounding of float32, grown over a few steps.
    torch.testing.assert_close(one, other, rtol=0, atol=1e-3 * float(one.abs().max()))


def fitted(device: str | None, recipe: GainRecipe | None = None):
    impacts = plate_impacts(6, seconds=0.1)
    recipe = Attention() if recipe is None else recipe
    config = replace(CONFIG, clusters=4)
    return fit(impacts, plate_features(60), plate_extraction(impacts), config, gains=recipe, device=device)


@pytest.mark.parametrize("device", ["nonesuch", "meta", *([] if CUDA else ["cuda"])])
def test_a_device_that_is_not_there_is_refused(device: str, tmp_path, capsys) -> None:
    with raises(FitError, name="device", value=device):
        fitted(device)
    capture = fill_plate(tmp_path / "plate")
    for verb in ("fit", "reconstruct"):
        assert main([verb, str(capture), "--device", device, "--output", str(tmp_path / "f.safetensors")]) == 2
        assert device in capsys.readouterr().err


def test_the_device_is_in_the_record_of_a_field() -> None:
    field = with_record(fitted("cpu"), PipelineConfig(device="cpu"), {})
    assert field.origin.report["pipeline"]["device"] == "cpu"
