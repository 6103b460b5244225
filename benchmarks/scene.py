"""From photographs to features: Gaussians of real photographs, the rasterizer, symmetries, and the way to a field."""

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from avmsf._utils.progress import ProgressListener
from avmsf.capture import Capture, read_capture, write_capture
from avmsf.evaluation.scores import evaluate
from avmsf.evaluation.splits import split
from avmsf.features.pooling import orbit_spread, refine
from avmsf.field.config import FitConfig
from avmsf.field.store import load
from avmsf.gaussians.config import SplatConfig
from avmsf.mesh.textured_mesh import TexturedMesh
from avmsf.photographs.folder import write_views
from avmsf.pipeline.config import LiftConfig, PipelineConfig, SceneConfig, ViewsConfig
from avmsf.pipeline.features import finish_features
from avmsf.pipeline.fit import fit_in_stages
from avmsf.pipeline.stages import StageFolder
from avmsf.symmetry.symmetries import Symmetries
from benchmarks.dino import measure_dino
from benchmarks.look import SHAPES, lift_pictures, pictures, shape, slab, speckled
from benchmarks.material import STRUCK
from benchmarks.rasterizer import measure_rasterizer
from benchmarks.report import Options, Report, Table, log
from benchmarks.symmetry import measure_symmetry


def measure(options: Options) -> Report:
    """Return the figures of the chosen parts."""
    report = Report()
    for part in options.parts:
        report += PARTS[part](options)
    return report


def _symmetry(options: Options) -> Report:
    return measure_symmetry(replace(options, parts=("made", "scanned")))


def _held_out(options: Options) -> Report:
    return measure_symmetry(replace(options, parts=("held-out",)))


def _consistency(options: Options) -> Report:
    """Say how much features differ over orbits, before and after pooling, on plain shapes under one light."""
    size, count, points = (48, 12, 800) if options.quick_look else (128, 36, 4096)
    rows: list[list[str | float]] = []
    figures: dict[str, float] = {}
    for name in SHAPES:
        surface = shape(name)
        views = pictures(TexturedMesh.plain(surface), count=count, size=size)
        lifted = lift_pictures(surface, views, points=points)
        _, made = finish_features(lifted, LiftConfig(positions=False))
        symmetries = Symmetries.from_dict(made["symmetries"])
        found = len(symmetries.rotations), len(symmetries.mirrors)
        if symmetries:
            before = orbit_spread(lifted.features, symmetries)
            after = orbit_spread(refine(lifted.features, symmetries), symmetries)
        else:
            before = after = float("nan")
        key = f"consistency.{name.replace(' ', '_')}"
        figures |= {f"{key}.before": before, f"{key}.after": after}
        rows.append([name, float(found[0]), float(found[1]), before, after])
        log(f"{name}: {before:.3f} before, {after:.3f} after")
    convention = (
        "consistency: root of the mean variance of descriptors over a point's symmetric places, in the features' own "
        f"spread over the object; {count} pictures of {size} x {size} of gray shapes under one light."
    )
    table = Table("spread of features over orbits", ("shape", "axes", "planes", "before", "after"), rows)
    return Report((convention,), (table,), figures)


def _pipeline(options: Options) -> Report:
    """Go from 60 pictures and 8 recordings of a slab to a field, and say what each stage took."""
    count, size, seconds = (12, 48, 0.25) if options.quick_look else (60, 256, 3.0)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "slab"
        train, test = split(STRUCK.strikes(40, seconds=seconds), 8)
        write_capture(Capture("slab", train), folder)
        write_views(pictures(speckled(slab(STRUCK.plate), seed=0), count=count, size=size), Path(place) / "views")
        for part in sorted((Path(place) / "views").iterdir()):
            part.rename(folder / part.name)
        config = PipelineConfig(scene=SceneConfig(ViewsConfig(), SplatConfig(), LiftConfig(encoder="descriptors")))
        if options.quick_look:
            quick = SceneConfig(ViewsConfig(), SplatConfig(steps=30, start_points=500), config.scene.lift)
            config = PipelineConfig(scene=quick, fit=FitConfig(warmup_steps=20, steps=2, damping="shared"))
        begun = time.perf_counter()
        capture = read_capture(folder)
        made = fit_in_stages(capture, config, StageFolder(Path(place) / "cache"), listener=ProgressListener(log))
        taken = time.perf_counter() - begun
        error = evaluate(load(made.field), test).mean()["relative_stft"]
    rows: list[list[str | float]] = [[name, each.seconds] for name, each in made.stages.items()]
    title = f"{count} pictures of {size} x {size}, 8 recordings of {seconds:g} s: images to field, seconds"
    figures = {"pipeline.seconds": taken, "pipeline.error": error}
    figures |= {f"pipeline.{Path(name).stem}_seconds": each.seconds for name, each in made.stages.items()}
    convention = (
        f"pipeline: default settings, built-in descriptors; {torch.get_num_threads()} threads; pipeline.error: "
        f"relative STFT error at the {len(test)} contacts that were not recorded."
    )
    return Report((convention,), (Table(title, ("stage", "seconds"), [*rows, ["in all", taken]]),), figures)


PARTS: dict[str, Callable[[Options], Report]] = {
    "dino": measure_dino,
    "rasterizer": measure_rasterizer,
    "symmetry": _symmetry,
    "held-out": _held_out,
    "consistency": _consistency,
    "pipeline": _pipeline,
}
