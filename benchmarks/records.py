"""Records of measurements: printed as Markdown tables, stored as JSON lines, one file a part."""

import json
import math
import re
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, TypeAlias, TypeVar

REPOSITORY = Path(__file__).resolve().parents[1]
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
}
"""Unit, and which way is better, by a word of a value's name; of a name without any: no unit, the lower the better."""
_Item = TypeVar("_Item")


class MissingDataError(Exception):
    """Data that a benchmark needs is not where it was looked for."""


@dataclass(frozen=True)
class Settings:
    """What a benchmark is run with."""

    quick: bool = False
    """Small settings that show that everything runs; the values are not the benchmark's then."""
    sim20: Path | None = None
    """Folder of the objects that `avmsf simulate` makes of a set; None to simulate them without photographs."""
    objects: tuple[str, ...] = ()
    """Some of these objects; none for all."""
    clouds: Path | None = None
    """Folder that keeps the Gaussians fitted to these objects."""
    weights: Path | None = None
    """File of the weights of sonicgauss-small."""
    device: str = "cpu"
    """What the steps of `step` are taken on."""

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


Measurement: TypeAlias = Callable[[Settings], Iterator[Record]]


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


def markdown(found: Sequence[Record]) -> str:
    """Return tables of records: one for all groups with the same columns, a row for each group and object."""
    rows: dict[tuple[str, str], dict[str, Record]] = {}
    for each in found:
        group, _, column = each.name.rpartition(".")
        rows.setdefault((group, each.object), {})[column] = each
    tables: dict[tuple[str, ...], list[tuple[tuple[str, str], dict[str, Record]]]] = {}
    for label, row in rows.items():
        tables.setdefault(tuple(row), []).append((label, row))
    return "\n\n".join("\n".join(_table(columns, lines)) for columns, lines in tables.items())


def _table(columns: Sequence[str], rows: Sequence[tuple[tuple[str, str], dict[str, Record]]]) -> Iterator[str]:
    noted = any(record.note for _, row in rows for record in row.values())
    first = rows[0][1]
    arrows = {"lower": " ↓", "higher": " ↑", "": ""}
    heads = [f"{each}{', ' * bool(first[each].unit)}{first[each].unit}{arrows[first[each].better]}" for each in columns]
    yield "| " + " | ".join(["", *heads, *["note"] * noted]) + " |"
    yield "|---" * (1 + len(heads) + noted) + "|"
    for label, row in rows:
        notes = ["; ".join(dict.fromkeys(each.note for each in row.values() if each.note))] * noted
        yield (
            "| "
            + " | ".join([", ".join(filter(None, label)), *(_text(row[each].value) for each in columns), *notes])
            + " |"
        )


def _text(value: float) -> str:
    return "–" if not math.isfinite(value) else f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"
