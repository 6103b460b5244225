"""How files and requests that are damaged, oversized or hostile are answered; tracebacks and crashes must be 0."""

import ctypes
import http.client
import json
import math
import os
import re
import resource
import shutil
import signal
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from urllib.parse import quote

from benchmarks.bombs import BOMBS
from benchmarks.browser import studio
from benchmarks.records import Measurement, Record, Settings, records
from tests.factories.damaged_files import FAMILIES, damaged_inputs, outcome_of
from tests.factories.hostile_requests import Request, fuzz, write_object
from tests.factories.valid_files import write_seeds

MAX_CPU_SECONDS, MAX_MEGABYTES = 60, 4096
"""Limits of one input: what a user waits for without thinking of a hang, and half the memory of a small computer."""
FAULTS = ("traceback", "killed", "too slow", "too large")
REQUESTS = 3000


@dataclass(frozen=True)
class Outcome:
    """What became of one input: read, refused, or one of `FAULTS`; processor time, and memory above an idle process."""

    family: str
    name: str
    result: str
    seconds: float
    megabytes: float
    message: str


def _files(settings: Settings) -> Iterator[Record]:
    """60 valid files of each family with seeded random damage, each opened in a process of its own.

    An input is good if it is read, or refused by the package's own error. Faults: another error (traceback), a crash,
    more than 60 s of processor time or 4096 MB above an idle process.
    """
    with tempfile.TemporaryDirectory(prefix="avmsf-robustness-") as name:
        seeds, folder = _seeds(Path(name))
        inputs = damaged_inputs(seeds, folder, count=2 if settings.quick else 60)
        yield from _counted([_run_apart(*each) for each in inputs])


def _bombs(settings: Settings) -> Iterator[Record]:
    """Small files that claim or unfold to be large, likewise."""
    with tempfile.TemporaryDirectory(prefix="avmsf-robustness-") as name:
        seeds, folder = _seeds(Path(name))
        outcomes = []
        for title, bomb in BOMBS.items():
            _copied(seeds, folder)
            family, path = bomb(folder)
            outcomes.append(_run_apart("bombs", title, partial(FAMILIES[family].read, folder, path)))
            values = {"seconds": outcomes[-1].seconds, "megabytes": outcomes[-1].megabytes}
            yield from records(values, object=title, note=outcomes[-1].result)
        yield from _counted(outcomes)


def _seeds(place: Path) -> tuple[Path, Path]:
    """Write valid files, and read them: what a verb imports is not what an input costs."""
    seeds, folder = place / "seeds", place / "input"
    write_seeds(seeds)
    for family, each in FAMILIES.items():
        _copied(seeds, folder)
        result, message = outcome_of(partial(each.read, folder, folder / each.seeds[0]))
        if result != "read":
            raise RuntimeError(f"{family}: the undamaged file is {result}: {message}")
    return seeds, folder


def _copied(seeds: Path, folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(seeds, folder)


def _counted(outcomes: list[Outcome]) -> Iterator[Record]:
    """Yield the counts and worst cases of each family, and of all, and every fault by name."""
    families = [*dict.fromkeys(each.family for each in outcomes), "all"]
    for family in families:
        own = [each for each in outcomes if family in (each.family, "all")]
        faults = [each for each in own if each.result in FAULTS]
        values = {
            "inputs": len(own),
            "read": sum(each.result == "read" for each in own),
            "refused": sum(each.result == "refused" for each in own),
            "tracebacks": sum(each.result == "traceback" for each in own),
            "faults": len(faults),
            "worst_seconds": max(each.seconds for each in own),
            "worst_megabytes": max(each.megabytes for each in own),
        }
        named = [f"{each.name}: {each.result}, {each.message}" for each in faults] if family != "all" else []
        yield from records(values, object=family, note="; ".join(named))


def _run_apart(family: str, name: str, read: Callable[[], None]) -> Outcome:
    """Read one input in a forked process with limits of time and memory."""
    receiving, sending = os.pipe()
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
        answer = pipe.read()
    _, status, usage = os.wait4(child, 0)
    seconds, megabytes = usage.ru_utime + usage.ru_stime, float(MAX_MEGABYTES)
    if os.WIFSIGNALED(status):
        slow = os.WTERMSIG(status) in (signal.SIGXCPU, signal.SIGALRM)
        result, message = "too slow" if slow else "killed", signal.Signals(os.WTERMSIG(status)).name
    else:
        result, message, megabytes = json.loads(answer) if answer else ("killed", f"status {status}", megabytes)
        if "MemoryError" in message or "can't allocate memory" in message:
            result = "too large"
    return Outcome(family, name, result, seconds, megabytes, message)


def _limit() -> None:
    """Bound this process's time and memory, and keep its crashes from leaving core files."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + (MAX_MEGABYTES << 20)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CPU, (MAX_CPU_SECONDS, MAX_CPU_SECONDS + 5))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # A reader may wait for ever without using the processor, as for a pipe.
    signal.alarm(10 * MAX_CPU_SECONDS)


def _megabytes(key: str, process: int | str = "self") -> float:
    """Return a process's memory now (VmRSS) or at most so far (VmHWM); NaN where the system does not say."""
    status = Path(f"/proc/{process}/status")
    if not status.is_file():
        return math.nan
    lines = dict(line.split(":", 1) for line in status.read_text().splitlines())
    return int(lines[key].split()[0]) / 1024


def _studio(settings: Settings) -> Iterator[Record]:
    """3000 requests that no page would send, to a studio in a process of its own, on a small field and capture.

    server_errors: answers of 500 and above; unanswered: broken connections; tracebacks: printed by the studio.
    """
    with tempfile.TemporaryDirectory() as name:
        path = write_object(Path(name) / "object")
        with studio(str(path), "--capture", str(path.parent)) as (process, address, lines):
            values = fuzz(partial(_ask, address), count=100 if settings.quick else REQUESTS)
            values["worst_mebibytes"] = _megabytes("VmHWM", process.pid)
    values["tracebacks"] = "".join(lines).count("Traceback (most recent call last)")
    yield from records(values)


def _ask(address: str, request: Request) -> tuple[int, bytes]:
    port, token = re.findall(r":(\d+)/([\w-]+)/", address)[0]
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
    try:
        path = quote(request.path, safe="/%?=&")
        headers = {name: quote(value) for name, value in request.headers.items()}
        connection.request(request.method, f"/{token}/{path}", request.body, headers)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


PARTS: dict[str, Measurement] = {"files": _files, "bombs": _bombs, "studio": _studio}
