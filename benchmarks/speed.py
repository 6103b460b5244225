"""How long a training step, a whole fit, a rendered sound and a command take, and the memory of a step."""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median

from avmsf.evaluation.scores import evaluate
from avmsf.evaluation.splits import split
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.attention import Attention
from avmsf.modal.extraction.extract import extract_modes
from avmsf.simulate.recipe import SIM20
from avmsf.simulate.simulation_folder import simulate_set
from benchmarks.objects import IMPULSE, QUICK_FIT, STRUCK, shared_data
from benchmarks.processes import apart, peak_gigabytes, processor_seconds, timed
from benchmarks.records import Measurement, Record, Settings, records
from tests.oracles.plain_training import STEPS, full_setting, start


def _step(settings: Settings) -> Iterator[Record]:
    """Forward, backward and Adam on 10 recordings x 3 s x 44.1 kHz x 128 modes, median of 9 steps.

    FFT 2048/1024/512/256, hop 64, residual, early part. gigabytes: peak resident memory of a fresh process with
    everything, interpreter, torch and the recordings' spectra included; beyond_imports: without what imports take.
    """
    yield from records(apart(step_cost, *((0.5, 2) if settings.quick else (3.0, 9))))


def step_cost(seconds: float, repeats: int) -> dict[str, float]:
    """Return the seconds of a step, and the process's memory."""
    imports = peak_gigabytes()
    run, targets = start(*full_setting(seconds), STEPS)
    # To the end of the warm-up, and one step more: it fills caches.
    while run.step <= run.config.warmup_steps:
        run.advance(targets)
    taken = median(timed(lambda: float(run.advance(targets)))[1] for _ in range(repeats))
    peak = peak_gigabytes()
    return {"seconds": taken, "gigabytes": peak, "gigabytes_beyond_imports": peak - imports}


def _quick(settings: Settings) -> Iterator[Record]:
    """Extraction and fit of the attention network with `FitConfig()`, quick settings.

    plate: 20 of 100 contacts, 3 s at 44.1 kHz, with the relative STFT error at the others; eight: 8 recordings of 3 s
    at 48 kHz, a 2 mm plate with all its modes to 20 kHz.
    """
    count, seconds, config = (30, 0.5, QUICK_FIT) if settings.quick else (100, 3.0, FitConfig())
    train, test = split(STRUCK.strikes(count, seconds=seconds), 0.2)
    features = STRUCK.features()
    modes, extracting = timed(lambda: extract_modes(train))
    field, fitting = timed(lambda: fit(train, features, modes, config, gains=Attention()))
    error = evaluate(field, test).mean()["relative_stft"]
    values = {"extract_seconds": extracting, "seconds": extracting + fitting, "error": error}
    yield from records(values, object="plate")
    eight, features = IMPULSE.strikes(8, seconds=seconds, sample_rate=48000.0, highest=20000.0), IMPULSE.features()
    _, taken = timed(lambda: fit(eight, features, extract_modes(eight), config, gains=Attention()))
    yield from records({"seconds": taken}, object="eight")


def _render(settings: Settings) -> Iterator[Record]:
    """One sound of 3 s at 44.1 kHz, 128 modes and residual, contact to samples; median of 20."""
    seconds, repeats = (0.25, 3) if settings.quick else (3.0, 20)
    impacts, features, modes = full_setting(seconds)
    # Time does not depend on how well a field was trained.
    field = fit(impacts, features, modes, FitConfig(warmup_steps=1, steps=0, damping="shared"), gains=Attention())
    field.render(impacts.contacts[:1])
    taken = median(timed(lambda: field.render(impacts.contacts[:1]))[1] for _ in range(repeats))
    yield from records({"ms": 1e3 * taken})


