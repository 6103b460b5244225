"""Steps of AdamW beside those of torch's own class."""

import subprocess
import sys

import pytest
import torch
from torch import nn

from avmsf.field.training import AdamW, Group


def made() -> list[nn.Parameter]:
    generator = torch.Generator().manual_seed(0)
    return [nn.Parameter(torch.randn(size, generator=generator)) for size in ((3, 4), (5,), (2, 2))]


def loss(parameters: list[nn.Parameter], step: int) -> torch.Tensor:
    # The last has no slope at every other step.
    used = parameters if step % 2 else parameters[:2]
    return torch.stack([(each - row).pow(4).sum() for row, each in enumerate(used)]).sum()


def groups(parameters: list[nn.Parameter]) -> list[Group]:
    return [Group(parameters[:1], 0.1, 0.3), Group(parameters[1:], 0.02)]


def test_steps_are_those_of_torch() -> None:
    ours, theirs = made(), made()
    descent = AdamW(groups(ours))
    optimizer = torch.optim.AdamW(
        [
            {"params": theirs[:1], "weight_decay": 0.3, "rate": 0.1},
            {"params": theirs[1:], "weight_decay": 0.0, "rate": 0.02},
        ],
        fused=True,
    )
    for step in range(20):
        for group in optimizer.param_groups:
            group["lr"] = group["rate"] / (1 + step)
        for each, parameters in ((descent.zero_grad, ours), (optimizer.zero_grad, theirs)):
            each()
            loss(parameters, step).backward()
        descent.step(1 / (1 + step))
        optimizer.step()
    for one, other in zip(ours, theirs, strict=True):
        assert torch.equal(one, other)


def test_a_descent_goes_on_from_its_state() -> None:
    parameters = made()
    descent = AdamW(groups(parameters))
    for step in range(10):
        if step == 5:
            again = [nn.Parameter(each.detach().clone()) for each in parameters]
            other = AdamW(groups(again))
            other.resume(descent.moments)
            break
        descent.zero_grad()
        loss(parameters, step).backward()
        descent.step(1.0)
    kept = [each.detach().clone() for each in again]
    for run, values in ((other, again), (descent, parameters)):
        for step in range(5, 10):
            run.zero_grad()
            loss(values, step).backward()
            run.step(1.0)
    assert not torch.equal(kept[0], again[0])
    for one, two in zip(again, parameters, strict=True):
        assert torch.equal(one, two)


@pytest.mark.slow
def test_a_step_brings_no_compiler_in() -> None:
    program = (
        "import sys, torch; from avmsf.field.training import AdamW, Group; "
        "p = torch.nn.Parameter(torch.ones(2)); p.square().sum().backward(); AdamW([Group([p], 0.1)]).step(1.0); "
        "assert float(p[0]) < 0.95; print('torch._dynamo' in sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"
