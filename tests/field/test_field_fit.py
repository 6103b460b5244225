"""A field fitted to a plate whose modes are known in closed form, and the settings of a fit."""

import cmath
import math
from dataclasses import replace
from functools import cache
from itertools import product

import pytest
import torch

from avmsf.errors import FitError
from avmsf.evaluation.metrics import relative_stft_error
from avmsf.field.config import PAPER, FitConfig
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.losses import spectral_loss
from avmsf.field.sound_field import SoundField
from avmsf.field.training import Progress
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.least_squares import fit_sine_gains
from avmsf.modal.modes import ModalBank, synthesize
from factories.plate_field import PLATE, QUICK, RATE, plate_extraction, plate_fit, plate_impacts, same, tensors_of
from factories.raising import raises
from oracles.plate import plate_modes

LONG = replace(QUICK, width=32, hidden=128, warmup_steps=300, steps=60, correction_rate=3e-3)
SHORT = replace(QUICK, warmup_steps=4, steps=4)
VALIDATED = replace(SHORT, damping="validated")


@cache
def short_fit() -> SoundField:
    return plate_fit(SHORT)


@cache
def validated_fit() -> SoundField:
    return plate_fit(VALIDATED)


@cache
def long_fit() -> tuple[SoundField, list[Progress]]:
    told: list[Progress] = []
    return plate_fit(LONG, progress=told.append), told


def test_a_fit_reproduces_the_contacts_that_it_was_trained_on():
    field, impacts = long_fit()[0], plate_impacts()
    sounds = field.render(impacts.contacts)
    error = float(relative_stft_error(sounds, impacts.sounds, sample_rate=RATE, fft_sizes=(1024, 256)).mean())
    # Noise 40 dB down alone costs some two hundredths of the spectrum; silence costs 1, and .055 was measured.
    assert error < 0.08
    told = long_fit()[1]
    assert [(each.stage, each.step, each.steps) for each in told] == [("fit", step + 1, 360) for step in range(360)]


def test_training_mends_what_the_extraction_left_wrong():
    """Frequencies .2 Hz and dampings 5 % off, with the network's gains, come closer to the plate's."""
    truth, bank = plate_modes(PLATE, plate_impacts().contacts, highest=2500.0), long_fit()[0].bank
    # At most .10 Hz and 3 % were measured, on two machines.
    assert float((bank.frequency - truth.frequency).abs().max()) < 0.13
    assert float((bank.damping / truth.damping - 1).abs().max()) < 0.04


def test_the_same_seed_gives_the_same_field_to_the_last_bit_and_another_another():
    torch.manual_seed(1)
    first = validated_fit()
    torch.manual_seed(2)
    before = torch.get_rng_state()
    again = plate_fit(VALIDATED)
    assert same(first, again)
    assert first.origin == again.origin
    assert torch.equal(torch.get_rng_state(), before)
    assert not torch.equal(plate_fit(replace(VALIDATED, seed=1)).bank.frequency, first.bank.frequency)


def test_recordings_in_float64_give_the_same_field():
    impacts = plate_impacts()
    wide = replace(impacts, sounds=impacts.sounds.double())
    modes = plate_extraction(impacts)
    wide_modes = replace(modes, residual=replace(modes.residual, magnitude=modes.residual.magnitude.double()))
    field = plate_fit(SHORT, train=wide, modes=wide_modes)
    assert same(field, short_fit())
    assert {each.dtype for each in field.gain_field.state_dict().values()} == {torch.float32}
    assert field.residual.magnitude.dtype == torch.float32


def flipped(modes: Extraction) -> Extraction:
    order = torch.arange(len(modes.bank)).flip(0)
    return Extraction(modes.bank.take(order), modes.gains[:, order], modes.residual)


def test_modes_come_out_by_frequency():
    """Modes in the wrong order come out ascending, and each with its own gains."""
    impacts = plate_impacts()
    modes = plate_extraction(impacts)
    field = plate_fit(replace(LONG, steps=0), modes=flipped(modes))
    # Nothing but the network moves in warm-up.
    assert torch.equal(field.bank.frequency, modes.bank.frequency)
    assert torch.equal(field.residual.magnitude, modes.residual.magnitude)
    gains = fit_sine_gains(impacts.sounds, modes.bank, sample_rate=impacts.sample_rate)
    assert float((field.gains(impacts.contacts) - gains).square().sum() / gains.square().sum()) < 0.02


def test_supporting_poles_are_the_same_poles_in_the_field():
    modes = flipped(plate_extraction(plate_impacts()))
    field = plate_fit(SHORT, modes=modes, supporting=[0])
    assert field.is_mode.tolist() == [True] * (len(modes.bank) - 1) + [False]


