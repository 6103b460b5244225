"""DiffSound: its family of bodies, its objectives, what it recovers, and its gains and weights."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from avmsf.baselines.diffsound.body_family import BodyFamily, body_family
from avmsf.baselines.diffsound.losses import ClipSpectra, divergence
from avmsf.baselines.diffsound.material_fit import (
    DampingCurve,
    DiffSoundConfig,
    MaterialFit,
    clip_spectra,
    fit_material,
    minimize_within,
    predicted_sound,
)
from avmsf.baselines.diffsound.renderer import DiffSound, leveled
from avmsf.capture.impacts import Impacts
from avmsf.errors import AvmsfError, EvaluationError, LocationError, SimulationError
from avmsf.fem.isotropic import isotropic_modes
from avmsf.fem.material import GLASS
from avmsf.mesh.surface import Surface
from avmsf.modal.modes import ModalBank, synthesize
from avmsf.modal.residual_noise import Residual
from avmsf.modal.spectra import magnitude_stft
from factories.made_sheet import sheet_over
from oracles.block import block


@cache
def sheet() -> Surface:
    # A little bent, so that stretching takes part.
    return sheet_over(np.linspace(0, 0.2, 9), np.linspace(0, 0.14, 7), lambda x, y: 0.4 * x**2)


@cache
def walls() -> BodyFamily:
    return body_family(sheet(), count=6, dofs=3000)


def test_an_open_sheet_has_walls_whose_frequencies_between_thicknesses_are_those_of_direct_solves():
    family, ratio = walls(), torch.tensor(0.3, dtype=torch.float64)
    assert family.walled
    between = float(np.sqrt(family.thickness[1] * family.thickness[2]))
    found = family.squares(ratio, torch.tensor(between, dtype=torch.float64).log()).sqrt()
    error = (found / family.at(between).squares(ratio).sqrt() - 1.0).abs()
    # Where two modes change places the curves of sorted frequencies have a kink.
    assert float(error.mean()) < 0.015
    assert float(error.max()) < 0.05


def test_a_family_is_exact_at_a_thickness_that_it_includes():
    family, ratio = walls(), torch.tensor(0.3, dtype=torch.float64)
    between = 1.2 * family.thickness[1]
    place = torch.tensor(between, dtype=torch.float64).log()
    known = family.at(between).squares(ratio)
    torch.testing.assert_close(family.including(between).squares(ratio, place), known, rtol=1e-9, atol=0.0)
    # Next to a body that it has, the curve between the two would follow their meshes' differences.
    assert family.including(family.thickness[1] * (1.0 + 1e-6)) is family


def test_thin_walls_bend_in_proportion_to_their_thickness():
    flat = Surface(sheet().vertices * torch.tensor([1.0, 1.0, 0.0]), sheet().faces)
    family = body_family(flat, count=4, dofs=3000)
    ratio = torch.tensor(0.3, dtype=torch.float64)
    first, second = (each.squares(ratio).sqrt() for each in family.bodies[:2])
    thicker = family.thickness[1] / family.thickness[0]
    torch.testing.assert_close(second / first, torch.full_like(first, thicker), rtol=0.03, atol=0.0)


RATE, SAMPLES = 48_000.0, 24_000
STIFFNESS, POISSON = 1.3 * GLASS.young / GLASS.density, 0.27
SILENT = Residual(torch.zeros(257))


@cache
def family() -> BodyFamily:
    # No two sides alike: no mode has a twin.
    return BodyFamily((isotropic_modes(block((0.19, 0.11, 0.013), (6, 4, 1)), count=12),), ())


@cache
def true_modes() -> tuple[torch.Tensor, torch.Tensor]:
    frequency = known_fit().modes().frequency
    return frequency, 8.0 + 2e-8 * (2.0 * math.pi * frequency).square()


def struck(amplitudes: torch.Tensor, contacts: torch.Tensor | None = None) -> Impacts:
    frequency, damping = true_modes()
    sounds = synthesize(amplitudes, frequency, damping, samples=SAMPLES, sample_rate=RATE)
    places = torch.zeros(len(sounds), 3) if contacts is None else contacts
    return Impacts(places, sounds, RATE, tuple(f"{row}.wav" for row in range(len(sounds))))


def curve() -> DampingCurve:
    return DampingCurve.of(ModalBank(*true_modes()))


def known_fit() -> MaterialFit:
    return MaterialFit(STIFFNESS, POISSON, None, 0.0, family().bodies[0])


CONTACTS = torch.tensor([[0.02, 0.03, 0.013], [0.11, 0.09, 0.013], [0.17, 0.01, 0.013], [0.07, 0.05, 0.013]])


@cache
def simulated() -> Impacts:
    """Return impacts that sound as DiffSound renders them, each mode 1 to 3 times as strong."""
    plain = leveled(known_fit(), curve(), struck(torch.ones(4, 12), CONTACTS), SILENT, weighted=False)
    strength = torch.linspace(1.0, 3.0, 12, dtype=torch.float64)
    return struck((plain.gains(CONTACTS) * strength / plain.weight[0] * 1e4).float(), CONTACTS)


@cache
def rendered(weighted: bool = False) -> DiffSound:
    return leveled(known_fit(), curve(), simulated(), SILENT, weighted=weighted)


def test_the_divergence_of_points_on_a_line_is_that_of_their_sorted_matching():
    generator = torch.Generator().manual_seed(0)
    one, other = torch.rand(2, 200, 1, generator=generator, dtype=torch.float64)
    other = other + 0.3
    sorted_cost = 0.5 * (one.sort(dim=0).values - other.sort(dim=0).values).square().mean()
    # A blur of .01 changes a distance of .1 to .5 by little.
    torch.testing.assert_close(divergence(one, other), sorted_cost, rtol=0.03, atol=0.0)


def test_objectives_vanish_for_the_clip_itself_and_for_nothing_else():
    frequency, damping = true_modes()
    clip, heard = predicted_sound(frequency, damping)
    other, moved = predicted_sound(1.1 * frequency, damping)
    spectra = ClipSpectra(clip[None], 32_000.0)
    assert float(spectra.difference(clip)) == 0.0
    assert float(spectra.transport(clip, heard, row=0)) == pytest.approx(0.0, abs=1e-3)
    assert float(spectra.difference(other)) > 1.0
    assert float(spectra.transport(other, moved, row=0)) > 0.01


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_transport_pulls_a_mode_towards_one_that_it_does_not_overlap(factor):
    damping = torch.tensor([30.0], dtype=torch.float64)
    clip, _ = predicted_sound(torch.tensor([4000.0], dtype=torch.float64), damping)
    frequency = torch.tensor([4000.0 * factor], dtype=torch.float64, requires_grad=True)
    sound, heard = predicted_sound(frequency, damping)
    ClipSpectra(clip[None], 32_000.0).transport(sound, heard, row=0).backward()
    assert frequency.grad is not None
    assert math.copysign(1.0, float(frequency.grad)) == math.copysign(1.0, factor - 1.0)


def test_the_order_and_loudness_of_recordings_change_no_difference():
    impacts = struck(torch.rand(3, 12, generator=torch.Generator().manual_seed(1)) + 0.5)
    sound, _ = predicted_sound(*true_modes())
    straight = clip_spectra(impacts).difference(sound)
    other = impacts.take([2, 0, 1])
    other = replace(other, sounds=other.sounds * torch.tensor([[1.0], [0.01], [50.0]]))
    torch.testing.assert_close(clip_spectra(other).difference(sound), straight, rtol=1e-4, atol=0.0)


def test_the_damping_curve_is_the_lower_envelope_of_slow_modes():
    frequency = torch.tensor([100.0, 200.0, 300.0, 1700.0, 1800.0], dtype=torch.float64)
    bank = ModalBank(frequency, torch.tensor([9.0, 5.0, 400.0, 20.0, 350.0], dtype=torch.float64))
    found = DampingCurve.of(bank)
    assert found.damping == (5.0, 20.0)
    assert found.frequency == (270.0, 1770.0)
    between = found(torch.tensor([10.0, 1020.0, 9000.0], dtype=torch.float64))
    torch.testing.assert_close(between, torch.tensor([5.0, 12.5, 20.0], dtype=torch.float64))


@pytest.mark.slow
def test_it_recovers_the_material_of_a_body_that_sounds_as_it_assumes():
    spectra = clip_spectra(struck(torch.ones(2, 12)))
    found = fit_material(spectra, curve(), family(), DiffSoundConfig(transport_steps=2, difference_steps=2))
    assert found.stiffness == pytest.approx(STIFFNESS, rel=0.02)
    assert found.poisson == pytest.approx(POISSON, abs=0.03)


@pytest.mark.slow
def test_it_recovers_the_thickness_of_a_wall_that_lies_between_those_computed():
    # A little bent, so that stretching takes part: thickness and stiffness of a flat sheet cannot be told apart.
    sheet = sheet_over(np.linspace(0, 0.2, 9), np.linspace(0, 0.14, 7), lambda x, y: 2.0 * x**2)
    walls = body_family(sheet, count=8, dofs=2000)
    thickness = 1.2 * walls.thickness[1]
    frequency = walls.at(thickness).modes(replace(GLASS, young=1.3 * GLASS.young, poisson=POISSON)).frequency
    damping = 8.0 + 2e-8 * (2.0 * math.pi * frequency).square()
    sounds = synthesize(torch.ones(1, 8), frequency, damping, samples=SAMPLES, sample_rate=RATE)
    clips = clip_spectra(Impacts(torch.zeros(1, 3), sounds, RATE, ("1.wav",)))
    known = DampingCurve.of(ModalBank(frequency, damping))
    found = fit_material(
        clips, known, walls, DiffSoundConfig("glass", transport_steps=1, difference_steps=1, search=40)
    )
    assert found.thickness == pytest.approx(thickness, rel=0.05)
    assert found.stiffness == pytest.approx(STIFFNESS, rel=0.02)


def test_twice_the_signal_renders_twice_as_loud():
    loud = replace(simulated(), sounds=2.0 * simulated().sounds)
    twice = leveled(known_fit(), curve(), loud, SILENT, weighted=True)
    torch.testing.assert_close(twice.render(CONTACTS), 2.0 * rendered(True).render(CONTACTS), rtol=1e-3, atol=1e-6)


def test_gains_are_those_of_the_mode_shapes_over_frequencies_and_opposite_from_the_other_side():
    down = torch.tensor([[0.0, 0.0, -1.0]]).expand(4, 3)
    gains = rendered().gains(CONTACTS, directions=down)
    torch.testing.assert_close(rendered().gains(CONTACTS, directions=-down), -gains)
    # From above that is straight into the surface, as where no direction is known.
    torch.testing.assert_close(rendered().gains(CONTACTS), gains)
    torch.testing.assert_close(rendered().gains(CONTACTS, directions=0.0 * down), gains)
    modes = known_fit().modes()
    along = modes.at(CONTACTS)[:, :, 2]
    level = gains / (along / rendered().bank.frequency)
    torch.testing.assert_close(level, level[0, 0].expand_as(level), rtol=1e-9, atol=0.0)


def test_weights_make_training_spectra_no_worse_and_find_the_strengths_of_modes():
    plain, weighted = rendered(), rendered(True)
    assert float(weighted.weight.min()) >= 0.0

    def misfit(renderer: DiffSound) -> float:
        atoms = torch.eye(12, dtype=torch.float64)
        own = synthesize(atoms, renderer.bank.frequency, renderer.bank.damping, samples=SAMPLES, sample_rate=RATE)
        parts = magnitude_stft(own, fft_size=2048, hop=512).flatten(1)
        recorded = magnitude_stft(simulated().sounds.double(), fft_size=2048, hop=512).flatten(1)
        return float((renderer.gains(CONTACTS).abs() @ parts - recorded).square().sum())

    assert misfit(weighted) <= misfit(plain)
    moving = plain.gains(CONTACTS).abs().amax(dim=0)
    moving = moving > 0.05 * moving.max()
    ratio = (weighted.weight / torch.linspace(1.0, 3.0, 12, dtype=torch.float64))[moving]
    # Where spectra of modes overlap, magnitudes do not add up.
    torch.testing.assert_close(ratio / ratio.median(), torch.ones_like(ratio), rtol=0.15, atol=0.0)


def test_a_rendered_sound_is_located_where_it_was_struck():
    points = known_fit().modes().nodes
    points = points[(points[:, 2] > 0.0129) & (points[:, 0] < 0.09) & (points[:, 1] < 0.05)]
    down = torch.tensor([[0.0, 0.0, -1.0]])
    gains = rendered().gains(points, directions=down.expand(len(points), 3))
    for row in (0, 7, 11):
        sound = rendered().render(points[row : row + 1].float(), directions=down)[0]
        for heard in (sound, -sound, torch.nn.functional.pad(sound, (3, 0))):
            assert int(rendered().distance(gains, heard).argmin()) == row
        assert float(rendered().distance(gains, -sound)[row]) == pytest.approx(0.0, abs=1e-3)
    with pytest.raises(LocationError):
        rendered().distance(gains, torch.zeros(SAMPLES))


def test_a_silent_recording_among_others_counts_for_nothing():
    amplitudes = torch.ones(2, 12)
    amplitudes[1] = 0.0
    assert len(clip_spectra(struck(amplitudes)).clips) == 1


def of_scale(scale: float) -> BodyFamily:
    solid = block((0.19 * scale, 0.11 * scale, 0.013 * scale), (6, 4, 1))
    return BodyFamily((isotropic_modes(solid, count=12),), ())


REFUSED: dict[str, tuple[type[AvmsfError], Callable[[], object]]] = {
    "an unknown material": (SimulationError, lambda: DiffSoundConfig("unobtainium")),
    "silence": (EvaluationError, lambda: clip_spectra(struck(torch.zeros(1, 12)))),
    "silence to level": (
        EvaluationError,
        lambda: leveled(known_fit(), curve(), struck(torch.zeros(1, 12)), SILENT, weighted=True),
    ),
    "dull sounds": (
        EvaluationError,
        lambda: DampingCurve.of(ModalBank(true_modes()[0], torch.full((12,), 2e3).double())),
    ),
    "a body in millimeters": (EvaluationError, lambda: fit_material(clip_spectra(simulated()), curve(), of_scale(1e3))),
    "a tiny body": (EvaluationError, lambda: fit_material(clip_spectra(simulated()), curve(), of_scale(1e-4))),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_fitted_is_refused(what):
    error, call = REFUSED[what]
    with pytest.raises(error):
        call()


def test_a_search_may_start_on_its_bounds_and_finds_the_least():
    generator = torch.Generator().manual_seed(0)
    for _ in range(40):
        low = torch.randn(3, dtype=torch.float64, generator=generator)
        bounds = torch.stack([low, low + torch.rand(3, dtype=torch.float64, generator=generator)])
        # Whatever rounding makes of the bounds, a start on one of them is a place to search from.
        found = minimize_within(bounds, lambda point: float(point.square().sum()), bounds[1], generations=1)
        assert bool(((found >= bounds[0]) & (found <= bounds[1])).all())
    middle = bounds.mean(0)
    found = minimize_within(bounds, lambda point: float((point - middle).square().sum()), bounds[0], generations=60)
    torch.testing.assert_close(found, middle, rtol=0, atol=1e-3)
