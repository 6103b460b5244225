"""From a recipe to a folder: recordings against their truth, what is written down of blows, and files read back."""

import hashlib
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh

import avmsf.simulate.simulation_folder as simulationset
from avmsf._utils.caching import content_digest
from avmsf.capture import read_capture
from avmsf.capture.audio import read_recording
from avmsf.capture.onset import find_onset
from avmsf.cli import simulate
from avmsf.errors import SimulationError
from avmsf.mesh.surface import Surface
from avmsf.mesh.textured_mesh import TexturedMesh, read_textured_mesh
from avmsf.photographs.folder import read_views
from avmsf.simulate.ground_truth import TRUTH, read_truth, write_truth
from avmsf.simulate.recipe import Imperfections, ObjectRecipe, named_recipe
from avmsf.simulate.simulation import Simulation, simulate_object
from avmsf.simulate.simulation_folder import is_written, simulate_set, write_painted, write_simulation
from avmsf.simulate.strikes import MIN_NORMAL_HEIGHT, draw_strikes, nearest_on
from factories.looked_at import sphere, surface_of
from factories.made_sheet import tile
from factories.raising import raises

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def rings(simulation: Simulation) -> torch.Tensor:
    """Return the sounds that the truth tells of, by its own formula."""
    truth = simulation.truth
    assert truth.starts is not None
    samples = torch.arange(simulation.recordings.shape[1], dtype=torch.float64)
    rows = []
    for start, gains in zip(truth.starts, truth.gains, strict=True):
        times = (samples - start) / simulation.recipe.sample_rate
        turns = 2 * math.pi * truth.frequency[:, None] * times
        decay = torch.exp(-truth.damping[:, None] * times.clamp(min=0.0))
        waves = gains.real @ (decay * torch.sin(turns)) + gains.imag @ (decay * torch.cos(turns))
        rows.append((times >= 0.0) * waves)
    return torch.stack(rows)


def test_recordings_are_the_truth_and_noise_of_the_asked_level(simulation: Simulation) -> None:
    impacts = simulation.capture.impacts
    # As the recorder heard them, before they were divided by the forces.
    clean = rings(simulation) * impacts.forces.double()[:, None]
    noise = simulation.recordings.double() * impacts.forces.double()[:, None] - clean
    # Over the time that is asked for; the files hold silence before it, and hardly any sound after it.
    kept = impacts.sounds.shape[1] / simulation.recordings.shape[1]
    level = 20 * math.log10(float(noise.square().mean().sqrt() / (clean.square().mean() / kept).sqrt()))
    # Twelve recordings of .4 s: the rumble's few bins leave an error of some tenths of a decibel.
    assert level == pytest.approx(-30.0, abs=0.6)
    # One room: the noise of each recording is as loud as that of the others.
    each = noise.square().mean(dim=1).sqrt()
    assert float(each.max() / each.min()) < 2.0


@pytest.mark.parametrize("imperfections", [Imperfections(), Imperfections.none()], ids=["usual", "none"])
def test_without_noise_recordings_are_the_truth_to_the_last_bit_of_float32(recipe, cache, imperfections):
    simulation = simulate_object(replace(recipe, imperfections=imperfections, noise_db=None), cache=cache)
    found, expected = simulation.recordings.double(), rings(simulation)
    assert float((found - expected).abs().max()) < 1e-7 * float(expected.abs().max())
    # Without imperfections they start with their impacts, too.
    assert simulation.capture.settings.align == (imperfections != Imperfections.none())
    assert bool(simulation.truth.starts.any()) == simulation.capture.settings.align


def test_the_truth_says_what_was_struck_and_not_what_was_written(simulation: Simulation) -> None:
    truth, impacts = simulation.truth, simulation.capture.impacts
    assert truth.contacts is not None
    off = (truth.contacts - impacts.contacts).norm(dim=1)
    assert 0.0005 < float(off.square().mean().sqrt()) < 0.003
    # At the written places and forces one would expect other gains, by some per cent.
    blind = simulation.body.gains(impacts.contacts, impacts.directions.double())
    assert 0.01 < float((blind - truth.amplitudes).norm() / truth.amplitudes.norm()) < 0.5


