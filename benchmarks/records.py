"""Records of measurements: printed as Markdown tables, stored as JSON lines, one file a part."""

import inspect
import json
import math
import os
import platform
import re
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Literal, TypeAlias, TypeVar

NAMES = (
    *("align", "baselines", "evaluation", "extract", "gains", "physics", "proof", "residual", "robustness", "scene"),
    *("speed", "step", "studio", "suggest", "surface", "tasks"),
)
REPOSITORY = Path(__file__).resolve().parents[1]
WORK = REPOSITORY / ".cache" / "benchmarks"
MEASURED = ("src", "benchmarks", "tests/oracles", "tests/factories")
"""Folders whose commits count: what is measured, and what measures."""
Better: TypeAlias = Literal["lower", "higher", ""]
KINDS: dict[str, tuple[str, Better]] = {
    "seconds": ("s", "lower"),
    "minutes": ("min", "lower"),
    "ms": ("ms", "lower"),
    "gigabytes": ("GB", "lower"),
    "megabytes": ("MB", "lower"),
    "mebibytes": ("MiB", "lower"),
    "bytes": ("B", "lower"),
    "millimeters": ("mm", "lower"),
    "hertz": ("Hz", ""),
    "db": ("dB", ""),
    "degrees": ("degrees", "lower"),
    "delay": ("samples", ""),
    "rms": ("samples", "lower"),
    "psnr": ("dB", "higher"),
    "percent": ("% of the diagonal", "lower"),
    **dict.fromkeys(("ssim", "precision", "recall", "found", "right", "voices", "speed", "coherence"), ("", "higher")),
    **dict.fromkeys(("clap", "accuracy", "read", "refused", "agreement"), ("", "higher")),
    **dict.fromkeys(("coverage", "modes", "poles", "dofs", "count", "gaussians", "inputs", "steps", "axes"), ("", "")),
    **dict.fromkeys(("coverage90", "planes", "triangles", "true", "known", "uncertainty", "named"), ("", "")),
    **dict.fromkeys(("held", "shifting"), ("", "")),
}
"""Unit, and which way is better, by a word of a value's name; of a name without any: no unit, the lower the better."""
DASH = "–"
"""What tables show in place of a value that is not known."""
_Item = TypeVar("_Item")


class MissingDataError(Exception):
    """Data that a benchmark needs is not where it was looked for."""


@dataclass(frozen=True)
class Settings:
    """What a benchmark is run with."""

    quick: bool = False
    """Small settings that show that everything runs; the values are not the benchmark's then."""
    objects: tuple[str, ...] = ()
    """Some of these objects; none for all."""
    work: Path = WORK
    """Folder that keeps simulated objects, their Gaussians, trained weights, and unfinished results of `evaluation`."""
    device: str = "cpu"
    """What the steps of `step` are taken on."""

    @property
    def kept(self) -> Path:
        """The folder of `work` for this commit."""
        return self.work / code_commit()

    @property
    def weights(self) -> Path:
        """File of the weights of sonicgauss-small."""
        return self.kept / f"{'quick-' * self.quick}sonicgauss-small.safetensors"

    def some(self, items: Sequence[_Item], quick: int = 1) -> Sequence[_Item]:
        """Return all items, or the first `quick` of them for a quick look."""
        return items[:quick] if self.quick else items


@dataclass(frozen=True)
class Record:
    """One measured value."""

    name: str
    """What was measured: benchmark, part and words with dots between, the last of them the column in tables."""
    value: float
    """NaN where it could not be measured."""
    unit: str = ""
    better: Better = "lower"
    object: str = ""
    """What it was measured on, if on one of several."""
    seed: int = 0
    commit: str = ""
    note: str = ""
    machine: str = ""
    """Processor and versions that it was measured with."""


Measurement: TypeAlias = Callable[[Settings], Iterator[Record]]


def parts_of(name: str) -> dict[str, Measurement]:
    """Return the parts of a benchmark by name."""
    return import_module(f"benchmarks.{name}").PARTS


def described(measure: Measurement) -> str:
    """Return what a part measures."""
    return inspect.getdoc(getattr(measure, "func", measure)) or ""


def records(
    values: Mapping[str, float], *, group: str = "", object: str = "", seed: int = 0, note: str = ""
) -> Iterator[Record]:
    """Yield a record for each value by name, with unit and direction by the words of its name."""
    for key, value in values.items():
        words = [each for each in re.split(r"[\W_]", key) if each in KINDS]
        unit, better = KINDS[words[-1]] if words else ("", "lower")
        yield Record(f"{group}.{key}".lstrip("."), float(value), unit, better, object, seed, note=note)


