"""What the objects of a dataset may be behind their surfaces: made once an object, and kept."""

from dataclasses import dataclass, field, replace
from pathlib import Path

from avmsf._utils.locks import NO_LIMIT
from avmsf.baselines.diffsound.material_fit import MODES as DIFFSOUND_MODES
from avmsf.datasets.dataset import Dataset
from avmsf.errors import SceneError
from avmsf.fem.body_family import BodyFamily, body_family
from avmsf.field.gains.elastic import CandidateBodies
from avmsf.mesh.surface import Surface
from avmsf.pipeline.bodies import candidate_bodies, roughened
from avmsf.pipeline.config import BodyConfig, Geometry, SceneConfig, ViewsConfig
from avmsf.pipeline.scene import SceneStages
from avmsf.pipeline.stages import StageFolder
from avmsf.reconstruction import ObjectShape

NOISE = 0.02
"""Displacement of a noisy mesh's vertices over the object's size."""


@dataclass(frozen=True)
class ObjectBodies:
    """Computes the bodies of a dataset's objects, each in a folder of its own beneath `cache`."""

    dataset: Dataset
    cache: Path
    geometry: Geometry = "mesh"
    config: BodyConfig = field(default_factory=BodyConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    """How Gaussians are made, where the geometry asks for them."""
    seed: int = 0
    """Start of the chance in the noise."""
    device: str | None = None
    """Device of Gaussians; None for a GPU where there is one."""

    def __call__(self, identifier: str) -> CandidateBodies:
        """Return an object's bodies. Raises SceneError where its shape is unknown, SimulationError for an unfit one."""
        return candidate_bodies(self._surface(identifier), self.config, cache=self.cache / identifier / "bodies")

    def family(self, identifier: str) -> BodyFamily:
        """Return an object's bodies for DiffSound. Raises SceneError and SimulationError likewise."""
        return body_family(self._surface(identifier), count=DIFFSOUND_MODES)

    def _surface(self, identifier: str) -> Surface | ObjectShape:
        if self.geometry == "gaussians":
            return self._shape(identifier)
        surface = self.dataset.capture(identifier).surface
        if surface is None or not len(surface.faces):
            raise SceneError.expected("a mesh in the dataset", name=identifier, advice="take geometry from Gaussians")
        return surface if self.geometry == "mesh" else roughened(surface, NOISE, seed=self.seed)

    def _shape(self, identifier: str) -> ObjectShape:
        seen = self.dataset.look(identifier)
        if seen is None:
            raise SceneError(f"{identifier}: expected a mesh or photographs in the dataset, got none", name=identifier)
        scene = replace(self.scene, views=replace(self.scene.views, source=ViewsConfig().source))
        stages = SceneStages(
            seen.folder,
            StageFolder(self.cache / identifier / "all views"),
            scene,
            settings=seen.settings,
            device=self.device,
        )
        with stages.stages.lock("avmsf evaluate", wait=NO_LIMIT):
            return stages.shape()