def test_a_perfect_recorder_writes_what_was_struck_and_how_hard(recipe: ObjectRecipe, cache: Path) -> None:
    perfect = replace(Imperfections(), contact=0.0, direction=0.0, force=0.0, contact_time=0.0)
    simulation = simulate_object(replace(recipe, imperfections=perfect), cache=cache)
    truth, impacts = simulation.truth, simulation.capture.impacts
    assert truth.contacts is not None
    assert torch.equal(truth.contacts, impacts.contacts)
    # Hertz: the force goes with the speed to the power 6/5, and a harder blow is a brighter one.
    usual = simulation.body.forces(torch.ones(1, dtype=torch.float64))
    speeds = (impacts.forces.double() / usual) ** (5 / 6)
    assert float(speeds.max() / speeds.min()) > 1.5
    gains = simulation.body.gains(impacts.contacts, impacts.directions.double(), speeds=speeds)
    assert float((gains - truth.amplitudes).norm() / truth.amplitudes.norm()) < 1e-6


def test_jitter_has_the_asked_size() -> None:
    # On a ball of 10 cm, where the surface's curvature hides nothing of 2 mm.
    surface = sphere(0.1, 4)
    spread = Imperfections(contact=0.002, direction=4.0, force=0.03, speed=0.2, contact_time=0.08)
    strikes = draw_strikes(surface, 800, up=UP, imperfections=spread, seed=1)
    off = (strikes.places - strikes.written_places).norm(dim=1).square().mean().sqrt()
    # Eight hundred pairs of numbers: 2.5 %, allowed three times.
    assert float(off) == pytest.approx(0.002, rel=0.075)
    angle = torch.arccos((strikes.directions * strikes.written_directions).sum(dim=1).clamp(-1, 1))
    assert math.degrees(float(angle.square().mean().sqrt())) == pytest.approx(4.0, rel=0.075)
    for errors, size in ((strikes.force_errors, 0.03), (strikes.speeds, 0.2), (strikes.contact_times, 0.08)):
        assert float(errors.log().square().mean().sqrt()) == pytest.approx(size, rel=0.075)
        assert abs(float(errors.log().mean())) < 3 * size / math.sqrt(800)
    assert torch.allclose(strikes.directions.norm(dim=1), torch.ones(800, dtype=torch.float64))
    # Written contacts stay on the surface.
    assert float((nearest_on(surface, strikes.written_places) - strikes.written_places).norm(dim=1).max()) < 1e-9


def test_a_hammer_reaches_neither_the_inside_of_a_cup_nor_what_looks_down() -> None:
    cup = trimesh.creation.annulus(r_min=0.035, r_max=0.04, height=0.1)
    floor = trimesh.creation.cylinder(radius=0.035, height=0.005, transform=trimesh.transformations.translation_matrix(
        [0, 0, -0.0475]
    ))  # fmt: skip
    surface = surface_of(trimesh.util.concatenate([cup, floor]))
    strikes = draw_strikes(surface, 60, up=UP, imperfections=Imperfections.none(), seed=0)
    outward = -strikes.directions
    assert float((outward @ UP).min()) >= MIN_NORMAL_HEIGHT
    across = strikes.places[:, :2].norm(dim=1)
    side = outward[:, 2].abs() < 0.5
    assert float(across[side].min()) > 0.038
    assert 30 < int(side.sum()) < 60
    # Far apart: sixty places on some 300 square centimeters.
    assert float(torch.pdist(strikes.places).min()) > 0.01


def test_switching_one_imperfection_off_changes_none_of_the_others() -> None:
    surface = sphere(0.1)
    kinds = (Imperfections(), Imperfections(contact=0.0), Imperfections(force=0.0))
    full, surely, hard = (draw_strikes(surface, 20, up=UP, imperfections=each, seed=5) for each in kinds)
    for name in ("places", "directions", "speeds", "contact_times", "written_directions"):
        assert torch.equal(getattr(full, name), getattr(surely, name))
        assert torch.equal(getattr(full, name), getattr(hard, name))
    assert torch.equal(full.force_errors, surely.force_errors)
    assert torch.equal(full.written_places, hard.written_places)
    assert torch.equal(surely.written_places, surely.places)
    assert hard.force_errors.tolist() == [1.0] * 20


def test_a_surface_turned_inside_out_cannot_be_struck() -> None:
    with raises(SimulationError, name="up", value=0):
        draw_strikes(
            Surface(sphere().vertices, sphere().faces.flip(1)), 10, up=UP, imperfections=Imperfections(), seed=0
        )


def test_elastic_modes_are_kept_by_all_that_decides_them(recipe, cache, simulation):
    told: list[str] = []
    again = simulate_object(replace(recipe, noise_db=-20.0, impacts=5), cache=cache, progress=told.append)
    assert told == ["sounds"]
    assert torch.equal(again.truth.frequency, simulation.truth.frequency)
    # A damaged file is no reason to stop.
    (kept,) = cache.glob(f"modes-{content_digest(recipe.elastic_values())[:24]}*")
    content = kept.read_bytes()
    kept.write_bytes(content[:1000])
    mended = simulate_object(recipe, cache=cache)
    assert torch.equal(mended.truth.gains, simulation.truth.gains)
    assert kept.read_bytes() == content
    keys = {each.elastic_values().__repr__() for each in (
        recipe, replace(recipe, material="steel"), replace(recipe, seed=1), replace(recipe, thickness=0.007),
        replace(recipe, size=0.3), replace(recipe, imperfections=Imperfections(stiffness=0.0)),
    )}  # fmt: skip
    assert len(keys) == 6


