"""Where the sounds of a capture start, and what its files hold on either side of them."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.signal import fftconvolve

from avmsf.capture import CaptureSettings, check, read_capture
from avmsf.capture.audio import Recording, read_recording
from avmsf.capture.prepare import prepare
from avmsf.capture.preprocess import start_with_impact
from avmsf.capture.table import Impact
from avmsf.datasets.recordings import build_capture
from factories.capture_folder import RATE, fill, ring
from oracles.plate import Plate, sample_contacts, strike

MARGIN = 160
"""20 ms at 8 kHz."""
NAMES = ("a.wav", "b.wav", "c.wav")


def pre_triggered(*leads: int) -> dict[str, np.ndarray]:
    """Return three recordings of 4000 samples whose impacts come `leads` samples after their starts."""
    return {
        name: ring(0.5, before=lead / RATE, noise=1e-4, seed=seed).astype(np.float32)
        for seed, (name, lead) in enumerate(zip(NAMES, leads, strict=True))
    }


def three_responses(samples: int) -> np.ndarray:
    """Return a response that starts with a sine, one that starts with a cosine, and a node's, that grows slowly."""
    time = np.arange(samples) / RATE
    decay = np.exp(-15 * time)
    one, two = 2 * np.pi * 700 * time, 2 * np.pi * 731 * time
    return decay * np.stack([np.sin(one) + np.sin(two), np.cos(one) + np.cos(two), 0.5 * (np.cos(one) - np.cos(two))])


@pytest.mark.parametrize("newtons", [None, (2.0, 0.5, 8.0)])
def test_the_margins_are_what_the_files_hold_around_the_sounds(tmp_path: Path, newtons) -> None:
    files = pre_triggered(40, 300, 1000)
    if newtons is None:
        folder = fill(tmp_path, replace=files)
    else:
        rows = [f"{name},{0.1 * row},0,0,{force}" for row, (name, force) in enumerate(zip(NAMES, newtons, strict=True))]
        folder = fill(tmp_path, replace=files, header="file,x,y,z,force_newtons", rows=rows)
    impacts = read_capture(folder, CaptureSettings(seconds=0.37)).impacts
    assert impacts.before is not None
    assert impacts.after is not None
    assert impacts.before.shape == impacts.after.shape == (3, MARGIN)
    onsets = [row.onset_seconds * RATE for row in check(folder).recordings]
    for row, (file, onset, lead) in enumerate(zip(files.values(), onsets, (40, 300, 1000), strict=True)):
        assert abs(onset - lead) <= 5
        start = round(onset) - MARGIN
        held = np.full(MARGIN + 2960 + MARGIN, np.nan)
        there = file[max(0, start) : start + len(held)]
        held[max(0, -start) : max(0, -start) + len(there)] = there / (1.0 if newtons is None else newtons[row])
        whole = torch.cat([impacts.before[row], impacts.sounds[row], impacts.after[row]])
        # The file's values in float32, the quotient rounded once.
        torch.testing.assert_close(whole, torch.from_numpy(held).float(), rtol=2e-7, atol=0, equal_nan=True)


def test_cut_at_the_true_starts_the_sounds_are_those_of_files_without_a_lead(tmp_path: Path) -> None:
    leads = (30, 217, 1003)
    impacts = read_capture(fill(tmp_path, replace=pre_triggered(*leads)), CaptureSettings(seconds=0.3)).impacts
    onsets = torch.tensor([row.onset_seconds * RATE for row in check(tmp_path).recordings], dtype=torch.float64)
    cut = impacts.delayed(torch.tensor(leads, dtype=torch.float64) - onsets.round())
    # Without a lead the sounds hold other noise, 1e-4 root mean square, in 7200 samples.
    clean = np.stack([ring(0.3, noise=0.0, seed=seed) for seed in range(3)])
    assert np.abs(cut.sounds.numpy() - clean).max() < 6e-4


def test_sounds_that_are_not_aligned_are_final(tmp_path: Path) -> None:
    impacts = read_capture(fill(tmp_path), CaptureSettings(align=False)).impacts
    assert impacts.before is None
    assert impacts.after is None


def test_before_a_push_is_the_file_in_its_unit() -> None:
    generator = np.random.default_rng(0)
    force, sound = np.zeros(4000), 1e-3 * generator.standard_normal(4000)
    force[100:109] = 4 * np.sin(np.pi * np.arange(1, 10) / 10)
    sound[97:] += ring(3903 / RATE, noise=0.0)
    found = prepare(
        Recording("a.wav", np.stack([force, sound]), float(RATE), "FLOAT"),
        CaptureSettings(force_channel=1, response_channel=2),
    )
    assert found.onset == 100
    np.testing.assert_allclose(found.before, sound[:100] / 4, rtol=1e-12)


def test_a_deconvolved_response_is_known_before_the_push_too() -> None:
    # The force channel is 6 samples late, so that the response begins at -6 samples.
    early, push = 6, np.array([0.5, 1.0, 0.5])
    response = ring(0.4, noise=0.0, seed=2)
    force, sound = np.zeros(4000), np.zeros(4000)
    force[300:303] = 5 * push
    heard = fftconvolve(response, 5 * push)
    sound[300 - early : 300 - early + len(heard)] = heard
    settings = CaptureSettings(force_channel=1, response_channel=2, normalize="deconvolve", regularization=1e-9)
    found = prepare(Recording("a.wav", np.stack([force, sound]), float(RATE), "FLOAT"), settings)
    # The window begins 16 samples and one width of the pulse (3) before it.
    assert len(found.before) == 19
    whole = np.concatenate([found.before, found.sound])[19 - early :][: len(response)]
    # What the response still holds where the file ends, exp(-20 * .4) of its peak, is missing.
    assert np.abs(whole - response).max() < 1e-3 * np.abs(response).max()
    assert np.abs(found.before[: 19 - early]).max() < 1e-3 * np.abs(response).max()


