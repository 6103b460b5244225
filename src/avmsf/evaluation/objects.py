"""What methods read of the objects of a dataset, made once an object and cached; and groups of objects."""

import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.processes import NO_LIMIT
from avmsf.baselines.diffsound.body_family import BodyFamily, body_family
from avmsf.baselines.diffsound.material_fit import MODES as DIFFSOUND_MODES
from avmsf.capture.impacts import Impacts
from avmsf.datasets import CaptureCollection
from avmsf.datasets.dataset import Dataset
from avmsf.datasets.numbering import ABLATION, NON_SYMMETRIC
from avmsf.errors import AvmsfError, EvaluationError, SceneError
from avmsf.evaluation.editing import TRANSITIONS, materials_of
from avmsf.evaluation.mode_embedding import check_materials
from avmsf.evaluation.registry import Protocol, VisualInput
from avmsf.features.feature_field import FeatureField, load_features, read_report
from avmsf.fem.candidate_bodies import CandidateBodies
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.ply import read_splats
from avmsf.mesh.surface import Surface
from avmsf.modal.spectra import resampled, with_length
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import AUTO, DESCRIPTORS, PRESETS, BodyConfig, Geometry, LiftConfig, SceneConfig, ViewsConfig
from avmsf.pipeline.scene import CLOUD, FEATURES, SceneStages
from avmsf.pipeline.shape import mesh_symmetries, reported_symmetries
from avmsf.pipeline.stages import StageFolder
from avmsf.reconstruction import ObjectShape
from avmsf.simulate import recipe
from avmsf.simulate.ground_truth import TRUTH
from avmsf.symmetry.symmetries import Symmetries


@dataclass(frozen=True)
class ObjectInputs:
    """Makes what methods read of a dataset's objects, each object's in a folder of its own beneath `cache`."""

    dataset: Dataset
    cache: Path
    scene: SceneConfig = field(default_factory=SceneConfig)
    """How Gaussians and features are made."""
    paper: LiftConfig = PRESETS["paper"].scene.lift
    """How features are made in the paper's form."""
    geometry: Geometry = "mesh"
    """What bodies are made of. With `gaussians`, nothing reads the object's mesh, where the dataset has one."""
    body: BodyConfig = field(default_factory=BodyConfig)
    device: str | None = None
    """Device of Gaussians, DINOv2 and training, with the same result up to rounding; None for a GPU if there is one."""
    seed: int = 0
    """Seed of the points on a mesh, and of the methods."""

    def features(self, identifier: str, visual_input: VisualInput, views: int | None = None) -> FeatureField:
        """Return these features of an object, from at most `views` views, or from all for None.

        Positions are those of the same points that features are lifted onto, so that the two differ in nothing else; of
        an object that nothing shows, they are its surface's, or fill the box of its contacts. The form `surface` is as
        in `avmsf fit`, and needs no views of an object with a mesh. Raises SceneError for the features of an object
        that nothing shows, and DatasetError for an unknown one.
        """
        if visual_input.form == "surface" and self.geometry != "gaussians":
            surface = self.dataset.capture(identifier).surface
            if surface is not None:
                return FeatureField.from_mesh(surface, seed=self.seed)
        bare = visual_input.form == "surface" or visual_input.bare
        if bare and self.dataset.visual_source(identifier) is None:
            capture = self.dataset.capture(identifier)
            if capture.surface is None:
                return FeatureField.from_contacts(capture.impacts.contacts)
            return FeatureField.from_points(capture.surface.vertices)
        with self._features(identifier, visual_input, views) as path:
            features = load_features(path)
        return FeatureField.from_points(features.points) if bare else features

    @contextmanager
    def _features(self, identifier: str, visual_input: VisualInput, views: int | None) -> Iterator[Path]:
        """Yield the file of the features of the points that views show, locked."""
        lift = self.paper if visual_input.form == "paper" else self.scene.lift
        if visual_input.form == "surface" and lift.encoder == AUTO:
            # Positions do not depend on the encoder.
            lift = replace(lift, encoder=DESCRIPTORS)
        lift = replace(
            lift,
            symmetry=lift.symmetry and visual_input.pooled,
            standardize=lift.standardize or visual_input.standardized,
        )
        # The ablated features lie beside those of the fields without ablation.
        changes = {
            "paper": visual_input.form == "paper",
            "unaligned": not visual_input.pooled,
            "standardized": visual_input.standardized,
        }
        name = "-".join([*(change for change, made in changes.items() if made), FEATURES])
        with self._stages(identifier, replace(self.scene, lift=lift), views, name) as stages:
            yield stages.features.path

    def cloud(self, identifier: str, views: int | None = None) -> GaussianCloud:
        """Return an object's Gaussians: those in its folder, or fitted to its views, or to pictures of its mesh.

        Raises SceneError where nothing shows the object.
        """
        with self._stages(identifier, self._best_views, views) as stages:
            return read_splats(stages[CLOUD].path)

    def bodies(self, identifier: str) -> CandidateBodies:
        """Return an object's bodies, which all its cases share.

        Raises SceneError where its shape is unknown, SimulationError for an unfit one, FitError where the contacts, the
        test ones too, do not lie on the surface, and CaptureError where the points do not at which it was held.
        """
        capture, cache = self.dataset.capture(identifier), self.cache / identifier / "bodies"
        return candidate_bodies(
            self._surface(identifier), self.body, impacts=capture.impacts, settings=capture.settings, cache=cache
        )

    def symmetries(self, identifier: str, views: int | None = None) -> Symmetries | None:
        """Return the symmetries of an object's shape, of its mesh or else of its views; None where nothing shows it."""
        surface = self.dataset.capture(identifier).surface
        if surface is not None and self.geometry != "gaussians":
            return mesh_symmetries(surface, self.seed)
        if self.dataset.visual_source(identifier) is None:
            return None
        with self._features(identifier, VisualInput(), views) as path:
            return reported_symmetries(read_report(path))

    def family(self, identifier: str) -> BodyFamily:
        """Return an object's bodies for DiffSound. Raises SceneError and SimulationError as `bodies` does."""
        return body_family(self._surface(identifier), count=DIFFSOUND_MODES)

    def _surface(self, identifier: str) -> Surface | ObjectShape:
        if self.geometry == "gaussians":
            with self._stages(identifier, self._best_views, None) as stages:
                return stages.shape()
        surface = self.dataset.capture(identifier).surface
        if surface is None or not len(surface.faces):
            raise SceneError.expected("a mesh in the dataset", name=identifier, advice="take geometry from Gaussians")
        return surface

    @property
    def _best_views(self) -> SceneConfig:
        """Settings with the best that shows the object: other methods may look at the mesh alone."""
        return replace(self.scene, views=replace(self.scene.views, source=ViewsConfig().source))

    @contextmanager
    def _stages(
        self, identifier: str, config: SceneConfig, views: int | None, name: str = FEATURES
    ) -> Iterator[SceneStages]:
        """Yield the stages from what shows an object, locked. Raises SceneError where nothing does."""
        seen = self.dataset.visual_source(identifier)
        if seen is None:
            raise SceneError.expected("a mesh or photographs in the dataset", name=identifier)
        config = replace(config, views=replace(config.views, count=views or 0))
        folder = self.cache / identifier / ("all views" if views is None else f"{views} views")
        stages = SceneStages(
            seen.folder, StageFolder(folder), config, settings=seen.settings, name=name, device=self.device
        )
        with stages.folder.lock("avmsf evaluate", wait=NO_LIMIT):
            yield stages


