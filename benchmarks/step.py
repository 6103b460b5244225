"""Milliseconds of a step of training and of splatting on a device, the mean over many steps after the first ones."""

import time
from collections.abc import Iterator
from dataclasses import replace

import torch

from avmsf.field.config import PAPER
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.fit import SplatProgress, splat
from benchmarks.look import pictures, shape, speckled
from benchmarks.records import Measurement, Record, Settings, records
from tests.oracles.plain_training import full_setting, start


def _paper(settings: Settings) -> Iterator[Record]:
    """Preset `paper` end to end, 8 recordings x 3 s x 48 kHz x 128 modes, all frames at every step."""
    setting = full_setting(0.5 if settings.quick else 3.0, count=8, sample_rate=48000.0)
    run, targets = start(*setting, replace(PAPER, damping="shared"), device=settings.device)
    run.step = PAPER.warmup_steps
    count = 2 if settings.quick else 100 if run.shift.is_cuda else 8
    times = []
    for _ in range(2):
        # A loss is there when all steps before it are.
        losses = [run.advance(targets) for _ in range(count)]
        times.append((float(losses[-1]), time.perf_counter()))
    yield from records({"step_ms": 1e3 * (times[1][1] - times[0][1]) / count}, note=_device(settings))


def _splat(settings: Settings) -> Iterator[Record]:
    """Default settings with 15,000 points on the hull of 48 views of 256 x 256.

    The last nine tenths of the steps with all that comes between them, densification too.
    """
    count, size, steps = (6, 48, 100) if settings.quick else (48, 256, SplatConfig().steps)
    views = pictures(speckled(shape("bowl"), seed=0), count=count, size=size)
    seen: list[tuple[int, float]] = []

    def note(progress: SplatProgress) -> None:
        seen.append((progress.step, time.perf_counter()))

    splat(views, SplatConfig(steps=steps), device=settings.device, progress=note)
    (first, begun), (last, ended) = next(each for each in seen if each[0] >= steps / 10), seen[-1]
    yield from records({"step_ms": 1e3 * (ended - begun) / (last - first)}, note=_device(settings))


def _device(settings: Settings) -> str:
    card = torch.cuda.get_device_name() if settings.device == "cuda" else f"{torch.get_num_threads()} threads"
    return f"{settings.device}, {card}, torch {torch.__version__}"


PARTS: dict[str, Measurement] = {"paper": _paper, "splat": _splat}