@pytest.mark.filterwarnings("ignore::avmsf.errors.CaptureWarning")  # the tree was struck twice at each point
@pytest.mark.parametrize("name", ["aircraft_response", "ruler10", "tree43"])
def test_measured_impulse_responses_are_not_cut(shared: Path, name: str) -> None:
    folder = shared / name
    impacts = read_capture(folder, CaptureSettings()).impacts
    first = np.stack([read_recording(folder / each).channels[0][:400] for each in impacts.names])
    assert np.array_equal(impacts.sounds[:, :400].numpy(), first.astype(np.float32))
    assert impacts.before is not None
    assert bool(impacts.before.isnan().all())
    report = check(folder, CaptureSettings())
    assert {row.onset_seconds for row in report.recordings} == {0.0}
    assert len(report.remarks) == 1


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("bowl_clips", CaptureSettings()),
        ("realimpact_clips", CaptureSettings()),
        ("hammer_clips", CaptureSettings(response_channel=1)),
        ("aircraft/impacts", CaptureSettings(response_channel=2)),
    ],
)
def test_measured_recordings_with_something_before_the_impact_are_cut(
    shared: Path, name: str, settings: CaptureSettings
) -> None:
    recordings = [read_recording(path) for path in sorted((shared / name).glob("*.wav"))]
    prepared = [prepare(each, settings) for each in recordings]
    assert not start_with_impact(prepared)


def test_a_displacement_s_and_a_velocity_s_response_start_with_the_impact(tmp_path: Path) -> None:
    sounds = three_responses(4000)
    folder = fill(tmp_path, replace=dict(zip(NAMES, sounds, strict=True)))
    impacts = read_capture(folder).impacts
    assert np.array_equal(impacts.sounds.numpy(), sounds.astype(np.float32))
    # By its own threshold the last one would lose what grows while its modes part.
    alone = [prepare(Recording(name, each[None], float(RATE), "FLOAT"), CaptureSettings()) for name, each in
             zip(NAMES, sounds, strict=True)]  # fmt: skip
    assert [each.onset for each in alone][2] > 0


@pytest.mark.parametrize("rate", [8000.0, 96_000.0])
@pytest.mark.parametrize("contact_time", [0.0, 5e-4])
@pytest.mark.parametrize("lead", [0, 6, 100])
def test_a_plate_s_responses_start_with_the_impact_at_any_rate(rate: float, contact_time: float, lead: int) -> None:
    plate, generator = Plate(alpha=40.0), torch.Generator().manual_seed(0)
    contacts = sample_contacts(plate, 12, generator=generator)
    sounds = strike(
        plate, contacts, sample_rate=rate, seconds=0.3, generator=generator, noise_db=-40.0, highest=2500.0,
        contact_time=contact_time,
    ).sounds.double().numpy()  # fmt: skip
    # Before the impact there is noise 40 dB down as well.
    noise = (
        1e-2 * np.sqrt(np.mean(sounds**2)) * np.random.default_rng(0).standard_normal((12, round(lead * rate / 8e3)))
    )
    files = [Recording("plate", each[None], rate, "FLOAT") for each in np.concatenate([noise, sounds], axis=1)]
    prepared = [prepare(each, CaptureSettings()) for each in files]
    assert start_with_impact(prepared) == (lead == 0)


@pytest.mark.parametrize("leads", [(6, 6, 6), (3, 9, 5), (0, 0, 100)])
def test_with_anything_before_the_impact_each_onset_is_found(tmp_path: Path, leads: tuple[int, ...]) -> None:
    folder = fill(tmp_path, replace=pre_triggered(*leads))
    report = check(folder)
    assert report.remarks == ()
    for row, lead in zip(report.recordings, leads, strict=True):
        assert abs(row.onset_seconds * RATE - lead) <= 3


def test_a_force_channel_says_where_an_impulse_response_starts(tmp_path: Path) -> None:
    force = np.zeros(4000)
    force[1:6] = [1, 3, 4, 3, 1]
    files = {name: np.stack([force, ring(0.5, seed=seed)], axis=1) for seed, name in enumerate(NAMES)}
    settings = CaptureSettings(force_channel=1)
    report = check(fill(tmp_path, replace=files), settings)
    assert report.remarks == ()
    assert {row.onset_seconds for row in report.recordings} == {1 / RATE}


def test_a_dataset_s_recordings_have_margins_in_the_sounds_unit() -> None:
    files = {name: each.astype(np.float64) for name, each in pre_triggered(40, 300, 1000).items()}
    recordings = [
        (Impact(name, [float(row)] * 3, gain_db=20.0), Recording(name, each[None], float(RATE), "FLOAT"))
        for row, (name, each) in enumerate(files.items())
    ]
    impacts = build_capture(
        recordings, name="cup", origin="set", settings=CaptureSettings(seconds=0.3), recorded=False
    ).impacts
    assert impacts.before is not None
    assert impacts.after is not None
    for whole, each in zip(torch.cat([impacts.before, impacts.sounds, impacts.after], 1), files.values(), strict=True):
        held = whole[~whole.isnan()].numpy()
        start = int(np.argmin(np.abs(each[:1001] / 10 - held[0])))
        np.testing.assert_allclose(held, each[start : start + len(held)] / 10, rtol=2e-7)
