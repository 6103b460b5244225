"""From what a folder shows of the object to features on its surface: views, Gaussians, features, each kept."""

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from avmsf._utils.text import counted
from avmsf.capture.filenames import no_views
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import SceneError
from avmsf.features.encoder import Encoder
from avmsf.features.lift import Lifted
from avmsf.features.store import save_features
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.fit import SplatProgress, splat
from avmsf.gaussians.initialize import StartPoints
from avmsf.gaussians.ply import read_splats, write_splats
from avmsf.gaussians.prune import keep_object
from avmsf.gaussians.rasterizer.devices import choose_rasterizer
from avmsf.mesh.surface import read_surface
from avmsf.photographs import read_sparse_points, read_views, write_views
from avmsf.photographs.cameras import View
from avmsf.pipeline.cloud_shape import masks_suffice, shape_of_cloud, views_of_cloud
from avmsf.pipeline.config import SceneConfig
from avmsf.pipeline.features import choose_encoder, finish_features, lift_to_cloud, lift_to_surface
from avmsf.pipeline.sources import Source, find_source, find_splats, keep_views
from avmsf.pipeline.stages import Kept, StageFolder, digest_of
from avmsf.reconstruction import ObjectShape

VIEWS, CLOUD, FEATURES = "views", "cloud.ply", "features.safetensors"
"""What the stages call their outputs."""


def _ignore(*values: object) -> None:
    pass


@dataclass(frozen=True)
class ProgressListener:
    """Callbacks that receive the progress of the stages."""

    log: Callable[[str], None] = _ignore
    """Receives a sentence as each stage begins."""
    step: Callable[[str, int, int, str], None] = _ignore
    """Receives a stage's name, its steps done and in all, and a message on the last one."""
    counting: Callable[[str], None] = _ignore
    """Receives the number and name of each stage, see `StageFolder.count`."""

    def splatting(self, progress: SplatProgress) -> None:
        """Pass on how far Gaussians are fitted."""
        message = f"loss {progress.loss:.3g}, {progress.psnr:.1f} dB, {len(progress.cloud)} Gaussians"
        self.step("splat", progress.step, progress.steps, message)

    def lifting(self, done: int, total: int, view: str) -> None:
        """Pass on how many views are described."""
        self.step("features", done, total, view)


