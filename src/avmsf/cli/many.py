"""One verb for many inputs: each in a process of its own, and a table of what came of them.

The folder of `--output` has a file or folder for each input, by its name, next to the record of what it was made from:
what is complete is not made again. It also has `results.csv`, a row for each input, with the reason where it failed.
"""

import io
import json
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, fields, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

from avmsf._utils.caching import source_digest
from avmsf._utils.files import write_whole
from avmsf._utils.text import counted, csv_text
from avmsf.cli.options import Common, option_of
from avmsf.cli.output import display, finish, note, show_plainly, table
from avmsf.cli.paths import Existing, InputError, New, OutputError, arg
from avmsf.errors import NO_MEMORY, AvmsfError, lacks_memory

RESULTS = "results.csv"
Values = Mapping[str, Any]
M = TypeVar("M", bound="Many")


@dataclass(frozen=True, kw_only=True)
class Many(Common, ABC):
    """Options of the verbs that take many inputs."""

    workers: Annotated[int, arg("N")] = 1
    """So many at a time; of 2 or more, -o is a folder."""
    ray: Annotated[str | None, arg("ADDRESS")] = None
    """A ray cluster with the same paths, -o a folder."""
    inputs: tuple[Path, ...]
    """What has an output each."""
    output: Path | None
    """The output of a single input, or the folder of those of several or of workers."""
    alone: ClassVar[tuple[str, ...]]
    """Options that only one input can have."""

    @abstractmethod
    def of(self: M, given: Path, output: Path) -> M:
        """Return the options for one of the inputs, whose output is `output` and the ending of its format."""

    @abstractmethod
    def cells(self, values: Values) -> Mapping[str, str]:
        """Return what the table shows of an input's result, by the heads of its columns."""

    def read(self) -> Iterator[Path]:
        """Return the files and folders on whose content the output depends."""
        for _, mark, paths in self.marked_paths():
            if isinstance(mark, Existing):
                yield from paths

    def check_paths(self) -> None:
        """Raise as `Common`, of several inputs for what they share: what is wrong with one of them costs it alone."""
        if not self.inputs:
            raise InputError.expected("1 or more", 0, got="none", name="inputs")
        super(Many, replace(self, inputs=()) if self.several else self).check_paths()
        if self.several:
            self.tasks()

    @property
    def several(self) -> bool:
        """Whether the output is a folder: of several inputs, and of one where workers are asked for."""
        return len(self.inputs) > 1 or self.workers > 1 or self.ray is not None

    def tasks(self: M) -> dict[str, M]:
        """Return the options for each input, by its name.

        Raises `OutputError` without a folder for outputs, and `InputError` for two inputs of one name, and for an
        option that only one input can have.
        """
        folder = self.output
        if folder is None:
            raise OutputError.expected("a folder for what is made of each input", name="--output")
        New().check(folder)
        for each in fields(self):
            if each.name in self.alone and getattr(self, each.name) != each.default:
                name, wanted = option_of(each.name), "none where the output is a folder"
                raise InputError.expected(wanted, got="one", name=name, advice="leave it out")
        made: dict[str, M] = {}
        for given in self.inputs:
            name = given.resolve().name if given.is_dir() else given.stem
            if name in made:
                raise InputError.expected("inputs of different names", name, file=given, advice="rename one")
            made[name] = _absolute(replace(self.of(given, folder / name), workers=1, ray=None))
        return made


