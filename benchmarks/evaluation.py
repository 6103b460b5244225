"""The paper's tables on simulated objects, by `avmsf evaluate`: means over objects, and ratios to the mean of three."""

import json
import math
import os
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import replace
from functools import partial
from typing import Any

from avmsf.cli import main
from avmsf.cli.evaluate import FAILED
from avmsf.evaluation.registry import METRICS, kind_of
from avmsf.evaluation.report import SUMMARY
from avmsf.evaluation.results import ResultsFolder
from avmsf.evaluation.tables import times_of, values_of
from avmsf.features.efficientnet import NAME as EFFICIENTNET
from avmsf.pipeline.config import DESCRIPTORS
from avmsf.simulate.recipe import ABLATED, NON_SYMMETRIC, SET, SIM20
from avmsf.simulate.simulation_folder import simulate_set
from benchmarks.records import MissingDataError, Record, Settings, means, records
from benchmarks.small_sonicgauss import NAME as SMALL

SIMPLE = "nearest,knn3,knn-gains,spline-gains"
DIFFSOUND = "diffsound,diffsound-weighted"


def _evaluate(
    settings: Settings,
    part: str,
    protocol: str,
    methods: str,
    names: tuple[str, ...] = tuple(SIM20),
    encoder: str = DESCRIPTORS,
    paper: bool = False,
    counts: str = "",
) -> Iterator[Record]:
    """Means over objects of sim-20, exact meshes, seed 0, by `avmsf evaluate`.

    ratio: over the mean of three, geometric means; median: over contacts. What failed is left out, and named. Features
    are descriptors, for want of DINOv2; vision: six objects, features of EfficientNet-Lite0 trained on ImageNet. shots:
    six objects; one-impact: all, one training impact; localize: those without rotational symmetry. Parts that begin
    with paper: three objects (paper-regularized: all), recordings of .5 s at 16 kHz from their peaks, with which the
    preset `paper` is trained to its end. seconds: of one thread an object, in all cases, to fit, and to render all test
    contacts. Noise is of low fluctuation in fields and DiffSound, and Gaussian in `paper`, knn-gains and spline-gains.
    """
    if SMALL in methods:
        if not settings.weights.is_file():
            raise MissingDataError(f"no weights at {settings.weights}: run python -m benchmarks baselines first")
        methods = methods.replace(SMALL, f"{SMALL}:{settings.weights}")
    chosen = settings.objects or settings.some(names, 6 if protocol == "edit" else 2)
    options = ["--visual-source", "mesh", "--no-cdpam", "--set", f"lift.encoder={encoder}"]
    if settings.quick:
        # Training with the paper's settings has no quick form.
        methods = ",".join(each for each in methods.split(",") if not each.startswith(("paper", "av-msf")))
        options += ["--set", "modes=8", "--set", "body.dofs=2000", "--set", "edit.guide.steps=5"]
    options += ["--time-zero", "peak"] * paper + ["--counts", counts] * bool(counts)
    objects = settings.kept / ("short" if paper else SET)
    shape: dict[str, Any] = {"views": 0, "sample_rate": 16000, "seconds": 0.5} if paper else {}
    # Random impacts and edits are of all objects of the folder.
    made = chosen if settings.quick else tuple(SIM20)
    simulate_set({each: replace(SIM20[each], **shape) for each in made}, objects)
    output = settings.kept / f"{'quick-' * settings.quick}{part}"
    words = ["evaluate", protocol, str(objects), "--methods", methods, "--objects", ",".join(chosen), *options]
    # All parts share what is made of an object: bodies, Gaussians and features.
    words += ["--cache", str(settings.kept / f"features-{objects.name}"), "--output", str(output)]
    words += ["--workers", str(os.cpu_count())]
    with redirect_stdout(sys.stderr):
        code = main(words)
    if code > 128:
        raise KeyboardInterrupt
    if code not in (0, FAILED):
        raise RuntimeError(f"avmsf {' '.join(words)} ended with {code}")
    summary, outcomes = json.loads((output / SUMMARY).read_text(encoding="utf-8")), ResultsFolder(output).records()
    for each in summary["failures"]:
        reason = ": ".join(filter(None, (each["method"], each["case"], each["failure"])))
        yield Record("failure", math.nan, "", "", each["object"], note=reason)
    several = len(summary["cases"]) > 1
    for case, found in summary["cases"].items():
        for method, values in found.items():
            yield from _records(values, kind_of(method), case if several else "")
    for group, of in (("ratio", "ratio_to_knn3"), ("median", "medians")):
        for method, values in summary[of].items():
            yield from _records(values, f"{group}.{kind_of(method)}")
    metric = "rmed" if protocol == "localize" else "relative_stft"
    for method, found in values_of(outcomes, summary["main_case"]).items():
        for name, value in found.get(metric, {}).items():
            yield Record(f"{metric}.{kind_of(method)}", value, object=name)
    times = [each["methods"] for each in times_of(outcomes).values()]
    for method in dict.fromkeys(method for each in times for method in each):
        taken = means([each[method] for each in times if method in each])
        yield from records(
            {f"{step}_seconds": value for step, value in taken.items()}, group=f"seconds.{kind_of(method)}"
        )


