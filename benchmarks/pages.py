"""Pages whose tables are written from the stored records, between `<!-- measured: WHAT -->` and `<!-- end -->`.

WHAT are parts, such as `gains.captures`; after them `| rows PATTERN` and `| columns NAME; NAME` choose what is shown of
them. `results` is a table of all kinds of objects, `overview` one of all parts.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatch
from functools import cache

from benchmarks.records import DASH, NAMES, REPOSITORY, Record, described, in_digits, markdown, parts_of, row_of, stored

STORED = REPOSITORY / "docs" / "benchmarks"
PAGES = tuple(REPOSITORY / f"{each}.md" for each in ("README", "docs/baselines", "docs/benchmarks", "docs/scale"))
MARKED = re.compile(r"(<!-- measured: (.+?) -->\n).*?(<!-- end -->)", re.DOTALL)
RESULTS = (
    ("measured aircraft, 8", "gains.captures.8", "aircraft_response", "", ""),
    ("measured aircraft, 15", "gains.captures.15", "aircraft_response", "", ""),
    ("measured aircraft, 28", "gains.captures.28", "aircraft_response", "", ""),
    ("measured ruler, 7", "gains.captures.7", "ruler10", "", ""),
    ("measured tree, no mesh, 20", "gains.captures.20", "tree43", "", ""),
    ("clamped strip, hammer, 10", "gains.captures.10", "strip30", "", ""),
    ("clamped strip, shaker, 10", "gains.captures.10", "strip30_shaker", "", ""),
    ("20 simulated objects, 8", "gains.sim20.mean", "", "", "evaluation.farthest"),
    ("20 simulated objects, 4", "gains.sim20.mean", "", "_4", ""),
    ("20 simulated objects, 2", "gains.sim20.mean", "", "_2", ""),
    ("20 simulated objects, 1", "gains.sim20.mean", "", "_1", "evaluation.one-impact"),
    ("20 from photographs, 8", "gains.sim20-photographs.mean", "", "", ""),
    ("5 of other kinds, 8", "gains.held-out.mean", "", "", ""),
    ("5 of other kinds, from photographs, 8", "gains.held-out-photographs.mean", "", "", ""),
)
"""Rows of the table of results: title, the names' beginning, object, the end of the name of an error, and the part that
has what the first has not."""
METHODS = {
    "nearest recording": ("{group}.mean of 1{end}", "{other}.nearest.relative_stft"),
    "mean waveform of 3 nearest": ("{group}.mean of 3{end}", "{group}.averaging{end}", "{other}.knn3.relative_stft"),
    "best of eight simple methods, in hindsight": ("{group}.best simple{end}",),
    "**avmsf's default**": ("{group}.mixture{end}", "{group}.error{end}"),
    "held-out gains in intervals of 90 %": ("{group}.coverage{end}",),
}
"""Columns of the table of results: names of the records, of which an object has one."""


def write_pages() -> None:
    """Write the tables of all pages."""
    for page in PAGES:
        page.write_text(written(page.read_text(encoding="utf-8")), encoding="utf-8")


def written(text: str) -> str:
    """Return a page's text with what the records say between its marks."""
    said = set[str]()

    def block(found: re.Match[str]) -> str:
        what, *words = found[2].split(" | ")
        options = dict(each.split(" ", 1) for each in words)
        lines = {"results": _results, "overview": _overview}.get(what) or (lambda: _parts(what.split(), options, said))
        return "\n\n".join((found[1].rstrip(), *lines(), found[3]))

    return MARKED.sub(block, text)


def parts() -> list[str]:
    """Return the names of all parts."""
    return [f"{name}.{part}" for name in NAMES for part in parts_of(name)]


@cache
def _records(part: str) -> tuple[Record, ...]:
    return tuple(stored(STORED / f"{part}.jsonl"))


def _parts(names: Sequence[str], options: Mapping[str, str], said: set[str]) -> Iterator[str]:
    """Yield what each part measures, unless that has been said, its table, and where it is from."""
    for part in filter(_records, names):
        text, found = described(parts_of(part.split(".")[0])[part.split(".")[1]]), _records(part)
        if text not in said:
            yield text
        said.add(text)
        shown = [each for each in found if fnmatch(row_of(each), options.get("rows", "*"))]
        yield markdown(shown, options["columns"].split("; ") if "columns" in options else ())
        if failures := [each for each in found if each.name.endswith(".failure")]:
            yield f"Without {'; '.join(f'{each.object}: {each.note}' for each in failures)}"
        yield f"{_command([part])}, commit {_commits(found)}; [records](benchmarks/{part}.jsonl)"
    yield from _missing(names)


def _results() -> Iterator[str]:
    """Yield the table of results, without methods that have none, and what of it is missing."""
    rows, used, asked = list[tuple[str, list[Record | None]]](), list[Record](), dict[str, None]()
    for title, group, thing, end, other in RESULTS:
        known = {(each.name, each.object): each for part in (_part_of(group), other) for each in _records(part)}
        names = [[name.format(group=group, end=end, other=other) for name in column] for column in METHODS.values()]
        cells = [next((known[name, thing] for name in column if (name, thing) in known), None) for column in names]
        asked |= dict.fromkeys(filter(None, (_part_of(group), other)))
        if any(cells):
            rows.append((title, cells))
            used += filter(None, cells)
    shown = [column for column in range(len(METHODS)) if any(cells[column] for _, cells in rows)]
    lines = [[" ", *(list(METHODS)[column] for column in shown)], ["---"] * (1 + len(shown))]
    for title, cells in rows:
        found = [cells[column] for column in shown]
        lines.append([title, *(DASH if each is None else in_digits(each.value) for each in found)])
    yield "\n".join(f"| {' | '.join(line)} |" for line in lines)
    sources = dict.fromkeys(_part_of(each.name) for each in used)
    yield "; ".join(f"{_command([part])}, commit {_commits(_records(part))}" for part in sources)
    yield from _missing(asked)


def _part_of(name: str) -> str:
    return ".".join(name.split(".")[:2])


def _missing(names: Iterable[str]) -> Iterator[str]:
    """Yield the sentence on parts without records, if any."""
    missing = [each for each in names if not _records(each)]
    if missing:
        yield f"No records yet of: {_command(missing)}"


def _overview() -> Iterator[str]:
    """Yield which parts have records, and their commits and machines."""
    found = {part: _records(part) for part in parts()}
    lines = ["| `python -m benchmarks` | parts with records | without |", "|---|---|---|"]
    for name in NAMES:
        own = {part.partition(".")[2]: known for part, known in found.items() if part.partition(".")[0] == name}
        cells = [" ".join(f"`{part}`" for part in own if bool(own[part]) == has) or DASH for has in (True, False)]
        lines.append(f"| `{name}` | {' | '.join(cells)} |")
    yield "\n".join(lines)
    every = [each for known in found.values() for each in known]
    yield f"Commits of the records: {_commits(every)}. Machines: {_listed(each.machine for each in every)}."


def _command(names: Iterable[str]) -> str:
    """Return the commands that measure parts, one for each benchmark."""
    of: dict[str, list[str]] = {}
    for name, _, part in (each.partition(".") for each in names):
        of.setdefault(name, []).append(part)
    return ", ".join(f"`python -m benchmarks {name} --parts {' '.join(each)}`" for name, each in of.items())


def _commits(found: Iterable[Record]) -> str:
    return _listed(each.commit for each in found)


def _listed(values: Iterable[str]) -> str:
    """Return the different values, the most frequent first."""
    found = [each for each in values if each]
    return ", ".join(sorted(set(found), key=lambda each: (-found.count(each), each))) or "none"
