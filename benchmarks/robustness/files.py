"""Damaged, oversized and hostile files against the readers and verbs that open them, each in a process of its own.

An input is good if it is read, or refused by the package's own error. A traceback, a crash, and more time or memory
than the limits are faults.
"""

import ctypes
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path

from safetensors.torch import load as from_bytes
from safetensors.torch import save as to_bytes

from avmsf.cli import options_of
from avmsf.errors import AvmsfError
from avmsf.gaussians.ply import read_splats
from avmsf.mesh.textured_mesh import read_textured_mesh
from avmsf.photographs import read_sparse_points, read_views
from benchmarks.report import Options, Report, Table, log
from benchmarks.robustness.bombs import BOMBS
from benchmarks.robustness.mutations import damage_bytes, damage_json, damage_text
from benchmarks.robustness.seeds import SURFACES, write_seeds

MAX_CPU_SECONDS, MAX_MEGABYTES = 60, 4096
"""Limits of one input: what a user waits for without thinking of a hang, and half the memory of a small computer."""
FAULTS = ("traceback", "killed", "too slow", "too large")


@dataclass(frozen=True)
class Outcome:
    """What became of one input."""

    family: str
    name: str
    result: str
    """read, refused, or one of `FAULTS`."""
    seconds: float = 0.0
    """Processor time."""
    megabytes: float = 0.0
    """Memory above that of the process that reads nothing."""
    message: str = ""


@dataclass(frozen=True)
class Family:
    """One kind of file: which seed is damaged, how, and what reads it."""

    seeds: tuple[str, ...]
    """Files below the folder of seeds."""
    damage: Callable[[bytes, random.Random], bytes]
    read: Callable[[Path, Path], None]
    """Reads the damaged file in the copied folder of seeds; raises `AvmsfError` for a refusal."""


def run_verb(*words: str) -> None:
    """Run a verb in this process, without what turns errors into exit codes; raises AvmsfError for a refusal."""
    verb = import_module(f"avmsf.cli.{words[0]}")
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        code = verb.run(options_of(words[0], words[1:]))
    # `check` refuses a capture by its code: its report says why.
    if code == 2:
        raise AvmsfError(" ".join(words))
    if code:
        raise RuntimeError(f"exit code {code}")


def _check(folder: Path, _: Path) -> None:
    run_verb("check", str(folder / "capture"))
    run_verb("modes", str(folder / "capture"), "--json")


def _surface(folder: Path, path: Path) -> None:
    shutil.copyfile(path, folder / "capture" / f"surface{path.suffix}")
    run_verb("check", str(folder / "capture"))
    read_textured_mesh(path)


def _views(folder: Path, path: Path) -> None:
    place = folder / path.relative_to(folder).parts[0]
    read_views(place, longest=64)
    read_sparse_points(place)


def _field(folder: Path, path: Path) -> None:
    output = folder / "sounds"
    run_verb("info", str(path))
    run_verb("render", str(path), "--position", "0.05", "0.05", "0.05", "--output", str(output))


def _splats(_: Path, path: Path) -> None:
    read_splats(path)


def _damage_document(content: bytes, chance: random.Random) -> bytes:
    if chance.random() < 0.3:
        return damage_text(content, chance)
    return damage_json(json.loads(content), chance).encode()


def _damage_field(content: bytes, chance: random.Random) -> bytes:
    """Damage the record in the header, or one tensor, or any bytes."""
    if chance.random() < 0.3:
        return damage_bytes(content, chance)
    size = int.from_bytes(content[:8], "little")
    metadata, tensors = json.loads(content[8 : 8 + size])["__metadata__"], from_bytes(content)
    if chance.random() < 0.3:
        flat = tensors[chance.choice(sorted(tensors))].flatten()
        flat[chance.randrange(len(flat))] = chance.choice((float("nan"), 1e38, -1e38, 0.0, -1.0, 1e-38))
    else:
        metadata["avmsf"] = damage_json(json.loads(metadata["avmsf"]), chance)
    return to_bytes(tensors, metadata)


_MODEL = "sparse/0"
FAMILIES = {
    "wav": Family(("capture/0.wav", "capture/1.wav", "capture/2.wav"), damage_bytes, _check),
    "csv": Family(("capture/impacts.csv",), damage_text, _check),
    "toml": Family(("capture/capture.toml",), damage_text, _check),
    "transforms": Family(("transforms/transforms.json",), _damage_document, _views),
    "pictures": Family(
        (*tuple(f"transforms/images/{name}" for name in ("0.png", "1.jpg", "2.webp")), "transforms/masks/0.png"),
        damage_bytes,
        _views,
    ),
    "colmap text": Family(
        tuple(f"colmap/{_MODEL}/{name}.txt" for name in ("cameras", "images", "points3D")), damage_text, _views
    ),
    "colmap binary": Family(
        tuple(f"colmap_binary/{_MODEL}/{name}.bin" for name in ("cameras", "images", "points3D")), damage_bytes, _views
    ),
    **{suffix[1:]: Family((f"surface{suffix}",), damage_bytes, _surface) for suffix in SURFACES},
    "ply text": Family(("surface_text.ply",), damage_text, _surface),
    "obj": Family(("surface.obj",), damage_text, _surface),
    "off": Family(("surface.off",), damage_text, _surface),
    "gltf": Family(("surface.gltf",), _damage_document, _surface),
    "splats": Family(("splats.ply",), damage_bytes, _splats),
    "field": Family(("attention.safetensors", "mixture.safetensors"), _damage_field, _field),
}