class SceneStages:
    """The stages that lead from a folder's photographs, video, mesh or Gaussians to features on the object.

    Gaussians that lie in the folder are the object's; where there are no photographs beside them, pictures of them from
    all sides are described. A mesh needs no Gaussians: its own surface is the object unless the settings say otherwise,
    and pictures of it are described. Every stage runs when its output is first asked for and raises what it raises;
    SceneError where the folder shows nothing of the object.
    """

    def __init__(
        self,
        folder: Path,
        stages: StageFolder,
        config: SceneConfig,
        *,
        settings: CaptureSettings,
        listener: ProgressListener | None = None,
        name: str = FEATURES,
        device: str | None = None,
    ) -> None:
        """Prepare the stages; `name` is what the features' file is called, for several may share their Gaussians.

        Gaussians and DINOv2 are computed on `device`, by default on a GPU where there is one.
        """
        self.device = device
        self.folder, self.stages, self.config, self.settings, self.name = folder, stages, config, settings, name
        self.listener = ProgressListener() if listener is None else listener
        found = find_source(folder, settings, prefer=config.views.source)
        preferred = config.views.source == "mesh" and found is not None and found.kind == "mesh"
        self.splats = None if preferred else find_splats(folder)
        self.source: Source | None = None if self.splats and found and found.kind == "mesh" else found

    def __bool__(self) -> bool:
        """Whether the folder shows anything of the object."""
        return self.source is not None or self.splats is not None

    def expect_any(self) -> None:
        """Raise SceneError, before anything is written, where the folder shows nothing of the object."""
        if not self:
            self._source()

    @property
    def outputs(self) -> tuple[str, ...]:
        """The outputs on the way to features, in order, the features last."""
        if self.source is None:
            return CLOUD, VIEWS, self.name
        motion = ("motion",) if self.source.kind in ("photographs", "video") else ()
        return (*motion, VIEWS, *(() if self._on_mesh else (CLOUD,)), self.name)

    @property
    def _on_mesh(self) -> bool:
        """Whether features lie on the mesh, so that no Gaussians are needed."""
        return self.splats is None and self._source().kind == "mesh" and self.config.lift.onto == "mesh"

    @cached_property
    def views(self) -> Kept:
        """The folder of views."""
        if self.splats is not None and self.source is None:
            return self._keep_views_of_cloud()
        return keep_views(self._source(), self.stages, self.config.views, settings=self.settings, log=self.listener.log)

    @cached_property
    def cloud(self) -> Kept:
        """The file of Gaussians: the folder's own, or fitted to its views, those of a mesh included."""
        if self.splats is not None:
            return self._keep_given(self.splats)
        views = read_views(self.views.path)
        start = self._start(views)

        def make(path: Path) -> None:
            self.listener.log(f"splat: {counted(self.config.splat.steps, 'step')} on {len(views)} views")
            cloud = splat(
                views,
                self.config.splat,
                start=start,
                progress=self.listener.splatting,
                checkpoint=self.stages.checkpoint(CLOUD),
                device=self.device,
            )
            write_splats(cloud, path)

        begun = None if start is None else hashlib.sha256(start.points.numpy().tobytes()).hexdigest()
        recipe = {"views": self.views.digest, "splat": asdict(self.config.splat), "start": begun}
        return self.stages.keep(CLOUD, recipe, make)

    @cached_property
    def features(self) -> Kept:
        """The file of features, on the Gaussians or on points of the mesh."""
        encoder = choose_encoder(self.config.lift, log=self.listener.log, device=self.device)
        on_mesh = self._on_mesh
        recipe = {
            "views": self.views.digest,
            "cloud": None if on_mesh else self.cloud.digest,
            "encoder": encoder.name,
            "lift": asdict(self.config.lift),
        }

        def make(path: Path) -> None:
            views = read_views(self.views.path)
            lifted = self._lift_to_mesh(views, encoder) if on_mesh else self._lift_to_cloud(views, encoder)
            made = finish_features(lifted, self.config.lift)
            save_features(made.features, path, report={**made.report, "scene": asdict(self.config)})

        return self.stages.keep(self.name, recipe, make)

    def shape(self) -> ObjectShape:
        """Return the object's shape, of its views' masks and its Gaussians' depth.

        Where fewer than 3 views have masks, pictures of the Gaussians stand for them.
        """
        views, cloud = read_views(self.views.path), read_splats(self.cloud.path)
        source = (
            f"{len(views)} views"
            if masks_suffice(views)
            else "images of the Gaussians, as fewer than 3 views have masks,"
        )
        self.listener.log(f"shape: of {source} and {len(cloud)} Gaussians")
        shape = shape_of_cloud(cloud, views)
        self.listener.log(f"shape: {shape.describe()}")
        return shape

    def made(self) -> dict[str, Kept]:
        """Return the stages that were needed so far, in order."""
        return {name: self.__dict__[name] for name in ("views", "cloud", "features") if name in self.__dict__}

    def _source(self) -> Source:
        if self.source is None:
            raise no_views(self.folder)
        return self.source

    def _start(self, views: Sequence[View]) -> StartPoints | None:
        """Return structure from motion's points where masks are missing; None lets the masks' hull be the start."""
        source, bare = self._source(), [view.name for view in views if view.mask is None]
        if not bare:
            return None
        where = source.path if source.kind == "cameras" else self.stages.path("motion")
        found = read_sparse_points(where, meters=self.settings.views_meters)
        if found is None:
            raise SceneError(
                f"{where}: expected masks, or points of structure from motion, to initialize Gaussians, got "
                f"{counted(len(bare), 'view')} without a mask ({bare[0]}, ...); give masks, or let them be computed",
                file=where,
                name="masks",
                value=bare,
            )
        return StartPoints(found[0].float(), found[1].float() / 255)

    def _lift_to_cloud(self, views: Sequence[View], encoder: Encoder) -> Lifted:
        cloud = read_splats(self.cloud.path)
        self.listener.log(f"features: {encoder.name} of {len(views)} views onto {len(cloud)} Gaussians")
        rasterizer = choose_rasterizer(cloud.centers.device)
        return lift_to_cloud(
            cloud, views, encoder, self.config.lift, rasterizer=rasterizer, progress=self.listener.lifting
        )

    def _lift_to_mesh(self, views: Sequence[View], encoder: Encoder) -> Lifted:
        surface = read_surface(self._source().path, meters=self.settings.surface_meters)
        points = self.config.lift.points
        self.listener.log(f"features: {encoder.name} of {len(views)} views onto {points} points of the mesh")
        return lift_to_surface(surface, views, encoder, self.config.lift, progress=self.listener.lifting)

    def _keep_given(self, splats: Path) -> Kept:
        """Keep the Gaussians of a file that came with the folder: in meters, and those on the object alone."""
        views = None if self.source is None else self.views

        def make(path: Path) -> None:
            self.listener.log(f"splat: the Gaussians of {splats.name}, unchanged")
            read = scaled(read_splats(splats), self.settings.views_meters)
            cloud = without_far(read)
            if len(cloud) < len(read):
                self.listener.log(f"splat: {len(read) - len(cloud)} Gaussians far from the object are left out")
            if views is not None:
                cloud = keep_object(cloud, read_views(views.path), rasterizer=choose_rasterizer(cloud.centers.device))
            write_splats(cloud, path)

        recipe = {
            "given": digest_of(splats),
            "views": None if views is None else views.digest,
            "meters": self.settings.views_meters,
        }
        return self.stages.keep(CLOUD, recipe, make)

    def _keep_views_of_cloud(self) -> Kept:
        def make(path: Path) -> None:
            cloud = read_splats(self.cloud.path)
            rasterizer = choose_rasterizer(cloud.centers.device)
            write_views(views_of_cloud(cloud, rasterizer, size=self.config.views.rendered), path, replace=True)

        recipe = {"cloud": self.cloud.digest, "rendered": self.config.views.rendered}
        return self.stages.keep(VIEWS, recipe, make)


def without_far(cloud: GaussianCloud) -> GaussianCloud:
    """Return the Gaussians that are neither far outside of the middle half of all nor alone, as floaters are.

    Far is three times the longest side of the box of the middle half, as of Tukey's outer fences, and alone is one
    whose fourth neighbor is that side away.
    """
    centers = cloud.centers.double().numpy()
    low, high = np.quantile(centers, (0.25, 0.75), axis=0)
    side = float((high - low).max())
    near = ((centers >= low - 3 * side) & (centers <= high + 3 * side)).all(axis=1)
    near &= cKDTree(centers).query(centers, k=min(5, len(centers)))[0].reshape(len(centers), -1)[:, -1] <= side
    return cloud.take(torch.from_numpy(near))


def scaled(cloud: GaussianCloud, factor: float) -> GaussianCloud:
    """Return the Gaussians with all lengths times a factor."""
    return replace(cloud, centers=cloud.centers * factor, log_scales=cloud.log_scales + math.log(factor))
