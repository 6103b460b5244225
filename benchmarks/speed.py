"""How long a training step, a whole fit and a rendered sound take, in seconds and against the plain way."""

import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Literal, TypeVar

import torch

from avmsf.capture import Impacts
from avmsf.evaluation.scores import evaluate
from avmsf.evaluation.splits import split
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import PAPER, FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.attention import Attention
from avmsf.field.sound_field import SoundField
from avmsf.field.trainer import Progress
from avmsf.field.training import Targets, TrainingRun
from avmsf.modal.extraction.extract import Extraction, extract_modes
from benchmarks.material import IMPULSE, STRUCK, shared_data
from benchmarks.report import Options, Report, Table, log
from benchmarks.step import STEPS, PlainRun, full_setting, memory_of_step, pass_warmup, start

QUICK_LOOK = FitConfig(warmup_steps=20, steps=2)
_Result = TypeVar("_Result")
_SAME_LOSS = 1e-3
"""How far the two forms' first losses may differ, relative: beyond it they would not do the same work."""


@dataclass(frozen=True, eq=False)
class Task:
    """What a recipe is given."""

    train: Impacts
    features: FeatureField
    modes: Extraction


def measure(options: Options) -> Report:
    """Return times on the chosen parts."""
    threads = f"{torch.get_num_threads()} threads on {os.cpu_count()} processors, torch {torch.__version__}"
    report = Report((threads,))
    for part in options.parts:
        report += PARTS[part](options)
    return report


def _step(options: Options) -> Report:
    seconds, repeats = (0.5, 2) if options.quick_look else (3.0, 9)
    setting = full_setting(seconds)
    ours, targets = start(*setting, STEPS)
    plain, _ = start(*setting, STEPS, kind=PlainRun)
    # The two are the same until the warm-up ends. The next step is not timed: it fills caches, and its losses tell
    # whether both do the same work.
    for run in (ours, plain):
        pass_warmup(run, targets)
    losses = [float(run.advance(targets)) for run in (ours, plain)]
    apart = abs(losses[0] / losses[1] - 1)
    if not apart < _SAME_LOSS:
        raise RuntimeError(f"the two forms of a step differ: losses {losses[0]:.6f} and {losses[1]:.6f}")
    times: list[tuple[float, float]] = []
    for repeat in range(repeats):
        times.append((_advance(ours, targets), _advance(plain, targets)))
        log(f"step {repeat + 1} of {repeats}: {times[-1][0]:.3f} s, plain {times[-1][1]:.3f} s")
    own, other = (median(column) for column in zip(*times, strict=True))
    memory = memory_of_step(seconds)
    figures = {
        "step_seconds": own,
        "step_plain_seconds": other,
        "step_speedup": other / own,
        "step_loss_difference": apart,
        "step_gigabytes": memory["total"],
        "step_gigabytes_beyond_imports": memory["total"] - memory["imports"],
    }
    conventions = (
        f"step: forward, backward and Adam on 10 recordings x {seconds:g} s x 44.1 kHz x 128 modes, FFT "
        "2048/1024/512/256, hop 64, residual, early part; ours and the plain form (float32 table of atoms, autograd "
        f"through torch.stft) taking turns, medians of {repeats}; speedup: plain over ours.",
        "step_gigabytes: 10^9 bytes, peak resident memory of a fresh process with everything, interpreter, torch and "
        "the recordings' spectra included.",
    )
    return Report(conventions, (_table("step", figures),), figures)


def _quick(options: Options) -> Report:
    count, seconds, config = (30, 0.5, QUICK_LOOK) if options.quick_look else (100, 3.0, FitConfig())
    train, test = split(STRUCK.strikes(count, seconds=seconds), 0.2)
    features = STRUCK.features()
    modes, extracting = _timed(lambda: extract_modes(train))
    quick, fitting = _timed(lambda: fit(train, features, modes, config, gains=Attention()))
    quick_error = evaluate(quick, test).mean()["relative_stft"]
    log(f"quick: {extracting:.1f} s to extract, {fitting:.1f} s to fit, error {quick_error:.4f}")
    task = Task(train, features, modes)
    chosen = quick.origin.report["damping"]
    spatial = chosen == "per-contact"
    estimated, step_seconds = _paper_seconds(task, spatial, config, 2 if options.quick_look else 20)
    log(f"paper: {estimated:.0f} s to fit, by its steps of {step_seconds:.2f} s")
    steps = 2 if options.quick_look else min(PAPER.steps, max(1, int(60 * options.paper_minutes / step_seconds)))
    paper, taken = _timed(lambda: _run_paper(task, spatial, steps, config if options.quick_look else PAPER))
    paper_error = evaluate(paper, test).mean()["relative_stft"]
    log(f"paper, {steps} steps: {taken:.0f} s, error {paper_error:.4f}")
    figures = {
        "quick_speedup": (extracting + estimated) / (extracting + fitting),
        "quick_seconds": _quick_of_eight(options),
        "quick_excess_error": quick_error / paper_error - 1,
        "quick_error": quick_error,
        "quick_plate_seconds": extracting + fitting,
        "quick_plate_extract_seconds": extracting,
        "paper_seconds": extracting + estimated,
        "paper_error": paper_error,
        "paper_steps_run": float(steps),
        "paper_run_seconds": taken,
    }
    conventions = (
        f"quick_speedup: extraction and fit of FitConfig() on the plate ({len(train)} contacts to train on, {seconds:g}"
        " s), measured whole, against the same extraction and the paper's recipe. That is extrapolated: medians of 20 "
        "steps a stage times its steps, in two damping trials on three quarters of the contacts and the final fit; its "
        "looks at the validation contacts are not counted.",
        f"quick_excess_error: quick's relative STFT error at the {len(test)} held-out contacts over that of a real run "
        f"of the paper's recipe, less 1. That run had {steps} of the paper's {PAPER.steps} end-to-end steps after its "
        f"whole warm-up, the cosine brought to its end, and {chosen} damping, which quick had chosen.",
        "quick_seconds: extraction and fit of 8 recordings of 3 s at 48 kHz, 2 mm plate with all its modes to 20 kHz.",
    )
    return Report(conventions, (_table("quick", figures),), figures)