def test_twice_the_size_is_half_the_frequency(recipe: ObjectRecipe) -> None:
    # Scaled with its wall; without springs, whose strength follows the mass and not the size.
    free = replace(recipe, imperfections=Imperfections.none(), noise_db=None)
    small, large = (simulate_object(replace(free, size=size, thickness=0.03 * size)) for size in (0.25, 0.5))
    sides = [float((each.mesh.vertices.amax(0) - each.mesh.vertices.amin(0)).max()) for each in (small, large)]
    assert sides == pytest.approx([0.25, 0.5])
    count = min(len(small.truth.frequency), len(large.truth.frequency))
    undamped = [each.body.elastic.frequency[:count] for each in (small, large)]
    assert torch.allclose(undamped[0] / undamped[1], torch.full((count,), 2.0, dtype=torch.float64), rtol=2e-3)


def test_a_written_object_is_an_ordinary_capture_with_views_and_truth(simulation: Simulation, tmp_path: Path) -> None:
    folder = tmp_path / "tile"
    write_simulation(simulation, folder)
    capture, impacts = read_capture(folder), simulation.capture.impacts
    assert torch.equal(capture.impacts.sounds, impacts.sounds)
    assert capture.settings == simulation.capture.settings
    assert capture.settings.align
    assert "align" not in (folder / "capture.toml").read_text()
    assert torch.equal(capture.impacts.contacts, impacts.contacts)
    for name in ("directions", "forces"):
        assert torch.equal(getattr(capture.impacts, name), getattr(impacts, name))
    assert capture.impacts.names == simulation.truth.names
    assert capture.name == simulation.capture.name == "tile-ceramic"
    assert torch.equal(capture.surface.vertices, simulation.mesh.vertices)
    views = read_views(folder)
    assert len(views) == 3
    assert views[0].image.shape == (48, 48, 3)
    truth = read_truth(folder)
    for name in ("frequency", "damping", "gains", "contacts", "starts"):
        assert torch.equal(getattr(truth, name), getattr(simulation.truth, name))
    recordings = [torch.from_numpy(read_recording(folder / name).channel(1)).float() for name in truth.names]
    assert torch.equal(torch.stack(recordings), simulation.recordings)
    onsets = [find_onset(row.double().numpy(), sample_rate=32000.0) for row in recordings]
    late = torch.tensor(onsets) - truth.starts
    # The first sample that a threshold finds lies after the impact, by a part of a sample or a few samples.
    assert float(late.min()) >= 0.0
    assert float(late.median()) < 3.0
    assert truth.names == simulation.truth.names
    assert truth.recipe == simulation.recipe.values()
    assert truth.recipe["imperfections"]["coupling"] == Imperfections().coupling
    assert list(tmp_path.iterdir()) == [folder]


def test_the_same_recipe_gives_the_same_bytes(recipe: ObjectRecipe, tmp_path: Path) -> None:
    digests = []
    for folder in (tmp_path / "one", tmp_path / "two"):
        write_simulation(simulate_object(recipe, name="tile"), folder)
        digests.append({
            path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(folder.rglob("*")) if path.is_file()
        })  # fmt: skip
    assert len(digests[0]) > 12
    assert digests[0] == digests[1]


