"""Metrics on sounds whose distance is known in closed form, and on sounds that cannot be compared."""

import importlib.util
import json
import math
from functools import partial
from pathlib import Path

import pytest
import torch
from corpus import make as corpus

from avmsf.errors import EvaluationError
from avmsf.evaluation.cdpam import Cdpam
from avmsf.evaluation.metrics import (
    default_fft_sizes,
    envelope_distance,
    log_mel_distance,
    relative_stft_error,
    spectrogram_distance,
    validate,
)
from avmsf.modal.clips import resampled
from avmsf.modal.spectra import magnitude_stft
from factories.raising import raises

RATE = 24000.0
CORPUS = Path(__file__).parent / "corpus"
METRICS = {
    "relative": partial(relative_stft_error, sample_rate=RATE, fft_sizes=(512, 128)),
    "l1": partial(spectrogram_distance, sample_rate=RATE),
    "l1_log": partial(log_mel_distance, sample_rate=RATE),
    "envelope": partial(envelope_distance, sample_rate=RATE),
}
every_metric = pytest.mark.parametrize("metric", METRICS.values(), ids=METRICS.keys())


def clips(rows: int = 3, *, seed: int = 0) -> torch.Tensor:
    """Decaying sines of different pitch and strength on a faint floor, .2 s."""
    generator = torch.Generator().manual_seed(seed)
    times = torch.arange(4800, dtype=torch.float64) / RATE
    pitch = 500.0 * (1 + torch.arange(rows, dtype=torch.float64))[:, None]
    strength = 0.3 / (1 + torch.arange(rows, dtype=torch.float64))[:, None]
    sounds = strength * torch.exp(-20 * times) * torch.sin(2 * math.pi * pitch * times)
    return sounds + 1e-3 * torch.randn(sounds.shape, generator=generator, dtype=torch.float64)