@pytest.mark.parametrize("phase", ["common", "sine"])
def test_modes_that_start_late_keep_their_phase_unless_sines_are_asked_for(phase):
    impacts = plate_impacts()
    modes = plate_extraction(impacts)
    turn = torch.full((len(modes.bank),), 1.2, dtype=torch.float64)
    late = synthesize(
        modes.gains, modes.bank.frequency, modes.bank.damping, turn, samples=impacts.sounds.shape[1], sample_rate=RATE
    )
    config = replace(LONG, steps=0, residual=False, phase=phase)
    turned = replace(modes, gains=modes.gains * cmath.exp(1.2j))
    field = plate_fit(config, train=replace(impacts, sounds=late), modes=turned)
    error = float((field.render(impacts.contacts) - late).square().sum() / late.square().sum())
    # A sine holds cos^2 1.2 = .13 of the energy of one that starts 1.2 radians later.
    if phase == "common":
        assert torch.allclose(field.phase, turn)
        assert error < 0.03
    else:
        assert not field.phase.any()
        assert error > 0.8


def test_validation_holds_out_training_contacts_and_says_which():
    field = validated_fit()
    report = field.origin.report
    assert report["validated"] is True
    assert report["damping"] in ("shared", "per-contact")
    # A quarter of twelve, and of the twelve: the fit sees no others.
    assert len(report["validation_contacts"]) == 3
    assert set(report["validation_contacts"]) < set(plate_impacts().names)
    assert field.origin.trained_on == plate_impacts().names
    envelopes = report["validation_envelope"]
    assert envelopes.keys() == {"shared", "per-contact"}
    assert envelopes[report["damping"]] == min(envelopes.values())
    assert (field.gain_field.to_dampings is not None) == (report["damping"] == "per-contact")


def test_a_trial_does_not_learn_from_the_recordings_held_out():
    impacts, modes = plate_impacts(), plate_extraction(plate_impacts())
    held = validated_fit().origin.report["validation_contacts"]
    sounds = impacts.sounds.clone()
    sounds[[impacts.names.index(name) for name in held]] *= -0.3
    losses, reports = [], []
    for each in (impacts.sounds, sounds):
        told: list[Progress] = []
        field = plate_fit(VALIDATED, train=replace(impacts, sounds=each), modes=modes, progress=told.append)
        losses.append([step.loss for step in told])
        reports.append(field.origin.report)
    assert reports[1]["validation_contacts"] == held
    # Two trials of eight steps, then a fit that learns from all; and the validation heard the difference.
    assert losses[0][:16] == losses[1][:16]
    assert losses[0][16:] != losses[1][16:]
    assert reports[0]["validation_spectral"] != reports[1]["validation_spectral"]


def test_noise_is_measured_after_training_or_trained():
    impacts, measured = plate_impacts(), plate_extraction(plate_impacts()).residual.magnitude
    field = long_fit()[0]
    # The plate's noise is white, 40 dB below its sounds on average. What the modes do not yet explain adds to it.
    level = 0.01 * float(impacts.sounds.square().mean().sqrt())
    decibels = 20 * torch.log10(field.residual.magnitude / level)
    assert -1.0 < float(decibels.median()) < 3.0
    residual = plate_fit(replace(SHORT, noise_rate=0.1)).residual
    # Trained noise grows with the force, as the paper's.
    assert (field.residual.force, residual.force) == (1.0, None)
    trained = residual.magnitude
    # Adam moves each logarithm by about the rate at each of four steps.
    assert 0.02 < float(torch.log(trained / measured).abs().mean()) < 0.5


def test_background_has_one_level_in_recordings_that_are_not_divided_by_their_forces():
    impacts, forces = plate_impacts(), 2.0 ** (torch.arange(12) % 4)
    level = 0.5 * float(impacts.sounds.square().mean().sqrt())
    noise = level * torch.randn(impacts.sounds.shape, generator=torch.Generator().manual_seed(3))
    train = replace(impacts, sounds=impacts.sounds + noise / forces[:, None], forces=forces)
    field = plate_fit(replace(QUICK, warmup_steps=0, steps=1), train=train, gains=MixtureEstimator())
    assert field.residual.force == pytest.approx(2.0**1.5)
    decibels = 20 * torch.log10(field.residual.magnitude * field.residual.force / level)
    # 12 recordings tell each of 33 bands to .4 dB. The plate's own noise, which here grows with the force, adds .05 dB.
    assert abs(float(decibels.mean())) < 0.3
    assert float(decibels.std()) < 1.0


def test_without_a_warm_up_modes_are_as_strong_as_they_were_found_whatever_their_phase():
    modes = plate_extraction(plate_impacts())
    late = replace(modes, gains=1j * modes.gains)
    sines, cosines = (plate_fit(replace(SHORT, warmup_steps=0), modes=each).gain_field for each in (modes, late))
    assert float(sines.gain_scale.min()) > 0
    assert torch.allclose(cosines.gain_scale, sines.gain_scale)


def test_forces_make_a_field_per_newton():
    assert plate_fit(SHORT, train=plate_impacts(forces=True)).origin.per_newton is True
    assert short_fit().origin.per_newton is False


