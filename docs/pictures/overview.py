"""Draw overview.png: `avmsf demo demo`, then `python docs/pictures/overview.py demo`.

The demo's field is fitted to 12 of its 16 recordings; two of the others are shown. The object at the left is cut from
studio/modes.png, which studio.py draws.
"""

import sys
from pathlib import Path

import matplotlib.image
import torch
from matplotlib.figure import Figure

import avmsf
from avmsf.evaluation.simple_methods import MeanWaveform
from avmsf.modal.spectra import magnitude_stft
from avmsf.plotting.style import SEQUENTIAL, styled

HERE = Path(__file__).parent
HELD_OUT = (0, 1)
"""Rows of the recordings that are shown in those that the field is not fitted to."""
FFT_SIZE, HOP, SECONDS, MAX_HZ, RANGE_DB = 1024, 128, 0.35, 12_000, 70


@styled
def main() -> None:
    """Read the demo's field and capture, draw, write the picture."""
    demo = Path(sys.argv[1])
    field, impacts = avmsf.load(demo / "mug.safetensors"), avmsf.read(demo / "capture").impacts
    fitted = [name in field.origin.trained_on for name in impacts.names]
    train = impacts.take([row for row in range(len(impacts)) if fitted[row]])
    test = impacts.take([row for row in range(len(impacts)) if not fitted[row]]).take(list(HELD_OUT))
    columns = {
        "recorded, held out": test.sounds,
        "avmsf": field.render(test.contacts, directions=test.directions),
        "mean of 3 nearest recordings": MeanWaveform(train).render(test.contacts),
    }
    figure = Figure(figsize=(12.8, 4.4), layout="constrained", dpi=100)
    left, right = figure.subfigures(1, 2, width_ratios=(0.36, 0.64))
    axes = left.subplots()
    axes.imshow(matplotlib.image.imread(HERE / "studio/modes.png")[290:735, 150:640])
    axes.set_title("gain of one mode;\nblue dots: recorded contacts")
    axes.axis("off")
    grid = right.subplots(len(HELD_OUT), len(columns), sharex=True, sharey=True)
    for column, (name, sounds) in enumerate(columns.items()):
        spectra = magnitude_stft(sounds, fft_size=FFT_SIZE, hop=HOP)
        for row, reference in enumerate(magnitude_stft(test.sounds, fft_size=FFT_SIZE, hop=HOP).amax((1, 2))):
            level = 20 * torch.log10((spectra[row] / reference).clamp_min(1e-10))
            axes = grid[row, column]
            extent = (0.0, level.shape[1] * HOP / field.sample_rate, 0.0, field.sample_rate / 2000)
            image = axes.imshow(
                level.numpy(), origin="lower", aspect="auto", extent=extent, cmap=SEQUENTIAL, vmin=-RANGE_DB, vmax=0.0
            )
            axes.set_xlim(0.0, SECONDS)
            axes.set_ylim(0.0, MAX_HZ / 1000)
        grid[0, column].set_title(name)
        grid[-1, column].set_xlabel("time (s)")
    for row in range(len(HELD_OUT)):
        grid[row, 0].set_ylabel(f"contact {'AB'[row]}\nfrequency (kHz)")
    right.colorbar(image, ax=grid, label="level (dB)", shrink=0.8)
    figure.savefig(HERE / "overview.png")


main()
