"""From what a folder shows of the object to its shape and its features: views, Gaussians, features, each a stage."""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from avmsf._utils.progress import ProgressListener
from avmsf._utils.text import counted
from avmsf.capture.filenames import no_views
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import SceneError
from avmsf.features.encoder import Encoder
from avmsf.features.feature_field import save_features
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.density import keep_object
from avmsf.gaussians.fit import SplatProgress, splat
from avmsf.gaussians.ply import read_splats, write_splats
from avmsf.gaussians.rasterizer.rasterizers import choose_rasterizer
from avmsf.gaussians.start_points import StartPoints
from avmsf.gaussians.visibility import depth_of_cloud
from avmsf.mesh.surface import Surface
from avmsf.photographs import read_sparse_points, read_views, write_views
from avmsf.photographs.cameras import View
from avmsf.photographs.mesh_views import orbit_cameras
from avmsf.pipeline.config import SceneConfig
from avmsf.pipeline.features import choose_encoder, finish_features, lift_features
from avmsf.pipeline.stages import Kept, Pipeline, Stage, StageFolder, digest_of
from avmsf.pipeline.views import MOTION, VIEWS, Source, find_source, find_splats, view_stages
from avmsf.reconstruction import ObjectShape, object_surface

CLOUD, FEATURES = "cloud.ply", "features.safetensors"
"""What the stages call their outputs."""
_MIN_COUNT = 100
"""Gaussians; what encloses an object is not known from fewer."""
_MIN_OPACITY = 0.05
"""Opacity below which a Gaussian does not show where the object is."""
_MIN_MASKS = 3
"""Masks from which outlines are taken; with fewer, pictures of the Gaussians have them."""
_SIZE = 256
"""Width and height of such pictures, pixels."""


class SceneStages(Pipeline):
    """The stages that lead from a folder's photographs, video, mesh or Gaussians to features on the object.

    Gaussians that lie in the folder are the object's; where no photographs with cameras are beside them, pictures of
    them from all sides are described. A mesh needs no Gaussians: its own surface is the object unless the settings say
    otherwise, and pictures of it are described. `VIEWS` is the folder of views, `CLOUD` the file of Gaussians. Each
    raises what it raises; SceneError where the folder shows nothing of the object.
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
        self.source_folder, self.config, self.settings, self.name, self.device = folder, config, settings, name, device
        found = find_source(folder, settings, prefer=config.views.source)
        meshed = found is not None and found.kind == "mesh"
        self.splats = None if meshed and config.views.source == "mesh" else find_splats(folder)
        # Cameras that structure from motion would find are in another frame than the Gaussians.
        placed = found is not None and found.kind == "cameras"
        self.source: Source | None = None if self.splats and not placed else found
        super().__init__(stages, listener=listener or ProgressListener())
        if self:
            self.stages |= {stage.name: stage for stage in self._stages()}

    def __bool__(self) -> bool:
        """Whether the folder shows anything of the object."""
        return self.source is not None or self.splats is not None

    def expect_any(self) -> None:
        """Raise SceneError, before anything is written, where the folder shows nothing of the object."""
        if not self:
            raise no_views(self.source_folder)

    @property
    def features(self) -> Kept:
        """The file of features, on the Gaussians or on points of the mesh."""
        return self[self.name]

    def _stages(self) -> list[Stage]:
        """Return the list: names, what they depend on, functions."""
        config, source, splats = self.config, self.source, self.splats
        lifting = Stage(self.name, self._make_features, (VIEWS, CLOUD), self._features_recipe)
        if source is None:
            assert splats is not None
            size = config.views.rendered
            pictures = Stage(VIEWS, self._picture_gaussians, (CLOUD,), lambda: {"rendered": size})
            return [self._given_cloud(splats), pictures, lifting]
        views = view_stages(source, config.views, settings=self.settings, log=self.listener.log)
        if splats is not None:
            return [*views, self._given_cloud(splats, (VIEWS,)), lifting]
        if source.kind == "mesh" and config.lift.onto == "mesh":
            # Points are drawn of the mesh itself, of which views do not show all.
            files = {"files": source.digest}
            lifting = replace(lifting, inputs=(VIEWS,), recipe=lambda: {**self._features_recipe(), **files})
        # Structure from motion's points may be the start.
        start = {"files": source.digest} if source.kind == "cameras" else {}
        inputs = tuple(stage.name for stage in views)
        fitting = Stage(CLOUD, self._fit_gaussians, inputs, lambda: {"splat": asdict(config.splat), **start})
        return [*views, fitting, lifting]

    def _given_cloud(self, splats: Path, inputs: tuple[str, ...] = ()) -> Stage:
        meters = self.settings.views_meters
        return Stage(CLOUD, self._take_gaussians, inputs, lambda: {"given": digest_of(splats), "meters": meters})

    def _fit_gaussians(self, path: Path, *inputs: Path) -> None:
        views = read_views(inputs[-1])
        start = self._start(views)
        self.listener.log(f"splat: {counted(self.config.splat.steps, 'step')} on {len(views)} views")
        checkpoint = self.folder.checkpoint(CLOUD)
        cloud = splat(
            views, self.config.splat, start=start, progress=self._splatting, checkpoint=checkpoint, device=self.device
        )
        write_splats(cloud, path)

    def _start(self, views: Sequence[View]) -> StartPoints | None:
        """Return structure from motion's points where masks are missing; None lets the masks' hull be the start."""
        bare = [view.name for view in views if view.mask is None]
        if not bare:
            return None
        assert self.source is not None
        where = self.source.path if self.source.kind == "cameras" else self.folder.path(MOTION)
        found = read_sparse_points(where, meters=self.settings.views_meters)
        if found is None:
            raise SceneError.expected(
                "masks, or points of structure from motion, to initialize Gaussians",
                bare,
                got=f"{counted(len(bare), 'view')} without a mask ({bare[0]}, ...)",
                file=where,
                name="masks",
                advice="give masks, or let them be computed",
            )
        return StartPoints(found[0].float(), found[1].float() / 255)

    def _take_gaussians(self, path: Path, views: Path | None = None) -> None:
        """Write the Gaussians of a file that came with the folder: in meters, and those on the object alone."""
        assert self.splats is not None
        self.listener.log(f"splat: the Gaussians of {self.splats.name}, unchanged")
        read = scaled(read_splats(self.splats), self.settings.views_meters)
        cloud = without_far(read)
        if len(cloud) < len(read):
            self.listener.note(f"splat: {len(read) - len(cloud)} Gaussians far from the object are left out")
        if views is not None:
            cloud = keep_object(cloud, read_views(views), rasterizer=choose_rasterizer(cloud.centers.device))
        write_splats(cloud, path)

    def _picture_gaussians(self, path: Path, given: Path) -> None:
        write_views(views_of_cloud(read_splats(given), size=self.config.views.rendered), path, replace=True)

    @cached_property
    def encoder(self) -> Encoder:
        """What describes the views. Raises SceneError where it is not available."""
        return choose_encoder(self.config.lift, log=self.listener.note, device=self.device)

    def _features_recipe(self) -> dict[str, object]:
        weights = Path(self.config.lift.encoder).expanduser()
        given = {"weights": digest_of(weights)} if weights.is_dir() else {}
        return {"encoder": self.encoder.name, "lift": asdict(self.config.lift), **given}

    def _make_features(self, path: Path, views_path: Path, cloud: Path | None = None) -> None:
        views, config, encoder = read_views(views_path), self.config.lift, self.encoder
        if cloud is None:
            assert self.source is not None
            shape: Surface | GaussianCloud = Surface.read(self.source.path, meters=self.settings.surface_meters)
            points = f"{config.points} points of the mesh"
        else:
            shape = read_splats(cloud)
            points = f"{len(shape)} Gaussians"
        self.listener.log(f"features: {encoder.name} of {len(views)} views onto {points}")
        lifted = lift_features(
            shape, views, encoder, config, progress=lambda *step: self.listener.step("features", *step)
        )
        features, report = finish_features(lifted, config)
        save_features(features, path, report={**report, "scene": asdict(self.config)})

    def _splatting(self, progress: SplatProgress) -> None:
        message = f"loss {progress.loss:.3g}, {progress.psnr:.1f} dB, {len(progress.cloud)} Gaussians"
        self.listener.step("splat", progress.step, progress.steps, message)

    def shape(self) -> ObjectShape:
        """Return the object's shape, of its views' masks and its Gaussians' depth (`shape_of_cloud`)."""
        return shape_of_cloud(read_splats(self[CLOUD].path), read_views(self[VIEWS].path), log=self.listener.log)


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


