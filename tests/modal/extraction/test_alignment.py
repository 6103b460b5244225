"""Recordings aligned with one another: delays that are known, recordings that cannot be aligned, measured data."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from avmsf.capture.audio import read_recording
from avmsf.capture.impacts import Impacts
from avmsf.capture.onset import find_onset
from avmsf.modal.extraction.alignment import _common_onset, align, coherence
from avmsf.modal.extraction.extract import extract_modes, extract_once
from avmsf.modal.extraction.finders import HighResolution
from factories.delayed_plate import cut

RATE, SAMPLES, LEAD = 16000.0, 6000, 320
FREQUENCY = torch.tensor([431.0, 902.5, 1370.0, 2204.0, 3317.0, 4750.0], dtype=torch.float64)
DAMPING = torch.tensor([12.0, 18.0, 15.0, 30.0, 40.0, 60.0], dtype=torch.float64)
PHASE = torch.tensor([0.3, 1.2, -0.7, 2.4, 0.0, 1.9], dtype=torch.float64)


def gains(contacts: int, modes: int, *, seed: int = 0) -> Tensor:
    return torch.randn(contacts, modes, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def damped(amplitudes: Tensor, starts: Tensor, *, phase: Tensor = PHASE, noise_db: float | None = None) -> Impacts:
    """Return recordings with impacts `starts` samples after sample 0 of `sounds`, exactly, between samples too."""
    modes = amplitudes.shape[1]
    times = (torch.arange(-LEAD, SAMPLES + LEAD, dtype=torch.float64)[None] - starts[:, None]) / RATE
    angles = 2 * math.pi * FREQUENCY[:modes, None] * times[:, None] + phase[..., :modes, None]
    waves = torch.exp(-DAMPING[:modes, None] * times.clamp(min=0)[:, None]) * angles.sin() * (times >= 0)[:, None]
    files = (amplitudes[:, :, None] * waves).sum(1)
    if noise_db is not None:
        noise = torch.randn(files.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(7))
        files = files + files.square().mean().sqrt() * 10 ** (noise_db / 20) * noise
    return cut(files, rate=RATE, lead=LEAD, samples=SAMPLES)


def jitter(contacts: int, deviation: float, *, seed: int = 3) -> Tensor:
    return deviation * torch.randn(contacts, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def error(found: Tensor, starts: Tensor) -> float:
    """Return the root mean square error of delays, but for what all have in common."""
    away = found - starts
    return float((away - away.median()).square().mean().sqrt())


@pytest.mark.parametrize("noise_db", [-60.0, -20.0])
@pytest.mark.parametrize(("deviation", "modes"), [(1.0, 6), (3.0, 3)])
def test_delays_are_recovered(deviation: float, modes: int, noise_db: float) -> None:
    starts = jitter(12, deviation)
    found = align(damped(gains(12, modes), starts, noise_db=noise_db))
    assert (found.agreement > 0.9).all()
    assert error(found.delays, starts) < 0.05
    assert found.coherence_after > max(0.98, found.coherence_before)


def test_recordings_that_are_aligned_stay_as_they_are() -> None:
    impacts = damped(gains(12, 6), torch.zeros(12, dtype=torch.float64), noise_db=-60.0)
    found = align(impacts)
    assert torch.equal(found.delays, torch.zeros(12, dtype=torch.float64))
    assert torch.equal(found.apply(impacts).sounds, impacts.sounds)


def test_loud_and_faint_recordings_and_signs_are_alike() -> None:
    starts, scale = jitter(10, 2.0), torch.tensor([1.0, -1.0, 30.0, 0.01, -5.0] * 2)
    found = align(damped(scale[:, None] * gains(10, 6), starts))
    assert error(found.delays, starts) < 0.02


def test_another_recording_is_aligned_by_the_phases_of_the_first() -> None:
    starts = jitter(14, 2.0)
    impacts = damped(gains(14, 6), starts, noise_db=-50.0)
    known, other = impacts.take(range(10)), impacts.take(range(10, 14))
    found = align(known)
    common = starts[:10] - found.delays
    aligned = found.apply(other)
    expected = other.delayed(starts[10:] - common.median())
    assert aligned.before is None
    assert float((aligned.sounds - expected.sounds).norm() / expected.sounds.norm()) < 0.03
    # The very recordings it was found of are moved by the delays that were found.
    assert torch.equal(found.apply(known).sounds, known.delayed(found.delays).sounds)


def test_a_recording_with_phases_of_its_own_is_named_and_moved_as_most_are() -> None:
    starts = jitter(10, 1.0)
    phase = PHASE.repeat(10, 1)
    phase[4] = torch.tensor([2.1, 0.2, 1.0, 0.8, 1.5, 0.4])
    found = align(damped(gains(10, 6), starts, phase=phase, noise_db=-50.0))
    kept = found.agreement > 0.5
    assert kept.tolist() == [row != 4 for row in range(10)]
    assert abs(found.delays[4] - found.start) < found.jitter
    assert error(found.delays[kept], starts[kept]) < 0.05


def test_phases_without_anything_in_common_hardly_move_starts() -> None:
    phase = 2 * math.pi * torch.rand(8, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    impacts = damped(1 + gains(8, 6).abs(), torch.zeros(8, dtype=torch.float64), phase=phase, noise_db=-50.0)
    found = align(impacts)
    assert found.agreement.mean() < 0.6
    assert found.delays.std() < 1.0
    assert max(found.coherence_before, found.coherence_after) < 0.7


def test_the_common_start_does_not_depend_on_where_between_samples_impacts_fall() -> None:
    starts, amplitudes = jitter(10, 2.0), gains(10, 6)
    found = []
    for common in (0.0, 0.3, 0.6):
        # Without phases sounds begin without a jump, which would not be limited to half the rate.
        each = align(damped(amplitudes, starts + common, phase=torch.zeros_like(PHASE), noise_db=-50.0))
        found.append(float((each.delays - starts).median()) - common)
    assert max(found) - min(found) < 0.15


def test_files_that_begin_within_the_sound_start_with_the_latest() -> None:
    cut = torch.tensor([0.0, 3.0, 7.0, 1.0, 12.0, 5.0, 2.0, 9.0], dtype=torch.float64)
    whole = damped(gains(8, 6), torch.zeros(8, dtype=torch.float64))
    trimmed = replace(whole.delayed(cut), before=torch.full((8, LEAD), torch.nan), after=torch.zeros(8, 0))
    found = align(trimmed)
    assert torch.allclose(found.delays, 12.0 - cut, atol=0.05)


def test_one_recording_and_noise_alone_are_not_aligned() -> None:
    impacts = damped(gains(2, 6), jitter(2, 1.0))
    assert align(impacts.take([0])) is None
    noise = torch.randn(4, SAMPLES, generator=torch.Generator().manual_seed(0))
    assert align(replace(impacts.take([0, 0, 1, 1]), sounds=noise, names=("a", "b", "c", "d"))) is None


def test_extraction_aligns_first_and_its_file_keeps_the_alignment(tmp_path: Path) -> None:
    starts = jitter(8, 2.0)
    impacts = damped(gains(8, 6), starts, noise_db=-50.0)
    plain = replace(impacts, before=None, after=None)
    assert extract_modes(plain, HighResolution()).alignment is None
    once, again = (extract_once(impacts, HighResolution(), tmp_path / "modes.safetensors") for _ in range(2))
    assert torch.equal(once.alignment.delays, again.alignment.delays)
    assert torch.equal(once.aligned(impacts).sounds, again.aligned(impacts).sounds)
    assert torch.equal(once.aligned(impacts.take([3])).sounds, again.aligned(impacts).sounds[3:4])
    assert coherence(once.gains.to(torch.complex128), once.bank.damping) > 0.99


def test_measured_impulse_responses_cut_by_a_threshold_get_their_starts_back(shared: Path) -> None:
    recordings = [read_recording(path) for path in sorted((shared / "tree43").glob("**/*.wav"))]
    rate, sounds = recordings[0].sample_rate, [each.response() for each in recordings]
    onsets = [find_onset(each, sample_rate=rate) for each in sounds]
    lead, length = max(onsets), min(len(each) - onset for each, onset in zip(sounds, onsets, strict=True))
    pairs = zip(sounds, onsets, strict=True)
    padded = [np.concatenate([np.full(lead - onset, np.nan), each[: onset + length]]) for each, onset in pairs]
    impacts = cut(torch.from_numpy(np.stack(padded)), rate=rate, lead=lead, samples=length)
    found = align(impacts)
    assert len(set(onsets)) > 1
    assert error(found.delays, -torch.tensor(onsets, dtype=torch.float64)) < 0.05
    assert found.coherence_after > 0.99 > found.coherence_before


def test_the_common_start_of_sounds_as_short_as_their_margins_is_that_of_long_ones() -> None:
    starts = jitter(8, 1.0)
    whole = damped(gains(8, 6), starts, noise_db=-60.0)
    files = torch.cat([whole.sounds, whole.after], dim=1)
    short = replace(whole, sounds=files[:, :LEAD], after=files[:, LEAD : 2 * LEAD])
    one, other = (_common_onset(each, starts, torch.ones(8).double()) for each in (whole, short))
    assert one == other
