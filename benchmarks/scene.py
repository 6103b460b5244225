"""From photographs to features: Gaussians of real photographs, the rasterizer, symmetries, and the way to a field."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import torch

from avmsf.capture import Capture, read_capture, write_capture
from avmsf.evaluation.scores import evaluate
from avmsf.evaluation.splits import split
from avmsf.features.encoder import ImageDescriptors
from avmsf.features.pooling import orbit_spread, refine
from avmsf.field.config import FitConfig
from avmsf.field.store import load
from avmsf.gaussians.config import SplatConfig
from avmsf.mesh.textured_mesh import TexturedMesh
from avmsf.photographs.folder import write_views
from avmsf.pipeline.config import LiftConfig, PipelineConfig, SceneConfig, ViewsConfig
from avmsf.pipeline.features import finish_features, lift_features
from avmsf.pipeline.fit import fit_in_stages
from avmsf.pipeline.stages import StageFolder
from avmsf.symmetry.symmetries import Symmetries
from benchmarks.dino import dino
from benchmarks.look import SHAPES, pictures, shape, slab, speckled
from benchmarks.objects import STRUCK
from benchmarks.processes import timed
from benchmarks.rasterizer import rasterizer
from benchmarks.records import Measurement, Record, Settings, records
from benchmarks.symmetry import held_out, symmetry


def _consistency(settings: Settings) -> Iterator[Record]:
    """Spread of features over orbits: how much they differ over a point's symmetric places, before and after pooling.

    Root of the mean variance of descriptors, in the features' own spread over the object; 36 pictures of 128 x 128 of
    gray shapes under one light. axes, planes: symmetries that were found.
    """
    size, count, points = (48, 12, 800) if settings.quick else (128, 36, 4096)
    for name in SHAPES:
        surface = shape(name)
        views = pictures(TexturedMesh.plain(surface), count=count, size=size)
        lifted = lift_features(surface, views, ImageDescriptors(), LiftConfig(points=points))
        _, made = finish_features(lifted, LiftConfig(positions=False))
        symmetries = Symmetries.from_dict(made["symmetries"])
        before = after = float("nan")
        if symmetries:
            before = orbit_spread(lifted.features, symmetries)
            after = orbit_spread(refine(lifted.features, symmetries), symmetries)
        values = {"axes": len(symmetries.rotations), "planes": len(symmetries.mirrors)}
        yield from records({**values, "before": before, "after": after}, object=name)


def _pipeline(settings: Settings) -> Iterator[Record]:
    """Seconds of each stage from 60 pictures of 256 x 256 and 8 recordings of 3 s of a slab to a field.

    Default settings, built-in descriptors. error: relative STFT error at the 32 contacts that were not recorded.
    """
    count, size, seconds = (12, 48, 0.25) if settings.quick else (60, 256, 3.0)
    config = PipelineConfig(scene=SceneConfig(ViewsConfig(), SplatConfig(), LiftConfig(encoder="descriptors")))
    if settings.quick:
        quick = SceneConfig(ViewsConfig(), SplatConfig(steps=30, start_points=500), config.scene.lift)
        config = PipelineConfig(scene=quick, fit=FitConfig(warmup_steps=20, steps=2, damping="shared"))
    with tempfile.TemporaryDirectory() as temporary:
        folder, views = Path(temporary) / "slab", Path(temporary) / "views"
        train, test = split(STRUCK.strikes(40, seconds=seconds), 8)
        write_capture(Capture("slab", train), folder)
        write_views(pictures(speckled(slab(STRUCK.plate), seed=0), count=count, size=size), views)
        for each in sorted(views.iterdir()):
            each.rename(folder / each.name)
        cache = StageFolder(Path(temporary) / "cache")
        made, taken = timed(lambda: fit_in_stages(read_capture(folder), config, cache))
        error = evaluate(load(made.field), test).mean()["relative_stft"]
    stages = {f"{Path(name).stem}_seconds": each.seconds for name, each in made.stages.items()}
    note = f"{torch.get_num_threads()} threads"
    yield from records({**stages, "seconds": taken, "error": error}, note=note)


PARTS: dict[str, Measurement] = {
    "dino": dino,
    "rasterizer": rasterizer,
    "symmetry": symmetry,
    "held-out": held_out,
    "consistency": _consistency,
    "pipeline": _pipeline,
}
