"""What fields may read of the objects of a dataset: made once an object, kept, and the same for every method."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from avmsf._utils.locks import NO_LIMIT
from avmsf.datasets.dataset import Dataset
from avmsf.errors import SceneError
from avmsf.evaluation.task import Look
from avmsf.features.feature_field import FeatureField
from avmsf.features.store import load_features
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.ply import read_splats
from avmsf.pipeline.config import AUTO, DESCRIPTORS, PRESETS, LiftConfig, SceneConfig, ViewsConfig
from avmsf.pipeline.scene import FEATURES, SceneStages
from avmsf.pipeline.stages import StageFolder

NAMES: Mapping[Look, str] = {
    "unaligned": "unaligned.safetensors",
    "paper": "paper.safetensors",
    "paper-positions": "paper.safetensors",
    "paper-unaligned": "paper-unaligned.safetensors",
}
"""What the files of features are called, where they are not those of the fields without ablation."""


@dataclass(frozen=True)
class ObjectLooks:
    """Makes the features of a dataset's objects, each in a folder of its own beneath `cache`."""

    dataset: Dataset
    cache: Path
    config: SceneConfig = field(default_factory=SceneConfig)
    paper: LiftConfig = PRESETS["paper"].scene.lift
    """How features are made in the paper's form."""
    device: str | None = None
    """Device of Gaussians and DINOv2; None for a GPU where there is one."""
    meshes: bool = True
    """Whether `surface` is an object's mesh where the dataset has one; else it is as `positions`."""
    seed: int = 0
    """Seed of the points on a mesh."""

    def __call__(self, identifier: str, look: Look, views: int | None = None) -> FeatureField:
        """Return what `look` means for an object, from at most `views` views, or from all for None.

        `positions` are those of the same points that looks are lifted onto, so that the two differ in nothing else; of
        an object that nothing shows, they are its surface's, or fill the box of its contacts. `surface` is as in
        `avmsf fit`, and needs no views of an object with a mesh. Raises SceneError for the looks of an object that
        nothing shows, and DatasetError for an unknown one.
        """
        surface = self.dataset.capture(identifier).surface if look == "surface" and self.meshes else None
        if surface is not None:
            return FeatureField.from_mesh(surface, seed=self.seed)
        bare = look == "surface" or look.endswith("positions")
        if bare and self.dataset.look(identifier) is None:
            return self._bare(identifier)
        lift = self.paper if look.startswith("paper") else self.config.lift
        if look == "surface" and lift.encoder == AUTO:
            # Positions do not depend on the encoder.
            lift = replace(lift, encoder=DESCRIPTORS)
        lift = replace(lift, symmetry=not look.endswith("unaligned"))
        stages = self._stages(identifier, replace(self.config, lift=lift), views, name=NAMES.get(look, FEATURES))
        with stages.stages.lock("avmsf evaluate", wait=NO_LIMIT):
            features = load_features(stages.features.path)
        return FeatureField.from_points(features.points) if bare else features

    def cloud(self, identifier: str, views: int | None = None) -> GaussianCloud:
        """Return an object's Gaussians: those in its folder, or fitted to its views, or to pictures of its mesh.

        Raises SceneError where nothing shows the object.
        """
        # Other methods may look at the mesh alone; those that ask for Gaussians have the best that shows the object.
        config = replace(self.config, views=replace(self.config.views, source=ViewsConfig().source))
        stages = self._stages(identifier, config, views)
        with stages.stages.lock("avmsf evaluate", wait=NO_LIMIT):
            return read_splats(stages.cloud.path)

    def _stages(self, identifier: str, config: SceneConfig, views: int | None, name: str = FEATURES) -> SceneStages:
        """Return the stages from what shows an object. Raises SceneError where nothing does."""
        seen = self.dataset.look(identifier)
        if seen is None:
            raise SceneError(f"{identifier}: expected a mesh or photographs in the dataset, got none", name=identifier)
        config = replace(config, views=replace(config.views, count=views or 0))
        place = self.cache / identifier / ("all views" if views is None else f"{views} views")
        return SceneStages(
            seen.folder, StageFolder(place), config, settings=seen.settings, name=name, device=self.device
        )

    def _bare(self, identifier: str) -> FeatureField:
        capture = self.dataset.capture(identifier)
        if capture.surface is None:
            return FeatureField.from_contacts(capture.impacts.contacts)
        return FeatureField.from_points(capture.surface.vertices)
