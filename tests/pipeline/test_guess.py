"""A field without recordings is the body's modes: closed forms, symmetries, and what cannot be guessed."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
import trimesh

import avmsf
from avmsf.cli import main
from avmsf.editing.material import infer_material
from avmsf.errors import FitError, SimulationError
from avmsf.export import SampledField
from avmsf.fem.damping import Vibration
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.material import STEEL
from avmsf.fem.radiation import AIR_DENSITY, SOUND_SPEED, radiated_pressure
from avmsf.field.next_contacts import suggest
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load, save
from avmsf.mesh.surface import Surface, write_surface
from avmsf.pipeline.bodies import expect_no_recordings, guess_field
from avmsf.pipeline.config import BodyConfig, PipelineConfig
from factories.raising import raises

LENGTH, WIDTH, HEIGHT = 0.3, 0.02, 0.012
QUICK = BodyConfig(dofs=6000)


def box(*sides: float, cuts: tuple[int, int, int] = (15, 2, 1)) -> Surface:
    """Return a closed box about the origin, its sides cut into squares of two triangles each."""
    corners: dict[tuple[float, ...], int] = {}
    faces: list[list[int]] = []

    def row(*place: float) -> int:
        return corners.setdefault(tuple(round(each, 9) for each in place), len(corners))

    for axis in range(3):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        for end in (0, 1):
            for i in range(cuts[one]):
                for j in range(cuts[other]):
                    square = []
                    for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1)):
                        place = [0.0, 0.0, 0.0]
                        place[axis] = (end - 0.5) * sides[axis]
                        place[one] = ((i + di) / cuts[one] - 0.5) * sides[one]
                        place[other] = ((j + dj) / cuts[other] - 0.5) * sides[other]
                        square.append(row(*place))
                    a, b, c, d = square if end else square[::-1]
                    faces += [[a, b, c], [a, c, d]]
    return Surface(torch.tensor(list(corners), dtype=torch.float32), torch.tensor(faces))


@cache
def bar() -> SoundField:
    return guess_field(box(LENGTH, WIDTH, HEIGHT), "steel", body=QUICK, modes=12, name="bar")


def test_a_bars_lowest_modes_have_the_frequencies_of_euler_and_bernoulli_and_rayleigh_damping():
    # (b L)^2 of the free beam; about both axes of its cross-section.
    roots = torch.tensor([4.730041, 7.853205], dtype=torch.float64)
    speed = math.sqrt(STEEL.young / STEEL.density / 12.0)
    expected = torch.cat([root.square()[None] * speed * side / LENGTH**2 for root in roots for side in (HEIGHT, WIDTH)])
    frequency = bar().bank.frequency
    for each in (expected / (2 * math.pi)).tolist():
        # Shear and rotation lower slender beams' frequencies by up to 4 % here (Timoshenko), which the elements have.
        assert float((frequency / each - 1).abs().min()) < 0.045
    omega = 2 * math.pi * frequency
    law = 0.5 * (STEEL.alpha + STEEL.beta * (omega.square() + bar().bank.damping.square()))
    torch.testing.assert_close(bar().bank.damping, law, rtol=1e-9, atol=0)


def test_the_first_mode_is_struck_by_its_shape_and_silent_along_the_surface():
    field = bar()
    x = torch.linspace(-0.48, 0.48, 11) * LENGTH
    top = torch.stack([x, torch.zeros(11), torch.full((11,), HEIGHT / 2)], dim=1)
    found = field.gains(top)[:, 0].double()
    k = 4.730041
    s = (x / LENGTH + 0.5).double() * k
    ratio = (math.cosh(k) - math.cos(k)) / (math.sinh(k) - math.sin(k))
    shape = torch.cosh(s) + torch.cos(s) - ratio * (torch.sinh(s) + torch.sin(s))
    found, shape = found / found.norm(), shape / shape.norm()
    assert abs(float(found @ shape)) > 0.999
    # Bending in the plane of height and length has no motion across it.
    across = field.gains(top, directions=torch.tensor([0.0, 1.0, 0.0]).expand(11, 3))[:, 0]
    assert float(across.abs().max()) < 0.01 * float(field.gains(top)[:, 0].abs().max())


def test_mirrored_impacts_are_equally_strong_and_opposite_ones_opposite():
    field, place = bar(), torch.tensor([[0.11, 0.004, HEIGHT / 2]])
    down = torch.tensor([[0.0, 0.0, -1.0]])
    here, there = field.gains(place, directions=down), field.gains(-place, directions=-down)
    # Tetrahedra are not symmetric, and higher modes mix more.
    torch.testing.assert_close(here[:, :5].abs(), there[:, :5].abs(), rtol=0.05, atol=0.02 * float(here.abs().max()))
    assert torch.equal(field.gains(place, directions=-down), -here)
    assert torch.equal(field.gains(place), here)


def test_another_stiffness_scales_all_frequencies_alike():
    soft = replace(STEEL, young=STEEL.young / 4)
    field = guess_field(box(LENGTH, WIDTH, HEIGHT), soft, body=QUICK, modes=12)
    # Tetrahedra come out a little different each time.
    torch.testing.assert_close(field.bank.frequency, bar().bank.frequency / 2, rtol=5e-3, atol=0)


def test_a_breathing_sphere_is_as_loud_as_the_closed_form():
    radius, low = 0.05, 400.0
    sphere = icosphere(radius)
    normals = torch.nn.functional.normalize(sphere.vertices.double(), dim=1)
    edges = [sphere.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]
    middles = torch.cat([sphere.vertices[each].double().mean(dim=1) for each in edges])
    count, faces = len(sphere.vertices), len(sphere.faces)
    rows = count + torch.arange(3 * faces).reshape(3, faces).T
    nodes = torch.cat([sphere.vertices.double(), middles])
    shapes = torch.cat([normals, torch.nn.functional.normalize(middles, dim=1)])[:, None]
    frequency = torch.tensor([low], dtype=torch.float64)
    modes = ElasticModes(frequency, nodes, torch.cat([sphere.faces, rows], dim=1), shapes, STEEL, 1.0)
    pole = torch.tensor([2j * math.pi * low], dtype=torch.complex128)
    vibration = Vibration(pole, pole[None], torch.ones(1, 1, dtype=torch.complex128))
    wave = 2 * math.pi * low * radius / SOUND_SPEED
    # A pulsating sphere of unit velocity, at 1 m: rho c a k a / sqrt(1 + (k a)^2), here with k a = .37.
    expected = AIR_DENSITY * SOUND_SPEED * radius * wave / math.sqrt(1 + wave**2)
    # The facets' area is 1 % less; the plane wave's pressure on the surface is an approximation of order (k a)^2.
    assert float(radiated_pressure(modes, vibration)) == pytest.approx(expected, rel=0.1)


def icosphere(radius: float) -> Surface:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return Surface(torch.from_numpy(mesh.vertices).double(), torch.from_numpy(mesh.faces).long())


def test_a_guess_is_kept_whole_and_says_what_it_is(tmp_path: Path):
    save(bar(), tmp_path / "bar.safetensors")
    read, place = load(tmp_path / "bar.safetensors"), torch.tensor([[0.1, 0.0, HEIGHT / 2]])
    assert torch.equal(read.render(place), bar().render(place))
    assert read.quality is None
    assert read.origin.report["guess"].startswith("No recordings")
    assert read.origin.trained_on == ()
    with raises(FitError, name="field", value="body"):
        suggest(read)
    assert infer_material(read, option="--from")[0] == STEEL
    assert SampledField.of(read, limit=20).gains.shape == (20, 12)


def test_what_cannot_vibrate_or_is_in_another_unit_is_refused():
    good = box(LENGTH, WIDTH, HEIGHT)
    with raises(FitError, name="surface_unit", value=pytest.approx(1000 * LENGTH)):
        guess_field(Surface(good.vertices * 1000, good.faces), "steel")
    with raises(SimulationError, name="material", value="kryptonite"):
        guess_field(good, "kryptonite")
    corners = torch.tensor([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.2, 0.1, 0.0], [0.0, 0.1, 0.0]])
    sheet = Surface(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]))
    with raises(SimulationError, name="wall"):
        guess_field(sheet, "steel")
    tiny = box(0.012, 0.004, 0.003, cuts=(6, 2, 2))
    with raises(SimulationError, name="frequency"):
        guess_field(tiny, "steel", body=QUICK, modes=6)


def test_recordings_are_not_passed_over(tmp_path: Path):
    write_surface(box(LENGTH, WIDTH, HEIGHT), tmp_path / "surface.ply")
    for rows in ("", "file,x,y,z\n"):
        (tmp_path / "impacts.csv").write_text(rows)
        expect_no_recordings(tmp_path)
    (tmp_path / "impacts.csv").write_text("file,x,y,z\n1.wav,0,0,0\n")
    with raises(FitError, file=tmp_path / "impacts.csv", name="--material"):
        avmsf.fit(tmp_path, material="steel", progress=False)


def test_a_mesh_or_its_file_and_a_material_give_a_field(tmp_path: Path):
    write_surface(box(LENGTH, WIDTH, HEIGHT), tmp_path / "bar.ply")
    config = PipelineConfig(modes=12, body=QUICK)
    made = [
        avmsf.fit(each, material="steel", config=config, progress=False)
        for each in (str(tmp_path / "bar.ply"), box(LENGTH, WIDTH, HEIGHT))
    ]
    assert made[0].origin.capture == "bar"
    for each in made:
        torch.testing.assert_close(each.bank.frequency, bar().bank.frequency, rtol=1e-4, atol=0)
    assert [path.name for path in tmp_path.iterdir()] == ["bar.ply"]


def test_a_mesh_and_a_material_give_a_field_from_the_command_line(tmp_path: Path, capsys):
    write_surface(box(LENGTH, WIDTH, HEIGHT), tmp_path / "surface.ply")
    output = tmp_path / "field.safetensors"
    words = ["--material", "steel", "--modes", "12", "--set", "body.dofs=6000", "--output", str(output)]
    assert main(["fit", str(tmp_path), *words]) == 0
    assert "No recordings" in capsys.readouterr().out
    field = load(output)
    torch.testing.assert_close(field.bank.frequency, bar().bank.frequency, rtol=5e-3, atol=0)
    capsys.readouterr()
    assert main(["fit", str(tmp_path), *words, "--train-count", "3"]) == 2
    assert "--train-count" in capsys.readouterr().err


def test_what_needs_recordings_is_refused_beside_a_material() -> None:
    with raises(FitError, name="gain_model"):
        avmsf.fit("mug.ply", "network", material="ceramic")
