"""Steps of AdamW beside those of torch's own class."""

import subprocess
import sys

import pytest
import torch
from torch import nn

from avmsf.field.training import AdamW


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


@pytest.mark.slow
def test_a_step_brings_no_compiler_in() -> None:
    program = (
        "import sys, torch; from avmsf.field.training import AdamW; "
        "p = torch.nn.Parameter(torch.ones(2)); p.square().sum().backward(); AdamW([p], 0.1).step(1.0); "
        "assert float(p[0]) < 0.95; print('torch._dynamo' in sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"
