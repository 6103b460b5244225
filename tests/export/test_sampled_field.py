"""A table of points sounds as the field that it was made from."""

import json
from dataclasses import replace

import pytest
import torch

from avmsf.errors import ExportError
from avmsf.export.bundle import make_bundle
from avmsf.export.sampled_field import SampledField, outward_normals
from avmsf.field.config import FitConfig
from avmsf.field.gains.scaled import ScaledGains
from avmsf.field.header import SUPPORTING
from avmsf.field.sound_field import Origin, SoundField
from avmsf.modal.modes import ForcePulse, ModalBank
from avmsf.modal.residual_noise import Residual
from factories.made_fields import BANK, FIELDS, elastic, places, plate, positional
from factories.raising import raises

RATE, SAMPLES = 8000.0, 3000


def sounding(
    name: str, *, phase: float = 0.0, scaled: bool = False, background_force: float | None = None
) -> SoundField:
    gains = FIELDS[name]()
    if scaled:
        gains = ScaledGains(gains, torch.linspace(0.5, 2.0, len(BANK), dtype=torch.float64), length=1.25)
    magnitude = torch.linspace(0.02, 0.0, 33)
    origin = Origin("plate", ("a.wav",), per_newton=True, config=FitConfig(seed=7))
    phases, residual = torch.full((len(BANK),), phase, dtype=torch.float64), Residual(magnitude, force=background_force)
    return SoundField(BANK, gains, phases, residual, RATE, SAMPLES, origin)


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize(
    ("phase", "scaled", "pulse", "background_force"),
    [(0.0, False, None, 5.0), (0.7, False, ForcePulse(1e-3, "hertz"), None), (0.7, True, None, None)],
)
def test_a_blow_sounds_as_the_fields(name, phase, scaled, pulse, background_force):
    sound_field = sounding(name, phase=phase, scaled=scaled, background_force=background_force)
    table = SampledField.of(sound_field)
    rows = torch.tensor([0, 17, 149])
    for force in (None, 2.5):
        expected = sound_field.render(table.points[rows], forces=force, pulse=pulse)
        error = (table.render(rows, force=force, pulse=pulse) - expected).abs().max() / expected.abs().max()
        assert float(error) < 1e-5
    assert table.shared_damping == (name != "attention with dampings")


def test_the_formula_holds_in_plain_sums():
    """Of amplitudes, dampings and noise as they lie in the table, without the package's synthesis."""
    sound_field = sounding("attention with dampings", phase=0.4)
    table = SampledField.of(sound_field, limit=20)
    row = 11
    times = torch.arange(SAMPLES, dtype=torch.float64) / RATE
    sound = table.noise.double().clone()
    for mode, (frequency, damping) in enumerate(zip(table.frequency, table.damping[row], strict=True)):
        angle = 2 * torch.pi * frequency * times
        swing = table.gains[row, mode].real * torch.sin(angle) + table.gains[row, mode].imag * torch.cos(angle)
        sound += torch.exp(-damping * times) * swing
    expected = sound_field.render(table.points[[row]])[0].double()
    torch.testing.assert_close(sound, expected, rtol=0, atol=1e-5 * float(expected.abs().max()))


@pytest.mark.parametrize("scaled", [False, True])
def test_normals_of_an_elastic_model_are_its_bodys(scaled):
    table = SampledField.of(sounding("elastic", scaled=scaled))
    torch.testing.assert_close(table.normals, plate().normals(elastic().points).float())


def test_given_points_are_kept_and_fewer_are_the_fields_own_spread_out():
    chosen, normals = places(5, seed=9), torch.tensor([[0.0, 0.0, 2.0]]).expand(5, 3)
    given = SampledField.of(sounding("positional"), chosen, normals)
    assert torch.equal(given.points, chosen)
    torch.testing.assert_close(given.normals, normals / 2)
    assert (given.name, given.per_newton) == ("plate", True)
    table = SampledField.of(sounding("attention with dampings"))
    few = table.take(table.spread(9))
    rows = table.nearest(few.points)
    torch.testing.assert_close(few.render(torch.arange(9)), table.render(rows))
    torch.testing.assert_close(few.damping, table.damping[rows])
    table = SampledField.of(sounding("positional"), limit=12)
    own = positional().points
    assert len(table) == 12
    assert bool((table.points[:, None] == own).all(2).any(1).all())
    # Of 150 points, twelve at random lie closer: a plate of .24 x .17 m holds twelve about 6 cm apart.
    apart = torch.cdist(table.points, table.points) + torch.eye(12)
    assert float(apart.min()) > 0.04


def ball(count: int) -> torch.Tensor:
    drawn = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.normalize(drawn, dim=1)


def test_normals_point_outwards():
    out, far = ball(2000), torch.tensor([5.0, 0.0, 0.0])
    # Of two balls, each has its own outside.
    assert float((outward_normals(torch.cat([out, out + far])) * torch.cat([out, out])).sum(1).min()) > 0.9
    bowl = out[out[:, 2] < -0.3]
    assert float((outward_normals(bowl) * bowl).sum(1).median()) > 0.95
    two = outward_normals(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 3.0]]))
    assert two.tolist() == [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    ("given", "name", "value"),
    [
        ({"points": torch.zeros(0, 3)}, "points", 0),
        ({"points": torch.tensor([[0.0, 0.0, torch.nan]])}, "points", 1),
        ({"points": places(5, seed=9), "normals": torch.ones(4, 3)}, "normals", 4),
        ({"limit": 0}, "limit", 0),
    ],
)
def test_what_cannot_be_sampled_is_refused(given, name, value):
    with raises(ExportError, name=name, value=value):
        SampledField.of(sounding("positional"), **given)


def test_supporting_poles_are_counted_among_the_modes_that_sound(tmp_path):
    made = sounding("positional")
    report = {SUPPORTING: [1, 4]}
    # Twice as high, the last mode is beyond half the sample rate.
    bank = ModalBank(2.0 * BANK.frequency, BANK.damping)
    field = replace(made, bank=bank, origin=replace(made.origin, report=report))
    assert field.is_mode.tolist() == [True, False, True, True, False]
    table = SampledField.of(field)
    assert len(table.frequency) == 4
    assert table.supporting == table.take(torch.tensor([3])).supporting == (1,)
    assert table.frequency.tolist() == bank.frequency[:4].tolist()
    expected = field.render(table.points[:3])
    torch.testing.assert_close(table.render(torch.arange(3)), expected, rtol=0, atol=1e-5 * float(expected.abs().max()))
    make_bundle(table).write(tmp_path / "page")
    assert json.loads((tmp_path / "page" / "manifest.json").read_text())["supporting"] == [1]
    assert SampledField.of(made).supporting == ()
