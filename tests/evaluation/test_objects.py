"""What methods read of a dataset's objects is made once, from the views that were asked for."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import trimesh

from avmsf.capture.filenames import SPLATS
from avmsf.capture.folder import Capture
from avmsf.capture.impacts import Impacts
from avmsf.capture.settings import CaptureSettings
from avmsf.datasets import CaptureCollection
from avmsf.datasets.dataset import Dataset, ObjectFacts, VisualSource
from avmsf.errors import CaptureError, EvaluationError, SceneError
from avmsf.evaluation.objects import ObjectInputs, choose_objects, draw_other_recording
from avmsf.evaluation.registry import PROTOCOLS, VisualInput
from avmsf.features.feature_field import FeatureField
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.ply import read_splats, write_splats
from avmsf.gaussians.start_points import StartPoints, starting_cloud
from avmsf.mesh.surface import Surface
from avmsf.photographs.folder import write_views
from avmsf.pipeline.config import PRESETS, LiftConfig, SceneConfig, ViewsConfig
from avmsf.pipeline.views import find_source
from factories.plate_set import fill_plates
from factories.raising import raises
from factories.small_scene import slab, slab_views

pytestmark = pytest.mark.filterwarnings("ignore:.*neither texture nor colors")

CONFIG = SceneConfig(views=ViewsConfig(rendered=24), lift=LiftConfig(encoder="descriptors", points=1200, components=4))
VISUAL, UNPOOLED = VisualInput("visual"), VisualInput("visual", pooled=False)


class OneObject(Dataset):
    """A dataset of one object, which can be seen in `seen` or nowhere."""

    name = "one"
    contacts = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.2, 0.0], [0.1, 0.0, 0.1]], dtype=torch.float64)

    def __init__(self, seen: Path | None, surface: Surface | None = None, **settings: Any) -> None:
        self.seen, self.surface, self.settings = seen, surface, CaptureSettings(**settings)

    def capture(self, identifier: str) -> Capture:
        impacts = Impacts(self.contacts, torch.zeros(3, 8), 100.0, ("a", "b", "c"))
        return Capture("slab", impacts, self.surface, self.settings)

    def visual_source(self, identifier: str) -> VisualSource | None:
        return None if self.seen is None else VisualSource(self.seen)


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("slab")
    slab().write(folder / "surface.ply")
    return folder


@pytest.mark.slow
def test_features_and_positions_are_of_the_same_points_and_made_once(seen: Path, tmp_path: Path) -> None:
    inputs = ObjectInputs(OneObject(seen), tmp_path, CONFIG)
    aligned, bare, unaligned = (
        inputs.features("slab", each) for each in (VISUAL, VisualInput("visual", bare=True), UNPOOLED)
    )
    assert torch.equal(aligned.points, bare.points)
    assert torch.equal(aligned.points, unaligned.points)
    assert bare.features.shape == (1200, 3)
    assert aligned.features.shape == (1200, 3 + 4)
    # A slab has symmetries, so that what is made to obey them is not what was seen.
    assert not torch.allclose(aligned.features, unaligned.features)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.safetensors")}
    assert len(before) == 2
    inputs.features("slab", VISUAL)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.safetensors")} == before
    # Pooling is left out where the settings say so, too.
    unpooled = replace(CONFIG, lift=replace(CONFIG.lift, symmetry=False))
    plain = ObjectInputs(OneObject(seen), tmp_path / "plain", unpooled).features("slab", VISUAL)
    assert torch.equal(plain.features, unaligned.features)
    # The surface is that of the views where a mesh does not count.
    meshless = ObjectInputs(OneObject(seen, slab()), tmp_path, CONFIG, geometry="gaussians")
    assert torch.equal(meshless.features("slab", VisualInput()).points, bare.points)
    # Fewer views are kept apart from all.
    assert not torch.allclose(inputs.features("slab", UNPOOLED, 6).features, unaligned.features)
    images = {place.name: len(list(place.rglob("images/*.png"))) for place in (tmp_path / "slab").iterdir()}
    assert images == {"6 views": 6, "all views": 72}


@pytest.mark.slow
def test_the_papers_features_are_of_gaussians_even_where_a_mesh_is_there(seen: Path, tmp_path: Path) -> None:
    scene = replace(CONFIG, splat=SplatConfig(steps=30, start_points=1500))
    paper = replace(PRESETS["paper"].scene.lift, encoder="descriptors")
    inputs = ObjectInputs(OneObject(seen), tmp_path, scene, paper)
    features = inputs.features("slab", VisualInput("paper"))
    (cloud,) = tmp_path.rglob("cloud.ply")
    assert {*map(tuple, features.points.tolist())} <= {*map(tuple, read_splats(cloud).centers.tolist())}
    # All that the encoder says, and no positions.
    assert features.features.shape[1] > 4 + 3
    assert "components" not in features.encoder
    # The paper's ablations differ from it in nothing else.
    forms = (VisualInput("paper", bare=True), VisualInput("paper", pooled=False))
    bare, unaligned = (inputs.features("slab", each) for each in forms)
    assert torch.equal(bare.points, features.points)
    assert torch.equal(bare.features, FeatureField.from_points(features.points).features)
    assert torch.equal(unaligned.points, features.points)
    assert unaligned.features.shape == features.features.shape
    # Gaussians of 30 steps are too rough to show a symmetry: of some that lie on the surface the features differ.
    points = torch.as_tensor(trimesh.Trimesh(slab().vertices, slab().faces).sample(3000, seed=0)).float()
    colors = 0.5 + 0.5 * torch.sin(points * torch.tensor([20.0, 30.0, 40.0]))
    made = starting_cloud(StartPoints(points, colors), degree=0, scale=1.0, opacity=0.9)
    (tmp_path / "made").mkdir()
    write_splats(made, tmp_path / "made" / SPLATS[0])
    smooth = ObjectInputs(OneObject(tmp_path / "made"), tmp_path / "smooth", scene, paper)
    aligned, unaligned = (smooth.features("slab", each) for each in (VisualInput("paper"), forms[1]))
    assert torch.equal(unaligned.points, aligned.points)
    assert not torch.allclose(unaligned.features, aligned.features)


def test_an_object_that_nothing_shows_has_positions_alone(tmp_path: Path) -> None:
    inputs = ObjectInputs(OneObject(None), tmp_path, CONFIG)
    points = inputs.features("slab", VisualInput("visual", bare=True)).points
    assert points.amin(0).tolist() == pytest.approx([0.0, 0.0, 0.0], abs=0.02)
    assert points.amax(0).tolist() == pytest.approx([0.1, 0.2, 0.1], abs=0.02)
    with raises(SceneError, name="slab"):
        inputs.features("slab", VISUAL)


def test_a_mesh_may_be_preferred_to_the_photographs_beside_it(tmp_path: Path) -> None:
    write_views(slab_views(), tmp_path)
    slab().write(tmp_path / "surface.ply")
    found = (find_source(tmp_path, CaptureSettings(), prefer=each) for each in ("best", "mesh"))
    assert [source and source.kind for source in found] == ["cameras", "mesh"]


def test_the_surface_of_a_mesh_needs_no_views_and_is_that_of_a_fit(tmp_path: Path) -> None:
    found = ObjectInputs(OneObject(None, slab()), tmp_path / "cache", CONFIG, seed=3).features("slab", VisualInput())
    assert torch.equal(found.points, FeatureField.from_mesh(slab(), seed=3).points)
    assert not (tmp_path / "cache").exists()


def test_bodies_are_held_at_points_of_the_object_that_its_user_states(tmp_path: Path) -> None:
    # Centimeters, of which the slab has fewer than a hundred.
    dataset = OneObject(None, slab(), held=((0.0, 0.0, 0.0), (100.0, 0.0, 0.0)), unit="cm")
    dataset.contacts = slab().vertices[:3].double()
    with raises(CaptureError, name="held", value=pytest.approx(0.76, abs=0.01)):
        ObjectInputs(dataset, tmp_path, CONFIG).bodies("slab")


def test_another_recording_is_of_another_object_at_this_ones_rate_and_length(tmp_path: Path) -> None:
    dataset = CaptureCollection(fill_plates(tmp_path))
    train = dataset.capture("a").impacts
    drawn = draw_other_recording(dataset, "a", train, seed=3)
    others = torch.cat([dataset.capture(name).impacts.sounds for name in "bc"])
    assert (others == drawn).all(dim=1).any()
    assert torch.equal(drawn, draw_other_recording(dataset, "a", train, seed=3))
    assert any(not torch.equal(drawn, draw_other_recording(dataset, "a", train, seed=seed)) for seed in range(4, 8))
    # Half the rate and twice the length: resampled, then silence.
    slow = replace(train, sample_rate=4000.0, sounds=torch.zeros(10, 1500))
    drawn = draw_other_recording(dataset, "a", slow, seed=3)
    assert drawn.shape == (1500,)
    assert float(drawn[1001:].abs().max()) == 0.0 < float(drawn[:1000].abs().max())
    with raises(EvaluationError, name="a"):
        draw_other_recording(CaptureCollection(tmp_path / "a"), "a", train, seed=0)


def test_edits_are_of_objects_whose_materials_contrast(monkeypatch: pytest.MonkeyPatch) -> None:
    names = [f"{material}-{number}" for material in ("iron", "ceramic") for number in range(3)]
    monkeypatch.setattr(OneObject, "objects", lambda self: tuple(names))
    monkeypatch.setattr(OneObject, "facts", lambda self, name: ObjectFacts(name, name))
    with raises(EvaluationError, name="edit", value="ceramic, iron"):
        choose_objects(OneObject(None), PROTOCOLS["edit"])
    names.append("plastic-0")
    assert choose_objects(OneObject(None), PROTOCOLS["edit"]) == ("plastic-0",)