def test_a_silent_recording_and_a_mode_that_is_never_excited_do_no_harm():
    impacts = plate_impacts()
    sounds = impacts.sounds.clone()
    sounds[4] = 0
    modes = plate_extraction(impacts)
    # 3.9 kHz: above all modes of the plate that were struck.
    frequency = torch.cat([modes.bank.frequency, torch.tensor([3900.0], dtype=torch.float64)])
    damping = torch.cat([modes.bank.damping, torch.tensor([20.0], dtype=torch.float64)])
    zeros = torch.zeros(12, 1)
    more = Extraction(ModalBank(frequency, damping), torch.cat([modes.gains, zeros], 1), modes.residual)
    field = plate_fit(VALIDATED, train=replace(impacts, sounds=sounds), modes=more)
    assert all(bool(torch.isfinite(each).all()) for each in tensors_of(field).values())
    gains = field.gains(impacts.contacts).abs().mean(0)
    assert float(gains[-1]) < 0.1 * float(gains[:-1].mean())


def test_recordings_that_cannot_be_fitted_are_refused():
    impacts, modes = plate_impacts(), plate_extraction(plate_impacts())
    with raises(FitError, name="modes", value=12):
        plate_fit(SHORT, train=impacts.take(range(7)), modes=modes)
    with raises(FitError, name="train", value="silence"):
        plate_fit(SHORT, train=replace(impacts, sounds=torch.zeros_like(impacts.sounds)))
    with raises(FitError, name="modes", value=pytest.approx(2302.0, abs=1.0)):
        plate_fit(SHORT, train=replace(impacts, sample_rate=4000.0))
    for name, known in (("sounds", impacts.sounds), ("contacts", impacts.contacts), ("directions", torch.ones(12, 3))):
        lost = known.clone()
        lost[2, 0] = math.nan
        with raises(FitError, name="plate/003", row=2):
            plate_fit(SHORT, train=replace(impacts, **{name: lost}), modes=modes)
    with raises(FitError, name="plate/003", value=0.0, row=2):
        plate_fit(SHORT, train=replace(impacts, forces=torch.tensor([1.0, 2.0, 0.0]).repeat(4)))
    none = torch.zeros(0, dtype=torch.float64)
    empty = Extraction(ModalBank(none, none), torch.zeros(12, 0) + 0j, modes.residual)
    with raises(FitError, name="modes", value=0):
        plate_fit(SHORT, modes=empty)


@pytest.mark.parametrize(("every", "turns"), [(1, [0, 0, 0, 0]), (2, [0, 1, 0, 1]), (3, [1, 2, 0, 1])])
def test_steps_take_turns_at_the_frames(monkeypatch, every, turns):
    """Whole sounds and beginnings alike; the warm-up's four steps compare none, but count."""
    asked = []

    def noted(sounds, target, *, first=0, every=1):
        asked.append((first, every))
        return spectral_loss(sounds, target, first=first, every=every)

    monkeypatch.setattr("avmsf.field.training.spectral_loss", noted)
    plate_fit(replace(SHORT, interleave=every))
    assert asked == [(turn, every) for turn in turns for _ in ("whole", "early")]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *product(["clusters", "width", "hidden", "early", "interleave"], [0, -1]),
        *product(["bands", "layers", "steps", "warmup_steps", "hop", "seed"], [-1]),
        *product(["correction_rate", "weight_decay", "early_weight"], [-0.1, math.inf, math.nan]),
        *product(["feature_scale", "warmup_rate", "learning_rate"], [0.0, -1.0, math.inf, math.nan]),
        *product(["validation"], [-0.1, 0.6, math.nan]),
        *product(["fft_sizes"], [(), (1024, 0), (1023,), (1020,)]),
    ],
)
def test_settings_that_no_fit_can_run_with_are_refused_by_name(name, value):
    with raises(FitError, name=name) as caught:
        FitConfig(**{name: value})
    assert caught.value.value is value


def test_a_fit_of_no_steps_is_refused():
    with raises(FitError, name="steps", value=0):
        FitConfig(warmup_steps=0, steps=0)


def test_resolutions_follow_the_sample_rate():
    config = FitConfig(fft_sizes=(2048, 256), early=8192)
    assert config.resolutions(44100.0) == config.resolutions(48000.0) == ((2048, 256), (512, 64), 8192)
    assert config.resolutions(96000.0) == ((4096, 512), (1024, 128), 16384)
    # A structure at 400 Hz: a quarter, and even, as the transform needs it.
    assert config.resolutions(400.0) == ((512, 64), (128, 16), 2048)
    assert PAPER.resolutions(48000.0)[1] == (64, 64, 64, 64)
    assert PAPER.interleave == 1, "the paper compares all frames at every step"
    assert FitConfig(fft_sizes=(24,)).resolutions(400.0)[0] == (6,)


def test_a_fit_needs_no_gradients_of_its_caller():
    with torch.no_grad():
        found = plate_fit(SHORT)
    assert same(found, short_fit())