def run_many(verb: str, options: Many, *, raising: type[AvmsfError]) -> int:
    """Do a verb's work for each of its inputs that is not done yet; print a table, and return 2 where one failed."""
    from avmsf._utils.parallel import run_tasks, workers_at
    from avmsf.pipeline.stages import StageFolder

    folder, tasks = options.output, options.tasks()
    assert folder is not None
    shown = display.objects()
    found: dict[str, dict[str, Any]] = {}

    def take(name: str, outcome: Values | Exception) -> None:
        found[name] = _failed(outcome) if isinstance(outcome, Exception) else dict(outcome)
        for each in found[name]["notes"]:
            note(f"{name}: {each}")
        shown(f"{name}: {found[name]['state']}", len(found), len(tasks))

    def doing(text: str) -> None:
        shown(text, len(found), len(tasks))

    with (
        StageFolder(folder, "--output").lock(f"avmsf {verb}"),
        workers_at(options.workers, options.ray, raising=raising) as workers,
    ):
        try:
            run_tasks(partial(_make, verb), tasks, workers, take, doing)
        finally:
            rows = [_row(options, name, found.get(name, {"state": "not reached"})) for name in tasks]
            if found:
                cells = [list(rows[0]), *(row.values() for row in rows)]
                write_whole(folder / RESULTS, csv_text(cells), raising=OutputError)
    failures = [row for row in rows if row["failure"]]
    heads = [each for each in rows[0] if each != "failure"]
    title = f"{counted(len(rows), 'input')}, {len(failures)} failed"
    lines = [table(title, heads, [[row[each] for each in heads] for row in rows])]
    lines += [f"failed: {row['name']}: {row['failure']}" for row in failures]
    text, values = "\n".join([*lines, f"wrote {folder / RESULTS}"]), {"output": str(folder), "results": found}
    again = ["the same command tries again what failed; what is done is kept"] if failures else []
    return finish(text, values, *again, code=2 if failures else 0)


def _make(verb: str, options: Many) -> dict[str, Any]:
    """Return what a verb prints for one input, from the record of its output where that was made of the same."""
    from avmsf.pipeline.stages import Stage, StageFolder, digest_of

    options.check_paths()
    # What is read counts by its content, and where stages are kept decides nothing.
    ignored = {"overwrite", "cache", *(each.name for each in fields(Many))}
    ignored |= {name for name, mark, _ in options.marked_paths() if isinstance(mark, Existing)}
    given = {each.name: getattr(options, each.name) for each in fields(options) if each.name not in ignored}

    def recipe() -> dict[str, Any]:
        read = [digest_of(path) for path in options.read()]
        plain = json.loads(json.dumps(given, default=str))
        return {"source": source_digest(f"{__package__}.{verb}"), "options": plain, "read": read}

    output = options.output
    assert output is not None
    stage = Stage(output.name, lambda path: _printed(verb, options), recipe=recipe)
    kept = StageFolder(output.parent, "--output").keep(stage)
    return {"state": "done" if kept.fresh else "as before", "seconds": kept.seconds, **kept.values}


def _printed(verb: str, options: Many) -> dict[str, Any]:
    """Run a verb, and return the object that it prints with --json, with its notes."""
    display.shown, display.json = False, True
    with redirect_stdout(io.StringIO()) as results, redirect_stderr(io.StringIO()) as lines, warnings.catch_warnings():
        show_plainly()
        options.check_inputs()
        import_module(f"{__package__}.{verb}").run(options)
    notes = [line.removeprefix("note: ") for line in lines.getvalue().splitlines() if line.startswith("note: ")]
    return {**json.loads(results.getvalue()), "notes": notes}


def _failed(error: Exception) -> dict[str, Any]:
    """Return why an input failed, on one line; of a fault of the program also where, as notes."""
    known = isinstance(error, AvmsfError)
    reason = str(error) if known else NO_MEMORY if lacks_memory(error) else f"{type(error).__name__}: {error}"
    notes = [] if known or reason == NO_MEMORY else getattr(error, "__notes__", [])
    return {"state": "failed", "failure": " ".join(reason.split()), "notes": notes}


def _row(options: Many, name: str, values: Values) -> dict[str, str]:
    cells = {head: str(cell) for head, cell in options.cells(values).items()}
    seconds = f"{values['seconds']:.1f}" if "seconds" in values else ""
    return {"name": name, "state": values["state"], "seconds": seconds, **cells, "failure": values.get("failure", "")}


def _absolute(options: M) -> M:
    """Return options whose paths are absolute: workers may run in folders of their own."""

    def absolute(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(map(absolute, value))
        return value.resolve() if isinstance(value, Path) else value

    return replace(options, **{each.name: absolute(getattr(options, each.name)) for each in fields(options)})