def _records(values: dict[str, float], group: str, case: str = "") -> Iterator[Record]:
    for metric, value in values.items():
        rising = metric in METRICS and METRICS[metric].rising
        yield Record(f"{group}.{metric}", value, "", "higher" if rising else "lower", case)


_paper = partial(_evaluate, names=ABLATED[:3], paper=True)
_PARTS: dict[str, partial[Iterator[Record]]] = {
    "farthest": partial(
        _evaluate, protocol="farthest", methods=f"white-noise,random-impact,{SIMPLE},{DIFFSOUND},field,field-auto"
    ),
    "closest": partial(_evaluate, protocol="closest", methods="knn3,field,field-auto"),
    "shots": partial(_evaluate, protocol="shots", methods=f"{SIMPLE},{DIFFSOUND},field-auto", names=ABLATED),
    "one-impact": partial(_evaluate, protocol="shots", methods=f"knn3,{DIFFSOUND},field-auto", counts="1"),
    "vision": partial(_evaluate, protocol="farthest", methods="knn3,field", names=ABLATED, encoder=EFFICIENTNET),
    "localize": partial(
        _evaluate,
        protocol="localize",
        methods="white-noise,nearest,diffsound,field-auto",
        names=tuple(each for each in SIM20 if each in NON_SYMMETRIC),
    ),
    "edit": partial(
        _evaluate, protocol="edit", methods="unedited,edit-independent,edit-published,edit-hierarchical,edit-physics"
    ),
    "sonicgauss": partial(_evaluate, protocol="farthest", methods=f"knn3,{SMALL}"),
    "paper": partial(
        _paper,
        protocol="farthest",
        methods="white-noise,random-impact,knn3,paper-diffsound,av-msf,paper,paper-per-contact,field-auto",
    ),
    "paper-regularized": partial(
        _paper, protocol="farthest", methods="knn3,paper,paper-mean-gains,paper-regularized", names=tuple(SIM20)
    ),
    "paper-ablation": partial(
        _paper,
        protocol="ablation",
        methods="knn3,paper,paper-positions,paper-no-initialization,paper-unaligned,paper-no-residual",
    ),
    "paper-shots": partial(_paper, protocol="shots", methods="knn3,paper-diffsound,paper,field-auto"),
    "paper-localize": partial(
        _paper,
        protocol="localize",
        methods="white-noise,paper-diffsound,paper,field-auto",
        names=tuple(each for each in ABLATED if each in NON_SYMMETRIC)[:3],
    ),
}
PARTS: dict[str, partial[Iterator[Record]]] = {part: partial(each, part=part) for part, each in _PARTS.items()}
