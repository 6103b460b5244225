"""Time and memory that each method of `avmsf evaluate` takes for one object, in a process of its own."""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from avmsf.cli import main as avmsf
from benchmarks.material import REPOSITORY
from benchmarks.report import Report, Table, log
from benchmarks.step import peak_gigabytes

CONVENTIONS = (
    "costs: one object, 8 of 40 impacts, exact mesh, nothing cached. shared_s: modes, and what the method needs of the "
    "object's shape and looks; fit_s: the method's own; render_ms: a sound; gigabytes: peak resident memory of "
    "the process in units of 10^9, of which imports_gb before any work.",
)
COLUMNS = ("shared_s", "fit_s", "render_ms", "gigabytes", "imports_gb")


def method_costs(root: Path, name: str, methods: Sequence[str], folder: Path) -> Report:
    """Return what each method takes for the object `name` of `root`; results and caches go to `folder`."""
    rows: list[list[str | float]] = []
    figures: dict[str, float] = {}
    for number, method in enumerate(methods):
        log(f"costs: {method}")
        command = [sys.executable, "-m", "benchmarks.costs", str(root), name, method, str(folder / f"{number}")]
        done = subprocess.run(command, cwd=REPOSITORY, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}; its message is above")
        found = json.loads(done.stdout.splitlines()[-1])
        title = method.partition(":")[0]
        rows.append([title, *(found[column] for column in COLUMNS)])
        figures |= {f"costs.{title}.{column}": found[column] for column in COLUMNS}
    return Report(CONVENTIONS, (Table(f"costs of {name}", ("method", *COLUMNS), rows),), figures)


def _main() -> int:
    root, name, method, folder = sys.argv[1:]
    imports = peak_gigabytes()
    results = Path(folder) / "results"
    words = ["farthest", root, "--objects", name, "--methods", method, "--visual-source", "mesh", "--no-cdpam"]
    ended = avmsf(["evaluate", *words, "--output", str(results), "--cache", f"{folder}/cache", "--quiet"])
    if ended != 0:
        return ended
    times = json.loads((results / "times.json").read_text(encoding="utf-8"))[name]
    own = times["methods"][method]
    record = json.loads(next((results / "objects").iterdir()).read_text(encoding="utf-8"))
    sounds = sum(len(each["test"]) for each in record["cases"])
    costs = {
        "shared_s": times["shared"],
        "fit_s": own["fit"],
        "render_ms": 1000 * own["render"] / sounds,
        "gigabytes": peak_gigabytes(),
        "imports_gb": imports,
    }
    print(json.dumps(costs))
    return 0


if __name__ == "__main__":
    sys.exit(_main())
