"""Training of the network: AdamW beside torch's own class, and each switch to the paper's form."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from avmsf.field.config import FitConfig
from avmsf.field.gains.attention import Attention
from avmsf.field.gains.data import gain_data
from avmsf.field.training import AdamW, Targets, TrainingRun
from avmsf.modal.residual_noise import noise_power
from avmsf.modal.spectra import magnitude_stft
from factories.plate_field import QUICK, plate_extraction, plate_features, plate_impacts


def drawn() -> list[nn.Parameter]:
    generator = torch.Generator().manual_seed(0)
    return [nn.Parameter(torch.randn(size, generator=generator)) for size in ((3, 4), (5,), (2, 2))]


def differentiate(parameters: list[nn.Parameter], step: int) -> None:
    for each in parameters:
        each.grad = None
    # The last has no gradient at every other step.
    used = parameters if step % 2 else parameters[:2]
    torch.stack([(each - row).pow(4).sum() for row, each in enumerate(used)]).sum().backward()


def test_steps_are_those_of_torch_also_from_a_state_of_before() -> None:
    ours, theirs = drawn(), drawn()
    optimizer = AdamW(ours, 0.1, 0.3)
    reference = torch.optim.AdamW(theirs, 0.1, weight_decay=0.3, fused=True)
    for step in range(20):
        reference.param_groups[0]["lr"] = 0.1 / (1 + step)
        for parameters in (ours, theirs):
            differentiate(parameters, step)
        optimizer.step(1 / (1 + step))
        reference.step()
        if step == 10:
            moments, optimizer = optimizer.moments, AdamW(ours, 0.1, 0.3)
            optimizer.resume(moments)
    for one, other in zip(ours, theirs, strict=True):
        assert torch.equal(one, other)


SHORT = replace(QUICK, warmup_steps=2, steps=2)


def start(config: FitConfig) -> tuple[TrainingRun, Targets]:
    impacts = plate_impacts()
    data = gain_data(impacts, plate_features(), plate_extraction(impacts), config)
    network, rows = Attention().start(data)
    return TrainingRun(network, data), Targets.of(data, rows)


def warmup_loss(config: FitConfig, offset: torch.Tensor) -> float:
    """Return the loss of a network whose gains are off by `offset` at every contact."""
    run, targets = start(config)
    targets = replace(targets, gains=run.network.read(targets.rows).mean.detach() + offset)
    return float(run.advance(targets))


def test_equal_weights_make_equation_13_of_the_warm_up() -> None:
    modes = len(plate_extraction(plate_impacts()).bank)
    offsets = 1e-3 * torch.eye(modes)
    # One squared error, whichever mode makes it, and otherwise the energies of modes of unequal damping.
    plain, weighed = (
        [warmup_loss(replace(SHORT, warmup_weights=weights), offset) for offset in offsets]
        for weights in ("equal", "energy")
    )
    assert plain == pytest.approx([plain[0]] * modes, rel=1e-3)
    assert max(weighed) > 1.2 * min(weighed)


def test_one_norm_leaves_the_resolutions_of_equation_14_in_proportion() -> None:
    config = replace(SHORT, spectral_norm="common", interleave=1, early_weight=0.5, residual=False, hop=64)
    run, targets = start(config)
    sizes, hops, early = config.resolutions(run.sample_rate)
    recorded = plate_impacts().sounds
    made = run.sounds(targets.rows).detach()

    def distance(samples: int | None, fft_size: int, hop: int) -> float:
        spectra = (magnitude_stft(each[:, :samples], fft_size=fft_size, hop=hop) for each in (made, recorded))
        return float((next(spectra) - next(spectra)).abs().sum())

    equation = sum(
        distance(None, *each) + config.early_weight * distance(early, *each) for each in zip(sizes, hops, strict=True)
    )
    norm = sum(
        float(magnitude_stft(recorded, fft_size=size, hop=hop).sum()) for size, hop in zip(sizes, hops, strict=True)
    )
    found = float(run.spectral_loss(targets).detach())
    assert found == pytest.approx(equation * len(sizes) / norm, rel=1e-4)
    relative, each = start(replace(config, spectral_norm="each"))
    assert float(relative.spectral_loss(each).detach()) != pytest.approx(found, rel=0.01)


def test_regressed_gains_are_the_warm_ups_aim_without_signs() -> None:
    impacts = plate_impacts()
    turned = replace(impacts, directions=torch.tensor([[0.0, 0.0, 1.0]] * len(impacts)))
    turned.directions[::2] *= -1
    case = gain_data(turned, plate_features(), plate_extraction(impacts), replace(SHORT, warmup_gains="regression"))
    signed = gain_data(turned, plate_features(), plate_extraction(impacts), SHORT)
    assert float(case.gains.min()) >= 0
    assert float(signed.gains.min()) < 0
    # Modes that are far apart have the modulus of their bin, of a steady sine's two thirds at most.
    strong = signed.gains.abs() > 0.3 * signed.gains.abs().amax(1, keepdim=True)
    ratio = (case.gains / signed.gains.abs())[strong & (case.gains > 0)]
    assert 0.2 < float(ratio.median()) < 0.75


def test_the_residual_may_start_from_the_quietest_segments() -> None:
    impacts, modes = plate_impacts(), plate_extraction(plate_impacts())
    bins = len(modes.residual.magnitude)
    case = gain_data(impacts, plate_features(), modes, replace(SHORT, residual_start="quietest"))
    expected = noise_power(impacts.sounds.float(), bins=bins).mean(0).sqrt()
    assert torch.equal(case.modes.residual.magnitude, expected)
    assert torch.equal(
        gain_data(impacts, plate_features(), modes, SHORT).modes.residual.magnitude, modes.residual.magnitude
    )