def draw_other_recording(dataset: Dataset, identifier: str, train: Impacts, *, seed: int) -> Float[Tensor, " samples"]:
    """Return a recording of another object of the dataset, at the rate and of the length of `train`.

    The draw depends on the seed and the object alone. Objects that cannot be read are passed over. Shorter recordings
    end in silence, longer ones are cut. Raises EvaluationError where there is no other object.
    """
    others = [other for other in dataset.objects() if other != identifier]
    generator = torch.Generator().manual_seed(zlib.crc32(identifier.encode(), seed))
    for row in torch.randperm(len(others), generator=generator).tolist():
        try:
            impacts = dataset.capture(others[row]).impacts
        except AvmsfError:
            continue
        row = int(torch.randint(len(impacts), (), generator=generator))
        sounds = resampled(impacts.sounds[row][None], sample_rate=impacts.sample_rate, wanted=train.sample_rate)
        return with_length(sounds, train.sounds.shape[1])[0].to(train.sounds.dtype)
    raise EvaluationError.expected(
        f"another readable object in {dataset.name}", name=identifier, advice="download more of the dataset"
    )


SUBSETS: Mapping[str, tuple[str, Sequence[str], Sequence[str]]] = {
    "ablation": ("those of the paper's ablations or the simulated ones in their place", ABLATION, recipe.ABLATED),
    "non-symmetric": ("those without rotational symmetry", NON_SYMMETRIC, recipe.NON_SYMMETRIC),
}
"""Groups of objects by name: what they have in common, their numbers in the paper's datasets, and simulated ones."""


def members(dataset: Dataset) -> dict[str, frozenset[str]]:
    """Return the groups that a dataset has objects of, by name.

    The numbers of ObjectFolder Real are RealImpact's too, before the first underscore of an object's name. Of captures
    only those are known that were simulated.
    """
    found = {}
    for group, (_, numbers, names) in SUBSETS.items():
        if isinstance(dataset, CaptureCollection):
            known = (each for each in dataset.objects() if each in names)
            found[group] = frozenset(each for each in known if (dataset.folder_of(each) / TRUTH).is_file())
        else:
            found[group] = frozenset(each for each in dataset.objects() if each.partition("_")[0] in numbers)
    return {group: each for group, each in found.items() if each}


def choose_objects(dataset: Dataset, protocol: Protocol, asked: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the objects that take part: those asked for, else the protocol's group, else all; for edits, those of
    materials that others of the dataset contrast with.

    Raises DatasetError for unknown ones, and EvaluationError where the protocol is about a group that the dataset does
    not have, and where edits have too few objects to be measured by, or none to change.
    """
    materials = materials_of(dataset) if protocol.scoring == "edits" else {}
    if protocol.scoring == "edits":
        check_materials(materials.values(), name=protocol.name)
    if asked:
        return tuple(dict.fromkeys(dataset.facts(identifier).identifier for identifier in asked))
    if protocol.scoring == "edits":
        reached = [first for first, second in TRANSITIONS if second in materials.values()]
        found = tuple(name for name, material in materials.items() if material in reached)
        if not found:
            pairs = ", ".join(map(" to ".join, TRANSITIONS))
            wanted, known = f"objects of a pair of materials of {pairs}", ", ".join(sorted({*materials.values()}))
            raise EvaluationError.expected(wanted, known, name=protocol.name)
        return found
    if protocol.subset is not None:
        group = members(dataset).get(protocol.subset, frozenset())
        if group:
            return tuple(each for each in dataset.objects() if each in group)
        if protocol.subset != "ablation":
            wanted, advice = f"objects of the group {protocol.subset}", "name objects with --objects"
            raise EvaluationError.expected(wanted, protocol.subset, got="none", name="subset", advice=advice)
    return dataset.objects()