@every_metric
def test_equal_sounds_are_at_no_distance_and_more_noise_is_farther(metric):
    assert metric(clips(), clips()).tolist() == [0.0, 0.0, 0.0]
    noise = torch.randn(3, 4800, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    distances = torch.stack([metric(clips() + level * noise, clips()) for level in (1e-4, 1e-3, 1e-2, 1e-1)])
    assert bool((distances.diff(dim=0) > 0).all())


@every_metric
def test_a_sign_or_the_dtype_or_a_gradient_changes_little(metric):
    a, b = clips(seed=1), clips(seed=2).flip(0)
    assert torch.allclose(metric(-a, b), metric(a, b), rtol=1e-9)
    single = metric(a.float().requires_grad_(), b.float())
    assert single.dtype == torch.float64
    assert not single.requires_grad
    # What float32 rounds off the sounds, 6e-8 of them; the floor 40 dB below the sines makes it 1e-4 of a bin at most.
    assert torch.allclose(single, metric(a, b), rtol=1e-4)


@every_metric
def test_rows_are_judged_for_themselves(metric):
    a, b = clips(40, seed=1), clips(40, seed=2)
    order = torch.arange(39, -1, -1)
    assert torch.allclose(metric(a[order], b[order]), metric(a, b)[order], rtol=1e-12)


def test_levels_scale_as_they_should_and_distances_are_symmetric():
    a, b = clips(seed=1), clips(seed=2).flip(0)
    for name in ("l1", "l1_log", "envelope"):
        assert torch.allclose(METRICS[name](a, b), METRICS[name](b, a), rtol=1e-12)
    for name in ("l1", "envelope"):
        assert torch.allclose(METRICS[name](3 * a, 3 * b), 3 * METRICS[name](a, b), rtol=1e-12)
    assert torch.allclose(METRICS["relative"](3 * a, 3 * b), METRICS["relative"](a, b), rtol=1e-12)
    # All mel bands of these clips are far above the floor of 1e-5.
    assert torch.allclose(METRICS["l1_log"](3 * a, 3 * b), METRICS["l1_log"](a, b), rtol=1e-9)
    assert torch.allclose(METRICS["l1_log"](3 * a, a), torch.tensor(math.log(3.0), dtype=torch.float64), rtol=1e-12)


def test_relative_error_of_silence_is_one_and_of_twice_the_sound_too():
    truth = clips()
    for predicted in (0 * truth, 2 * truth):
        assert float(METRICS["relative"](predicted, truth).mean()) == pytest.approx(1.0, rel=1e-12)
    assert float(METRICS["relative"](1.1 * truth, truth).mean()) == pytest.approx(0.1, rel=1e-12)


def test_relative_error_is_the_ratio_of_sums_at_a_quarter_hop_by_loudness():
    a, b = clips(seed=1), clips(seed=2).flip(0)
    ratios = []
    for size in (512, 128):
        spectra = [magnitude_stft(sounds, fft_size=size, hop=size // 4) for sounds in (a, b)]
        ratios.append(float((spectra[0] - spectra[1]).abs().sum() / spectra[1].sum()))
    assert float(METRICS["relative"](a, b).mean()) == pytest.approx(sum(ratios) / 2, rel=1e-12)
    one = clips(1)
    truth = torch.cat([one, 9 * one])
    # The loud one missed altogether, the faint one right: nine tenths of all magnitudes are wrong.
    errors = relative_stft_error(torch.cat([one, 0 * one]), truth, sample_rate=RATE, fft_sizes=(256,))
    assert float(errors.mean()) == pytest.approx(0.9, rel=1e-12)
    assert errors.tolist() == pytest.approx([0.0, 1.8], rel=1e-12)
    with raises(EvaluationError, name="truth", value=0.0):
        METRICS["relative"](a, 0 * a)


def test_a_steady_sine_too_many_is_what_its_spectrum_holds():
    fft_size, amplitude = 512, 0.2
    times = torch.arange(512 * 200, dtype=torch.float64)
    sine = amplitude * torch.sin(2 * math.pi * 40 / fft_size * times)[None]
    # A Hann window spreads a sine on a bin over three: A N / 4 there and half of it on either side, so A N / 2 over 257
    # bins; 4 of the 801 frames see an end.
    l1 = float(METRICS["l1"](sine, 0 * sine))
    assert l1 == pytest.approx(amplitude * fft_size / 2 / 257, rel=0.01)
    # The envelope of a whole number of periods is its amplitude, exactly.
    assert float(METRICS["envelope"](sine, 0 * sine)) == pytest.approx(amplitude, rel=1e-9)
    assert float(METRICS["envelope"](sine, 0.25 * sine)) == pytest.approx(0.75 * amplitude, rel=1e-9)


def test_the_papers_white_noise_is_where_the_paper_has_it():
    """Noise of peak one scores L1 3.774 and ENV .305 there, and 3.789 and .308 on its other data set."""
    noise = torch.randn(20, 144_000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    noise /= noise.abs().amax(dim=1, keepdim=True)
    scores = {name: METRICS[name](noise, 0 * noise, sample_rate=48000.0) for name in ("l1", "envelope")}
    # The largest of 144,000 samples, which sets a clip's level, scatters by 5 %, the mean of 20 clips by 1.2 %.
    assert float(scores["l1"].mean()) == pytest.approx(3.774, rel=0.03)
    assert float(scores["envelope"].mean()) == pytest.approx(0.305, rel=0.03)
    # Free of level: sqrt(3 pi N / 32) / sqrt(2) of Rayleigh magnitudes and envelopes, the ends of the clip apart.
    ratio = float(scores["l1"].mean() / scores["envelope"].mean())
    assert ratio == pytest.approx(math.sqrt(3 * math.pi * 1024 / 64), rel=3e-3)
    assert ratio == pytest.approx(12.3, rel=0.01)


@pytest.mark.parametrize(
    ("sample_rate", "largest"), [(100.0, 512), (400.0, 512), (22050.0, 1024), (48000.0, 2048), (192000.0, 8192)]
)
def test_fft_sizes_go_with_the_sample_rate(sample_rate, largest):
    assert default_fft_sizes(sample_rate) == tuple(largest // part for part in (1, 2, 4, 8))


@pytest.mark.parametrize("sample_rate", [100.0, 400.0, 5512.5, 16000.0, 31000.0, 44100.0, 62000.0, 63000.0, 192000.0])
def test_the_papers_convention_holds_at_any_rate(sample_rate):
    a, b = clips(2, seed=1), clips(2, seed=2).flip(0)
    for name in ("l1", "l1_log", "envelope"):
        assert bool((METRICS[name](a, b, sample_rate=sample_rate) > 0).all())


@every_metric
def test_what_cannot_be_compared_is_refused(metric):
    good = clips()
    with raises(EvaluationError, name="predicted", value=3):
        metric(good, good[:2])
    with raises(EvaluationError, name="predicted", value=[3, 4000]):
        metric(good[:, :4000], good)
    with raises(EvaluationError, name="predicted", value=[4800]):
        metric(good[0], good[0])
    with raises(EvaluationError, name="predicted", value=[0, 4800]):
        metric(good[:0], good[:0])
    with raises(EvaluationError, name="truth", value=[3, 0]):
        metric(good, good[:, :0])
    broken = good.clone()
    broken[2, 0] = math.inf
    for given, name in (((broken, good), "predicted"), ((good, broken), "truth")):
        with raises(EvaluationError, name=name, row=2, value=math.inf):
            metric(*given)
    with raises(EvaluationError, name="predicted", row=2, value=math.inf) as caught:
        validate(broken, good, names=("a", "b", "taps/c.wav"))
    assert "taps/c.wav" in str(caught.value)


def test_resampling_keeps_a_tone_and_its_length():
    def tone(rate: float) -> torch.Tensor:
        times = torch.arange(round(0.5 * rate), dtype=torch.float64) / rate
        return (torch.sin(math.pi * times / 0.5) ** 2 * torch.sin(2 * math.pi * 1000 * times))[None]

    # 44100 / 0.9999: the rate of a capture that was played a little slower.
    for rate in (8000.0, 44100.0 / 0.9999, 48000.0, 192000.0):
        heard = resampled(tone(rate), sample_rate=rate, wanted=22050.0)
        assert abs(heard.shape[1] - 11025) <= 1
        assert torch.allclose(heard[0, :11024], tone(22050.0)[0, :11024], atol=3e-3)


def test_every_metric_of_the_corpus_says_what_it_said():
    """`corpus/make.py` makes the sounds; its `--scores` writes what metrics say, after a change that is meant."""
    cdpam = None if importlib.util.find_spec("cdpam") is None else Cdpam.load()
    expected = json.loads((CORPUS / "expected.json").read_text(encoding="utf-8"))
    assert len(expected) == len(corpus.RATES) * len(corpus.OTHERS)
    for pair, figures in expected.items():
        name, what = pair.split()
        truth = corpus.read_sound(f"{name}_true")
        predicted = truth if what == "same" else corpus.read_sound(f"{name}_{what}")
        # CDPAM takes longer than all others together: one object will do.
        heard = cdpam if name == "bowl" else None
        scores = corpus.scores_of(truth, predicted, corpus.RATES[name], heard)
        assert set(scores) == {key for key in figures if heard is not None or not key.startswith("cdpam.")}
        for key, value in scores.items():
            # Six figures are kept; CDPAM is computed in float32, whose rounding goes with the processor.
            tolerance = 1e-3 if key == "cdpam.cdpam" else 1e-4 if key == "cdpam.cdpam_scaled" else 1e-5
            assert value == pytest.approx(figures[key], rel=tolerance, abs=1e-12), (pair, key)