def _commands(settings: Settings) -> Iterator[Record]:
    """User and system time of `avmsf info`, and of `avmsf locate` for one recording, on the field of the ruler.

    10 contacts; each a process, least of 3; over_import: over that of importing torch, which machines share.
    """
    with tempfile.TemporaryDirectory() as name:
        capture, field = shared_data() / "ruler10", f"{name}/ruler.safetensors"
        shutil.copytree(capture, f"{name}/ruler10")
        avmsf = str(Path(sys.executable).with_name("avmsf"))
        quick = ["--gain-model", "smooth"] if settings.quick else []
        _seconds([avmsf, "fit", f"{name}/ruler10", "-o", field, *quick])
        commands = {
            "import": [sys.executable, "-c", "import torch"],
            "info": [avmsf, "info", field],
            "locate": [avmsf, "locate", field, str(capture / "impacts" / "001.wav")],
        }
        taken = {each: min(map(_seconds, settings.some([command] * 3))) for each, command in commands.items()}
    for each, seconds in taken.items():
        yield from records({"seconds": seconds, "over_import": seconds / taken["import"]}, object=each)


def _many(settings: Settings) -> Iterator[Record]:
    """Fields of ten simulated objects: ten commands in turn, one command of one worker, one of two workers.

    The first ten of sim-20, with 8 impacts of .5 s and a mesh; default settings, one thread each, no stage cached.
    first: two workers that make the tetrahedra, which the others find. speed: over one worker. agreement: part of the
    fields that are one worker's to the bit. gigabytes: most memory of a process. megabytes: of ten fields with records,
    and of the caches. export: web pages of these fields, by one worker.
    """
    names = settings.some(list(SIM20)[:10], 2)
    with tempfile.TemporaryDirectory() as name:
        place, fields, found = Path(name), dict[str, list[bytes]](), dict[str, dict[str, float]]()
        recipes = {each: replace(SIM20[each], impacts=8, seconds=0.5, views=0) for each in names}
        # A process's memory begins at that of the one that starts it.
        apart(simulate_set, recipes, place / "sim")
        captures, more = [place / "sim" / each for each in names], ["--gain-model", "smooth"] * settings.quick
        for way, workers in (("first", 2), ("commands", 0), ("one worker", 1), ("two workers", 2)):
            output, cache, before = place / way, place / f"{way} cache", processor_seconds()
            together = [*captures, "-o", output, "--cache", cache, "--workers", workers, *more]
            alone = [
                [each, "-o", output / f"{each.name}.safetensors", "--cache", cache / each.name, *more]
                for each in captures
            ]
            memory, taken = timed(partial(_run, "fit", [together] if workers else alone, place))
            fields[way] = [(output / f"{each}.safetensors").read_bytes() for each in names]
            values = {"seconds": taken, "processor_seconds": processor_seconds() - before}
            found[way] = values | {
                "gigabytes": memory,
                "megabytes": _megabytes(output),
                "cache_megabytes": _megabytes(cache),
            }
        made, pages, before = [output / f"{each}.safetensors" for each in names], place / "pages", processor_seconds()
        words = [*made, "--to", "web", "--capture", place / "sim", "-o", pages]
        _, taken = timed(partial(_run, "export", [words], place))
        exported = {"seconds": taken, "processor_seconds": processor_seconds() - before, "megabytes": _megabytes(pages)}
    for way, values in found.items():
        same = [a == b for a, b in zip(fields[way], fields["one worker"], strict=True)]
        compared = {"speed": found["one worker"]["seconds"] / values["seconds"], "agreement": sum(same) / len(same)}
        yield from records(values | compared, object=way)
    yield from records(exported, object="export")


def _run(verb: str, commands: list[list[object]], place: Path) -> float:
    """Run a verb of `avmsf` with the words of each command, on one thread and with tetrahedra of its own.

    Returns the most memory of one of their processes, 10^9 bytes.
    """
    avmsf, environment = Path(sys.executable).with_name("avmsf"), os.environ | {"AVMSF_CACHE": str(place)}
    environment |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    most = 0
    for words in commands:
        process = subprocess.Popen([str(avmsf), verb, "--quiet", *map(str, words)], env=environment)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if status:
            raise subprocess.CalledProcessError(process.returncode, process.args)
        most = max(most, usage.ru_maxrss)
    return most * 1024 / 1e9


def _megabytes(folder: Path) -> float:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def _seconds(command: list[str]) -> float:
    """Run a command and return the processor time that it took."""
    before = processor_seconds()
    subprocess.run(command, check=True, capture_output=True)
    return processor_seconds() - before


PARTS: dict[str, Measurement] = {
    "step": _step,
    "render": _render,
    "quick": _quick,
    "commands": _commands,
    "many": _many,
}