def test_painted_and_pictured_meshes_are_read_back_in_their_colors(tmp_path: Path) -> None:
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.2]])
    faces, path = torch.tensor([[0, 1, 2], [0, 2, 3]]), tmp_path / "surface.ply"
    colors = torch.tensor([[[1.0, 0, 0]] * 3, [[0, 0.2, 1.0]] * 3])
    texture = torch.randint(0, 256, (8, 8, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    places = torch.tensor([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]])
    # From the left, and from below.
    shown = texture[[7, 7, 0, 0], [0, 7, 7, 0]] / 255.0
    for mesh, expected in (
        (TexturedMesh.build(corners, faces, colors=colors), colors),
        (TexturedMesh.build(corners, faces, coordinates=places[faces], textures=[texture]), shown[faces]),
    ):
        write_painted(mesh, path)
        back = read_textured_mesh(path)
        assert torch.equal(back.vertices[back.faces], mesh.vertices[mesh.faces])
        assert torch.allclose(back.colors, expected, atol=0.5 / 255)


def test_a_folder_that_holds_something_else_is_left_alone(recipe: ObjectRecipe, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("mine")
    with raises(SimulationError, file=tmp_path / "mine", name=TRUTH):
        is_written(recipe, tmp_path / "mine")
    assert [each.name for each in tmp_path.rglob("*")] == ["mine", "thesis.txt"]


def test_a_set_killed_half_way_goes_on_and_refuses_to_mix(recipe, cache, tmp_path, monkeypatch):
    recipes = {name: replace(recipe, views=0, noise_db=level) for name, level in
               (("first", -30.0), ("second", -40.0), ("third", None))}  # fmt: skip
    written = write_simulation

    def cut(simulation: Simulation, folder: Path) -> None:
        if Path(folder).name == "second":
            (Path(folder).parent / ".second.part").mkdir()
            raise KeyboardInterrupt
        written(simulation, folder)

    monkeypatch.setattr(simulationset, "write_simulation", cut)
    with pytest.raises(KeyboardInterrupt):
        simulate_set(recipes, tmp_path, cache=cache)
    monkeypatch.setattr(simulationset, "write_simulation", written)
    before = (tmp_path / "first" / TRUTH).stat().st_mtime_ns
    stages = []
    made = simulate_set(
        recipes, tmp_path, cache=cache, progress=lambda message, done, total: stages.append((message, done))
    )
    assert made == ["second", "third"]
    assert [stage for stage in stages if stage[0].endswith(("exists", "done"))] == [
        ("first: exists", 1), ("second: done", 2), ("third: done", 3),
    ]  # fmt: skip
    assert (tmp_path / "first" / TRUTH).stat().st_mtime_ns == before
    assert len(read_capture(tmp_path / "third").impacts) == 12
    with raises(SimulationError, file=tmp_path / "first", value=["noise_db", "seed"]):
        simulate_set({"first": replace(recipes["first"], seed=9, noise_db=-20.0)}, tmp_path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("material", "unobtainium"),
        ("impacts", 1),
        ("thickness", -0.003),
        ("size", 101.0),
        ("views", 10),
        ("noise_db", math.inf),
        ("seed", -1),
    ],
)
def test_recipes_that_describe_nothing_are_refused(recipe: ObjectRecipe, name: str, value: object) -> None:
    with raises(SimulationError, name=name, value=value):
        replace(recipe, **{name: value})


def test_a_sheet_without_a_wall_is_told_to_have_one(recipe: ObjectRecipe, tmp_path: Path) -> None:
    # Flat: of a bent one the filling sometimes makes a sliver, by chance.
    flat = tile(tmp_path / "tile.ply", bend=0.0)
    with raises(SimulationError, file=flat, name="volume"):
        simulate_object(replace(recipe, mesh=flat, thickness=None))


def test_truths_that_do_not_fit_are_refused(simulation: Simulation, tmp_path: Path) -> None:
    for changes in ({"names": simulation.truth.names[1:]}, {"gains": simulation.truth.gains * math.nan}):
        with raises(SimulationError, file=tmp_path / TRUTH, name="gains"):
            write_truth(replace(simulation.truth, **changes), tmp_path / TRUTH)


def test_the_command_makes_an_object_of_a_mesh_and_keeps_it(recipe: ObjectRecipe, tmp_path: Path) -> None:
    words = ["--mesh", str(recipe.mesh), "--thickness", "0.006", "--set", "detail=0.2", "--material", "glass"]
    words += ["--impacts", "4", "--seconds", "1", "--views", "0", "--set", "elastic_modes=6"]
    words += ["--output", str(tmp_path / "mine")]
    times = set()
    for _ in range(2):
        assert simulate.run(simulate.Options.parse(words)) == 0
        times.add((tmp_path / "mine" / TRUTH).stat().st_mtime_ns)
    assert len(times) == 1
    assert len(read_capture(tmp_path / "mine").impacts) == 4
    with raises(SimulationError, file=tmp_path / "mine", value=["seed"]):
        simulate.run(simulate.Options.parse([*words, "--seed", "3"]))


def test_what_is_asked_of_a_named_object_holds_though_it_is_the_usual() -> None:
    # The example has 16 contacts at 44,100 Hz where a recipe usually has 40 at 48,000.
    recipe = simulate.Options.parse(["example", "--impacts", "40"]).all_settings
    assert (recipe.impacts, recipe.sample_rate, recipe.kind) == (40, 44100, "mug")
    recipe = simulate.Options.parse(["mug-plastic", "--material", "ceramic"]).all_settings
    assert recipe == replace(named_recipe("mug-plastic"), material="ceramic")