def means(rows: Sequence[Mapping[str, float]], *, geometric: Sequence[str] = ()) -> dict[str, float]:
    """Return the mean of each value over the rows that have it, of those named the geometric one."""
    found = {}
    for key in dict.fromkeys(key for row in rows for key in row):
        known = [row[key] for row in rows if math.isfinite(row.get(key, math.nan))]
        terms = [math.log(each) for each in known] if key in geometric else known
        mean = sum(terms) / len(terms) if terms else math.nan
        found[key] = math.exp(mean) if key in geometric else mean
    return found


def code_commit() -> str:
    """Return the last commit of `MEASURED`, with a plus sign where something there was changed since."""
    last, changed = (
        subprocess.run(["git", *words, "--", *MEASURED], cwd=REPOSITORY, capture_output=True, text=True, check=True)
        for words in (("log", "-1", "--format=%h", "--abbrev=10"), ("status", "--porcelain"))
    )
    return last.stdout.strip() + "+" * bool(changed.stdout.strip())


def machine() -> str:
    """Return the processor, its cores, and the versions of Python and of what computes."""
    cpu = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*: (.+)", cpu.read_text()) if cpu.exists() else None
    versions = (f"{each} {version(each)}" for each in ("torch", "numpy"))
    processor = found[1] if found else platform.processor()
    return ", ".join([processor, f"{os.cpu_count()} cores", f"Python {platform.python_version()}", *versions])


def stored(path: Path) -> list[Record]:
    """Return the records of a file; none where it does not exist."""
    if not path.exists():
        return []
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [Record(**{**line, "value": math.nan if line["value"] is None else line["value"]}) for line in lines]


def store(found: Sequence[Record], path: Path) -> None:
    """Write records to a file, all of them or none."""
    values = [asdict(each) | {"value": each.value if math.isfinite(each.value) else None} for each in found]
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text("".join(json.dumps(each) + "\n" for each in values), encoding="utf-8")
    part.replace(path)


def row_of(record: Record) -> str:
    """Return the row of a part's table that a record belongs to: group and object."""
    group = record.name.split(".", 2)[2].rpartition(".")[0]
    return ", ".join(filter(None, (group, record.object))) or "all"


def markdown(found: Sequence[Record], columns: Sequence[str] = ()) -> str:
    """Return a table of these columns, or one for all groups with the same; a row for each group and object of a part.

    Rows without any of the columns are left out.

    Names are those below the part's.
    """
    rows: dict[str, dict[str, Record]] = {}
    for each in found:
        rows.setdefault(row_of(each), {})[each.name.rpartition(".")[2]] = each
    tables: dict[tuple[str, ...], dict[str, dict[str, Record]]] = {}
    for label, row in rows.items():
        if not columns or not row.keys().isdisjoint(columns):
            tables.setdefault(tuple(columns or row), {})[label] = row
    return "\n\n".join("\n".join(_table(each, lines)) for each, lines in tables.items())


def _table(columns: Sequence[str], rows: Mapping[str, Mapping[str, Record]]) -> Iterator[str]:
    known = {each: row[each] for row in rows.values() for each in columns if each in row}
    noted = any(record.note for row in rows.values() for record in row.values())
    arrows = {"lower": " ↓", "higher": " ↑", "": ""}
    firsts = [(each, known.get(each)) for each in columns]
    heads = [each if of is None else f"{each}{', ' * bool(of.unit)}{of.unit}{arrows[of.better]}" for each, of in firsts]
    yield "| " + " | ".join(["", *heads, *["note"] * noted]) + " |"
    yield "|---" * (1 + len(heads) + noted) + "|"
    for label, row in rows.items():
        notes = ["; ".join(dict.fromkeys(each.note for each in row.values() if each.note))] * noted
        values = [in_digits(row[each].value) if each in row else DASH for each in columns]
        yield "| " + " | ".join([label, *values, *notes]) + " |"


def in_digits(value: float) -> str:
    """Return a value in three digits, whole numbers and large ones in theirs, without a 0 before the point."""
    if not math.isfinite(value):
        return DASH
    # In three digits 999.5 is a thousand.
    text = f"{value:.0f}" if abs(value) >= 999.5 or value == round(value) else f"{value:#.3g}"
    return re.sub(r"^(-?)0\.", r"\1.", text).removesuffix(".")