def damaged_inputs(
    seeds: Path, folder: Path, *, count: int, seed: int = 0, families: tuple[str, ...] = tuple(FAMILIES)
) -> Iterator[tuple[str, str, Callable[[], None]]]:
    """Yield `count` inputs of each family: its name, the input's, and what reads it; the files lie in `folder`."""
    for name in families:
        family = FAMILIES[name]
        for number in range(count):
            chance = random.Random(f"{name} {seed} {number}")
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(seeds, folder)
            path = folder / chance.choice(family.seeds)
            path.write_bytes(family.damage(path.read_bytes(), chance))
            yield name, f"{path.name} {number}", partial(family.read, folder, path)


def outcome_of(read: Callable[[], None]) -> tuple[str, str]:
    """Run what reads an input; return `read`, `refused` or `traceback` with the error's type and message."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read()
    except AvmsfError as error:
        return "refused", str(error)
    except (Exception, SystemExit) as error:  # whatever the reader lets through is what is looked for
        return "traceback", f"{type(error).__name__}: {error}"
    return "read", ""


def run_apart(family: str, name: str, read: Callable[[], None]) -> Outcome:
    """Read one input in a forked process with limits of time and memory."""
    sending, receiving = os.pipe()[::-1]
    child = os.fork()
    if not child:
        _limit()
        # Free memory of the heap, which the input would use again, is given back, and VmHWM starts anew.
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")
        before = _megabytes("VmRSS")
        result, message = outcome_of(read)
        os.write(sending, json.dumps([result, message[:300], _megabytes("VmHWM") - before]).encode())
        os._exit(0)
    os.close(sending)
    with os.fdopen(receiving, "rb") as pipe:
        said = pipe.read()
    _, status, usage = os.wait4(child, 0)
    seconds, megabytes = usage.ru_utime + usage.ru_stime, float(MAX_MEGABYTES)
    if os.WIFSIGNALED(status):
        slow = os.WTERMSIG(status) in (signal.SIGXCPU, signal.SIGALRM)
        result, message = "too slow" if slow else "killed", signal.Signals(os.WTERMSIG(status)).name
    else:
        result, message, megabytes = json.loads(said) if said else ("killed", f"status {status}", megabytes)
        if "MemoryError" in message or "can't allocate memory" in message:
            result = "too large"
    return Outcome(family, name, result, seconds, megabytes, message)


def run(
    *, count: int = 60, seed: int = 0, families: tuple[str, ...] = tuple(FAMILIES), bombs: bool = True
) -> list[Outcome]:
    """Read `count` damaged inputs of each family, and the known bombs; return what became of each."""
    outcomes, started = [], time.monotonic()
    with tempfile.TemporaryDirectory(prefix="avmsf-robustness-") as place:
        seeds, folder = Path(place) / "seeds", Path(place) / "input"
        write_seeds(seeds)
        for name, read in ((each, FAMILIES[each].read) for each in families):
            # What a verb imports is not what an input costs.
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(seeds, folder)
            path = folder / FAMILIES[name].seeds[0]
            result, message = outcome_of(partial(read, folder, path))
            if result != "read":
                raise RuntimeError(f"{name}: the undamaged file is {result}: {message}")
        for name, what, attempt in damaged_inputs(seeds, folder, count=count, seed=seed, families=families):
            outcomes.append(run_apart(name, what, attempt))
        for name, bomb in BOMBS.items() if bombs else ():
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(seeds, folder)
            family, path = bomb(folder)
            outcomes.append(run_apart("bombs", name, partial(FAMILIES[family].read, folder, path)))
    log(f"files: {len(outcomes)} inputs in {time.monotonic() - started:.0f} s")
    return outcomes


def measure(options: Options) -> Report:
    """Return a table of the families with their counts and worst cases, and all faults by name."""
    outcomes = run(count=2 if options.quick_look else 60)
    rows: list[list[str | float]] = []
    for family in dict.fromkeys(each.family for each in outcomes):
        own = [each for each in outcomes if each.family == family]
        counts = [sum(each.result == result for each in own) for result in ("read", "refused")]
        faults = sum(each.result in FAULTS for each in own)
        worst = [max(getattr(each, key) for each in own) for key in ("seconds", "megabytes")]
        rows.append([family, len(own), *counts, faults, *worst])
    faulty: list[list[str | float]] = [
        [f"{each.family}: {each.name}", each.result, each.seconds, each.megabytes, each.message]
        for each in outcomes
        if each.result in FAULTS
    ]
    columns = ("family", "inputs", "read", "refused", "faults", "worst s", "worst MB")
    tables = [Table("files", columns, rows)]
    if faulty:
        tables.append(Table("faults", ("input", "result", "s", "MB", "error"), faulty))
    figures = {
        "files.inputs": float(len(outcomes)),
        "files.tracebacks": float(sum(each.result == "traceback" for each in outcomes)),
        "files.faults": float(len(faulty)),
        "files.worst_seconds": max(each.seconds for each in outcomes),
        "files.worst_megabytes": max(each.megabytes for each in outcomes),
    }
    conventions = (
        "files: inputs are valid files of each family with seeded random damage, and bombs, small files that claim or "
        f"unfold to be large. Faults: an error other than the package's own, a crash, more than {MAX_CPU_SECONDS} s of "
        f"processor time or {MAX_MEGABYTES} MB. Seconds are processor time; memory is that above an idle process.",
    )
    return Report(conventions, tuple(tables), figures)


def _limit() -> None:
    """Bound this process's time and memory, and keep its crashes from leaving core files."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + (MAX_MEGABYTES << 20)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CPU, (MAX_CPU_SECONDS, MAX_CPU_SECONDS + 5))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # A reader may wait for ever without using the processor, as for a pipe.
    signal.alarm(10 * MAX_CPU_SECONDS)
    sys.stdout.flush()


def _megabytes(key: str) -> float:
    """Return this process's memory now (VmRSS) or at most so far (VmHWM)."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(lines[key].split()[0]) / 1024
