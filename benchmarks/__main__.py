"""`python -m benchmarks NAME`: the measurements behind the figures in the documentation."""

import argparse
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from avmsf._utils.device import TRAINABLE
from avmsf.errors import AvmsfError, CaptureWarning
from avmsf.simulate.recipe import HELD_OUT, SIM20
from benchmarks import (
    align,
    baselines,
    extract,
    field,
    gains,
    physics,
    proof,
    residual,
    robustness,
    scene,
    speed,
    step,
    studio,
    suggest,
    surface,
    tasks,
)
from benchmarks.material import MissingDataError
from benchmarks.report import Options, show

BENCHMARKS: dict[str, ModuleType] = {
    "align": align,
    "baselines": baselines,
    "field": field,
    "gains": gains,
    "extract": extract,
    "speed": speed,
    "step": step,
    "scene": scene,
    "proof": proof,
    "suggest": suggest,
    "surface": surface,
    "physics": physics,
    "residual": residual,
    "tasks": tasks,
    "studio": studio,
    "robustness": robustness,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one benchmark and return the exit code: 0, or 2 for arguments or data that cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("name", choices=tuple(BENCHMARKS), help="which benchmark to run")
    parser.add_argument(
        "--parts", nargs="+", metavar="PART", help="run only these: " + "; ".join(map(_parts_of, BENCHMARKS))
    )
    parser.add_argument(
        "--quick-look", action="store_true", help="small settings, to see that everything runs; the output says so"
    )
    parser.add_argument(
        "--paper-minutes",
        type=float,
        default=6.0,
        help="speed: minutes for a real run of the paper's recipe (default 6)",
    )
    parser.add_argument(
        "--sim-20",
        type=Path,
        metavar="FOLDER",
        help="baselines, gains, residual, surface: objects that `avmsf simulate` has made of a set; surface and the "
        "photographs of gains need it, the others simulate them again without it",
    )
    parser.add_argument(
        "--objects",
        nargs="+",
        default=(),
        choices=tuple(SIM20 | HELD_OUT),
        metavar="NAME",
        help="baselines, gains: some of these objects",
    )
    parser.add_argument(
        "--clouds",
        type=Path,
        metavar="FOLDER",
        help="gains, surface: keep the Gaussians fitted to the objects here; without it they are made again",
    )
    parser.add_argument(
        "--weights",
        type=Path,
        metavar="FILE",
        help="baselines: weights of sonicgauss-small, which the part sonicgauss-training makes",
    )
    parser.add_argument("--device", default="cpu", choices=TRAINABLE, help="step: where (default cpu)")
    chosen = parser.parse_args(arguments)
    benchmark = BENCHMARKS[chosen.name]
    parts = tuple(chosen.parts or benchmark.PARTS)
    unknown = [part for part in parts if part not in benchmark.PARTS]
    if unknown:
        parser.error(f"{chosen.name} has no part {', '.join(unknown)}; it has {', '.join(benchmark.PARTS)}")
    if not chosen.paper_minutes > 0:
        parser.error(f"--paper-minutes is {chosen.paper_minutes:g}; expected a number above 0")
    options = Options(
        parts,
        chosen.quick_look,
        chosen.paper_minutes,
        chosen.sim_20,
        tuple(chosen.objects),
        chosen.clouds,
        chosen.weights,
        chosen.device,
    )
    # Remarks on a capture are `avmsf check`'s business.
    warnings.simplefilter("ignore", CaptureWarning)
    try:
        report = benchmark.measure(options)
    except (AvmsfError, MissingDataError) as error:
        print(f"benchmarks {chosen.name}: {error}", file=sys.stderr)
        return 2
    show(report, options, name=chosen.name)
    return 0


def _parts_of(name: str) -> str:
    return f"{name}: {', '.join(BENCHMARKS[name].PARTS)}"


if __name__ == "__main__":
    sys.exit(main())