def shape_of_cloud(
    cloud: GaussianCloud,
    views: Sequence[View] = (),
    *,
    cells: int = 128,
    log: Callable[[str], object] = lambda message: None,
) -> ObjectShape:
    """Return the shape of the object that Gaussians show; masks of views say where its outlines are.

    Where fewer than 3 views have masks, pictures of the Gaussians from all sides stand for them. Raises SceneError for
    fewer than 100 Gaussians that can be seen, for Gaussians in one place, and as `object_surface` does.
    """
    visible = cloud.detach().take(cloud.opacities.detach() >= _MIN_OPACITY)
    advice = "fit the Gaussians again, with more steps or better masks"
    if len(visible) < _MIN_COUNT:
        wanted = f"{_MIN_COUNT} Gaussians or more of at least {_MIN_OPACITY}"
        raise SceneError.expected(wanted, len(visible), name="opacities", advice=advice)
    if not float((visible.centers.amax(0) - visible.centers.amin(0)).max()) > 0:
        center = visible.centers[0].tolist()
        raise SceneError.expected("Gaussians all over an object", center, name="centers", advice=advice)
    source = f"{len(views)} views"
    if sum(bool(view.foreground.any()) for view in views) < _MIN_MASKS:
        source = f"images of the Gaussians, as fewer than {_MIN_MASKS} views have masks,"
        views = views_of_cloud(visible, size=_SIZE)
    log(f"shape: of {source} and {len(cloud)} Gaussians")
    shape = object_surface(views, depth_of_cloud(visible, choose_rasterizer(visible.centers.device)), cells=cells)
    log(f"shape: {shape.describe()}")
    return shape


def views_of_cloud(cloud: GaussianCloud, *, size: int) -> tuple[View, ...]:
    """Return the 72 pictures of `orbit_cameras` of Gaussians before white, `size` pixels wide, with masks."""
    box = Surface(cloud.centers.float(), torch.zeros(0, 3, dtype=torch.int64))
    rasterizer, views = choose_rasterizer(cloud.centers.device), []
    for number, camera in enumerate(orbit_cameras(box, size=size)):
        with torch.no_grad():
            seen = rasterizer(cloud, camera, background=cloud.centers.new_ones(3))
        image, mask = ((255 * each.clamp(0, 1)).round().to(torch.uint8) for each in (seen.color, seen.alpha))
        views.append(View(f"view_{number:03d}", image, camera, mask))
    return tuple(views)