def _render(options: Options) -> Report:
    seconds, repeats = (0.25, 3) if options.quick_look else (3.0, 20)
    impacts, features, modes = full_setting(seconds)
    # Time does not depend on how well a field was trained.
    field = fit(impacts, features, modes, FitConfig(warmup_steps=1, steps=0, damping="shared"), gains=Attention())
    field.render(impacts.contacts[:1])
    taken = median(_timed(lambda: field.render(impacts.contacts[:1]))[1] for _ in range(repeats))
    figures = {"render_seconds": taken}
    conventions = (
        f"render_seconds: one sound of {seconds:g} s at 44.1 kHz, 128 modes and residual, contact to samples; median "
        f"of {repeats}.",
    )
    return Report(conventions, (_table("render", figures),), figures)


def _commands(options: Options) -> Report:
    with tempfile.TemporaryDirectory() as name:
        capture, field = shared_data() / "ruler10", f"{name}/ruler.safetensors"
        shutil.copytree(capture, f"{name}/ruler10")
        avmsf = [str(Path(sys.executable).with_name("avmsf"))]
        quick = ["--gain-model", "smooth"] if options.quick_look else []
        _processor_seconds([*avmsf, "fit", f"{name}/ruler10", "-o", field, *quick])
        commands = {
            "import": [sys.executable, "-c", "import torch"],
            "info": [*avmsf, "info", field],
            "locate": [*avmsf, "locate", field, str(capture / "impacts" / "001.wav")],
        }
        figures = {
            f"{each}_processor_seconds": min(_processor_seconds(command) for _ in range(1 if options.quick_look else 3))
            for each, command in commands.items()
        }
    figures |= {
        f"{each}_over_import": figures[f"{each}_processor_seconds"] / figures["import_processor_seconds"]
        for each in ("info", "locate")
    }
    conventions = (
        "commands: user and system time of avmsf info, and of avmsf locate for one recording, on the field of the "
        "ruler (10 contacts), each a process, least of 3; over that of importing torch, which machines share.",
    )
    return Report(conventions, (_table("commands", figures),), figures)


PARTS: dict[str, Callable[[Options], Report]] = {
    "step": _step, "render": _render, "quick": _quick, "commands": _commands,
}  # fmt: skip


def _paper_seconds(task: Task, spatial: bool, config: FitConfig, repeats: int) -> tuple[float, float]:
    """Return how long the paper's recipe would fit, and how long its last fit's end-to-end step takes, seconds."""
    held = round(config.validation * len(task.train))
    learnt = list(range(len(task.train) - held))
    modes = task.modes
    fewer = modes.take(learnt)
    trial = Task(task.train.take(learnt), task.features, fewer)
    total = 0.0
    for part, varied in ((trial, False), (trial, True), (task, spatial)):
        run, targets = start(part.train, part.features, part.modes, PAPER, spatial_damping=varied)
        warmup = median(_advance(run, targets) for _ in range(repeats))
        run.step = PAPER.warmup_steps
        joint = median(_advance(run, targets) for _ in range(repeats))
        total += PAPER.warmup_steps * warmup + PAPER.steps * joint
    return total, joint


def _run_paper(task: Task, spatial: bool, steps: int, config: FitConfig) -> SoundField:
    damping: Literal["shared", "per-contact"] = "per-contact" if spatial else "shared"

    def say(progress: Progress) -> None:
        if progress.step % 100 == 0:
            log(f"paper: step {progress.step} of {progress.steps}, loss {progress.loss:.4f}")

    recipe = replace(config, steps=steps, damping=damping)
    return fit(task.train, task.features, task.modes, recipe, gains=Attention(), progress=say)


def _quick_of_eight(options: Options) -> float:
    seconds, config = (0.5, QUICK_LOOK) if options.quick_look else (3.0, FitConfig())
    train = IMPULSE.strikes(8, seconds=seconds, sample_rate=48000.0, highest=20000.0)
    features = IMPULSE.features()
    _, taken = _timed(lambda: fit(train, features, extract_modes(train), config, gains=Attention()))
    return taken


def _advance(run: TrainingRun, targets: Targets) -> float:
    return _timed(lambda: run.advance(targets))[1]


def _timed(work: Callable[[], _Result]) -> tuple[_Result, float]:
    """Return what the work returns and the seconds that it takes."""
    begun = time.perf_counter()
    result = work()
    return result, time.perf_counter() - begun


def _processor_seconds(command: list[str]) -> float:
    """Run a command and return the processor time that it took."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _table(title: str, figures: dict[str, float]) -> Table:
    return Table(title, ("figure", "value"), list(figures.items()))
