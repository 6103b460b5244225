"""A field without recordings is the body's modes: closed forms, symmetries, and what cannot be guessed."""

import math
from functools import cache
from pathlib import Path

import pytest
import torch

import avmsf
from avmsf.editing.material import infer_material
from avmsf.errors import FitError, SimulationError
from avmsf.export import SampledField
from avmsf.fem.material import STEEL
from avmsf.fem.vibration import AIR_DENSITY, SOUND_SPEED, Vibration, radiated_pressure
from avmsf.field.next_contacts import suggest
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load, save
from avmsf.mesh.surface import Surface
from avmsf.pipeline.bodies import expect_no_recordings, guess_field
from avmsf.pipeline.config import BodyConfig, PipelineConfig
from factories.made_modes import breathing_sphere
from factories.raising import raises
from oracles.block import block

LENGTH, WIDTH, HEIGHT = 0.3, 0.02, 0.012
QUICK = BodyConfig(dofs=6000)


def box(*sides: float, cuts: tuple[int, int, int] = (15, 2, 1)) -> Surface:
    """Return a closed box about the origin, its sides cut into squares of two triangles each."""
    surface = block(sides, cuts).surface
    return Surface(surface.vertices - torch.tensor(sides) / 2, surface.faces)


@cache
def bar() -> SoundField:
    return guess_field(box(LENGTH, WIDTH, HEIGHT), "steel", body=QUICK, modes=12, name="bar")


def test_damping_is_rayleighs_law():
    omega = 2 * math.pi * bar().bank.frequency
    law = 0.5 * (STEEL.alpha + STEEL.beta * (omega.square() + bar().bank.damping.square()))
    torch.testing.assert_close(bar().bank.damping, law, rtol=1e-9, atol=0)
    # That of a slender beam's first mode over the height; shear and rotation lower it (Timoshenko).
    lowest = 4.730041**2 * math.sqrt(STEEL.young / STEEL.density / 12.0) * HEIGHT / LENGTH**2
    assert float(omega[0]) == pytest.approx(lowest, rel=0.045)


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


def test_a_breathing_sphere_is_as_loud_as_the_closed_form():
    radius, low = 0.05, 400.0
    pole = torch.tensor([2j * math.pi * low], dtype=torch.complex128)
    vibration = Vibration(pole, pole[None], torch.ones(1, 1, dtype=torch.complex128))
    wave = 2 * math.pi * low * radius / SOUND_SPEED
    # A pulsating sphere of unit velocity, at 1 m: rho c a k a / sqrt(1 + (k a)^2), here with k a = .37.
    expected = AIR_DENSITY * SOUND_SPEED * radius * wave / math.sqrt(1 + wave**2)
    # The plane wave's pressure on the surface is an approximation of order (k a)^2.
    found = radiated_pressure(breathing_sphere(radius, low), vibration)
    assert float(found) == pytest.approx(expected, rel=0.1)


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
    with raises(FitError, name="gain_model"):
        avmsf.fit("mug.ply", "network", material="ceramic")


def test_recordings_are_not_passed_over(tmp_path: Path):
    box(LENGTH, WIDTH, HEIGHT).write(tmp_path / "surface.ply")
    for rows in ("", "file,x,y,z\n"):
        (tmp_path / "impacts.csv").write_text(rows)
        expect_no_recordings(tmp_path)
    (tmp_path / "impacts.csv").write_text("file,x,y,z\n1.wav,0,0,0\n")
    with raises(FitError, file=tmp_path / "impacts.csv", name="--material"):
        avmsf.fit(tmp_path, material="steel", progress=False)
    (tmp_path / "impacts.csv").unlink()
    # How stiffly it is held only recordings tell.
    (tmp_path / "capture.toml").write_text("held = [[0, 0, 0]]\n")
    with raises(FitError, name="held"):
        avmsf.fit(tmp_path, material="steel", progress=False)


def test_a_mesh_or_its_file_and_a_material_give_a_field(tmp_path: Path):
    box(LENGTH, WIDTH, HEIGHT).write(tmp_path / "bar.ply")
    config = PipelineConfig(modes=12, body=QUICK)
    given = (str(tmp_path / "bar.ply"), box(LENGTH, WIDTH, HEIGHT))
    made = [avmsf.fit(each, material="steel", config=config, progress=False) for each in given]
    assert made[0].origin.capture == "bar"
    for each in made:
        torch.testing.assert_close(each.bank.frequency, bar().bank.frequency, rtol=1e-4, atol=0)
    assert [path.name for path in tmp_path.iterdir()] == ["bar.ply"]
