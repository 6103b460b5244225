"""Make the corpus of small sounds, and with `--scores` what every metric says of them.

The sounds are made, none is recorded: true ones and others to compare with them, a quarter of a second of 16-bit FLAC
each. `expected.json` is what the metrics said when they were last looked at; a change of it is a change of a metric.
"""

import json
import math
import sys
from pathlib import Path

import numpy as np
import soundfile
import torch

from avmsf._utils.files import write_whole
from avmsf.evaluation.cdpam import Cdpam
from avmsf.evaluation.registry import METRICS, resolve

FOLDER = Path(__file__).parent
RATES = {"bell": 44100, "wood": 16000, "bowl": 48000}
SECONDS = 0.25
OTHERS = ("same", "fainter", "later", "noisy", "detuned", "silence", "noise")
"""What is compared with each true sound."""


def make_sounds(name: str) -> dict[str, np.ndarray]:
    """Return a struck object's sound as `true`, and sounds that differ from it in one thing each."""
    rate, seed = RATES[name], list(RATES).index(name)
    generator = np.random.default_rng(seed)
    times = np.arange(round(SECONDS * rate)) / rate
    lowest, spread, damping = {"bell": (700.0, 1.9, 5.0), "wood": (350.0, 1.6, 60.0), "bowl": (1300.0, 1.5, 12.0)}[name]
    frequency = lowest * spread ** np.arange(5) * (1 + 0.02 * generator.standard_normal(5))
    frequency = frequency[frequency < 0.45 * rate]
    gains = generator.uniform(0.3, 1.0, len(frequency)) * np.array([1, -1, 1, 1, -1])[: len(frequency)]
    hiss = generator.standard_normal((3, len(times)))

    def strike(pitch: float) -> np.ndarray:
        decay = np.exp(-np.outer(damping * (1 + frequency / 4000), times))
        return gains @ (decay * np.sin(2 * math.pi * pitch * np.outer(frequency, times)))

    loudness = 0.6 / np.abs(strike(1.0)).max()
    true = loudness * strike(1.0) + 2e-4 * hiss[0]
    delay = round(0.005 * rate)
    return {
        "true": true,
        "same": true,
        "fainter": 0.5 * true,
        "later": np.concatenate([np.zeros(delay), true[:-delay]]),
        "noisy": true + 0.01 * hiss[1],
        "detuned": loudness * strike(1.02) + 2e-4 * hiss[0],
        "silence": 0 * true,
        "noise": 0.2 * hiss[2],
    }


def read_sound(name: str) -> torch.Tensor:
    """Return one sound of the corpus as one row."""
    return torch.from_numpy(soundfile.read(FOLDER / f"{name}.flac", dtype="float64")[0])[None]


def scores_of(truth: torch.Tensor, predicted: torch.Tensor, rate: int, cdpam: Cdpam | None) -> dict[str, float]:
    """Return every metric, by the convention's and the metric's name; CDPAM in both scalings where it is given."""
    functions = {name: resolve(entry.function) for name, entry in METRICS.items() if entry.function is not None}
    figures = {
        name if name == "relative_stft" else f"paper.{name}": function(predicted, truth, sample_rate=float(rate))
        for name, function in functions.items()
    }
    for key, scaling in {} if cdpam is None else {"cdpam": "benchmark", "cdpam_scaled": "authors"}.items():
        figures[f"cdpam.{key}"] = cdpam.distance(predicted, truth, sample_rate=float(rate), scaling=scaling)
    return {key: float(values) for key, values in figures.items()}


def main() -> None:
    for name, rate in RATES.items():
        for what, sound in make_sounds(name).items():
            if what != "same":
                samples = np.clip(np.round(sound * 32768), -32768, 32767).astype(np.int16)
                soundfile.write(FOLDER / f"{name}_{what}.flac", samples, rate, subtype="PCM_16")
    if "--scores" not in sys.argv[1:]:
        return
    cdpam = Cdpam.load()
    expected = {}
    for name, rate in RATES.items():
        truth = read_sound(f"{name}_true")
        for what in OTHERS:
            predicted = truth if what == "same" else read_sound(f"{name}_{what}")
            figures = scores_of(truth, predicted, rate, cdpam)
            expected[f"{name} {what}"] = {key: float(f"{value:.6g}") for key, value in figures.items()}
    text = json.dumps(expected, indent=1) + "\n"
    write_whole(FOLDER / "expected.json", text)


if __name__ == "__main__":
    main()
