"""`python -m benchmarks NAME`: the measurements behind the values in the documentation."""

import argparse
import sys
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from avmsf.errors import AvmsfError, CaptureWarning
from benchmarks.pages import write_pages
from benchmarks.records import (
    NAMES,
    WORK,
    Measurement,
    MissingDataError,
    Settings,
    code_commit,
    described,
    machine,
    markdown,
    parts_of,
    store,
    stored,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one benchmark, or all, and return the exit code: 0, or 2 where a part could not be measured."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "name",
        choices=(*NAMES, "all", "tables"),
        help="which benchmark to run; tables: write the pages from docs/benchmarks",
    )
    parser.add_argument("--parts", nargs="+", metavar="PART", help="run only these")
    parser.add_argument("--output", type=Path, metavar="FOLDER", help="store the records, and skip parts stored there")
    parser.add_argument("--quick-look", dest="quick", action="store_true", help="small settings, to see that all runs")
    parser.add_argument("--objects", nargs="+", default=(), metavar="NAME", help="gains: some of these objects")
    parser.add_argument(
        "--work", type=Path, default=WORK, help="folder that keeps what parts share (default %(default)s)"
    )
    parser.add_argument("--device", default="cpu", help="step: where (default cpu)")
    chosen = vars(parser.parse_args(arguments))
    name, asked, output = (chosen.pop(key) for key in ("name", "parts", "output"))
    settings = Settings(**chosen | {"objects": tuple(chosen["objects"])})
    if name == "tables":
        write_pages()
        return 0
    if output is not None and (settings.quick or settings.objects):
        parser.error("--output stores whole measurements: leave --quick-look and --objects out")
    # Remarks on a capture are `avmsf check`'s business.
    warnings.simplefilter("ignore", CaptureWarning)
    failed = False
    for each in NAMES if name == "all" else (name,):
        parts = parts_of(each)
        unknown = [part for part in asked or () if part not in parts]
        if unknown:
            parser.error(f"{each} has no part {', '.join(unknown)}; it has {', '.join(parts)}")
        for part in asked or parts:
            try:
                _run(f"{each}.{part}", parts[part], settings, output)
            except Exception as error:  # other parts do not need this one
                failed = True
                known = isinstance(error, AvmsfError | MissingDataError)
                print(f"benchmarks {each}, {part}: {error if known else traceback.format_exc()}", file=sys.stderr)
    return 2 if failed else 0


def _run(name: str, measure: Measurement, settings: Settings, output: Path | None) -> None:
    """Print the records of one part: those that are stored for this commit, or measured now and stored."""
    commit, path = code_commit(), None if output is None else output / f"{name}.jsonl"
    found = [] if path is None else stored(path)
    failed = any(record.name.endswith(".failure") for record in found)
    if "+" in commit or not found or failed or any(record.commit != commit for record in found):
        found = []
        for each in measure(settings):
            found.append(replace(each, name=f"{name}.{each.name}", commit=commit, machine=machine()))
            print(f"{found[-1].name} {each.object}: {each.value:.4g} {each.note}", file=sys.stderr, flush=True)
        if path is not None:
            store(found, path)
    quick = "QUICK LOOK: these are not the benchmark's values. " * settings.quick
    print(f"## {name}\n\n{quick}{described(measure)}\n\n{markdown(found)}\n", flush=True)


if __name__ == "__main__":
    sys.exit(main())
