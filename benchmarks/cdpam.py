"""CDPAM: how long a clip takes, beside the authors' layers as torch runs them, and how right both are."""

import math
import os
import time
from statistics import median

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.evaluation.cdpam import SAMPLE_RATE, Cdpam, Scaling
from avmsf.evaluation.cdpam_network import CdpamNetwork
from avmsf.evaluation.cdpam_weights import LAYERS, CdpamWeights, find_weights, read_weights
from avmsf.evaluation.convolution import Workspace
from benchmarks.report import Options, Report, Table, log


def measure_cdpam(options: Options) -> Report:
    """Return the time of a 3 s clip and the error of distances of half a second."""
    seconds, repeats, short = (0.3, 2, 0.1) if options.quick_look else (3.0, 5, 0.5)
    weights = read_weights(find_weights())
    begun = time.perf_counter()
    network = CdpamNetwork.of(weights)
    arranged = time.perf_counter() - begun
    clip = strikes(round(seconds * SAMPLE_RATE), count=1)[0].float()
    workspace = Workspace()
    times: list[tuple[float, float, float]] = []
    # The first turn fills the workspace and the response to silence; it is not counted.
    for repeat in range(repeats + 1):
        begun, busy = time.perf_counter(), time.process_time()
        with torch.inference_mode():
            network.features(clip, workspace)
        own, used = time.perf_counter() - begun, time.process_time() - busy
        begun = time.perf_counter()
        plain_means(weights, clip[None])
        times.append((own, used, time.perf_counter() - begun))
        log(f"cdpam {repeat} of {repeats}: {own:.2f} s, as layers {times[-1][2]:.2f} s")
    own, used, plain = (median(column) for column in zip(*times[1:], strict=True))
    errors = distance_errors(weights, network, strikes(round(short * SAMPLE_RATE), count=4))
    figures = {
        "cdpam.seconds": own,
        "cdpam.processor_seconds": used,
        "cdpam.speedup": plain / own,
        "cdpam.layers_seconds": plain,
        "cdpam.arranging_seconds": arranged,
    }
    figures |= {f"cdpam.{name}": error for name, error in errors.items()}
    conventions = (
        f"cdpam: seconds to embed a clip of {seconds:g} s at {SAMPLE_RATE:g} Hz, median of {repeats}, {os.cpu_count()} "
        f"processors and {torch.get_num_threads()} threads; processor_seconds: the same summed over threads. "
        "layers_seconds: the sixteen layers as torch's convolutions, batch normalizations and rectifiers, in turn with "
        "ours. arranging_seconds: once a process.",
        f"errors: largest relative error of distances between four clips of {short:g} s, from the same layers in "
        "float64; benchmark and authors are the two scalings, layers_ those of the layers in float32.",
    )
    return Report(conventions, (Table("cdpam", ("figure", "value"), list(figures.items())),), figures)


def strikes(samples: int, *, count: int) -> Float64[Tensor, "contacts samples"]:
    """Return blows on an object of twenty modes, which excite each by another amount; their peaks are .5."""
    generator = torch.Generator().manual_seed(0)
    times = torch.arange(samples, dtype=torch.float64) / SAMPLE_RATE
    frequency = 300.0 * torch.arange(1, 21, dtype=torch.float64) ** 1.1
    atoms = torch.exp(-torch.outer(8 + frequency / 300, times)) * torch.sin(2 * math.pi * torch.outer(frequency, times))
    sounds = torch.randn(count, 20, generator=generator, dtype=torch.float64) @ atoms
    return 0.5 * sounds / sounds.abs().amax(dim=1, keepdim=True)


@torch.inference_mode()
def plain_means(weights: CdpamWeights, sounds: Float[Tensor, "contacts samples"]) -> Float[Tensor, "contacts dim"]:
    """Return the encoder's means over time as the authors compute them: every layer, every sample, one by one."""
    signal = sounds[:, None]
    for layer in range(LAYERS):
        kernel, bias, mean, variance, scale, shift = (
            weights.tensors[f"base_encoder.{name}"].to(sounds.dtype)
            for name in (
                f"encoder.{layer}.weight",
                f"encoder.{layer}.bias",
                f"ebatch.{layer}.running_mean",
                f"ebatch.{layer}.running_var",
                f"ebatch.{layer}.weight",
                f"ebatch.{layer}.bias",
            )
        )
        signal = torch.nn.functional.conv1d(signal, kernel, bias, padding=7)
        signal = torch.nn.functional.batch_norm(signal, mean, variance, scale, shift)
        signal = torch.nn.functional.leaky_relu(signal, 0.1)
        if layer % 4 == 3:
            signal = signal[:, :, ::2]
    return signal.mean(dim=2)


def distance_errors(
    weights: CdpamWeights, network: CdpamNetwork, sounds: Float64[Tensor, "contacts samples"]
) -> dict[str, float]:
    """Return the largest relative errors of distances, of ours and of the layers in float32."""
    cdpam = Cdpam(network, weights.digest)
    errors = {}
    scalings: tuple[tuple[Scaling, Tensor], ...] = (("benchmark", sounds), ("authors", torch.round(32768 * sounds)))
    for scaling, heard in scalings:
        true, rounded = (
            torch.stack([network.head(mean.double()[:512]) for mean in plain_means(weights, heard.to(dtype))])
            for dtype in (torch.float64, torch.float32)
        )
        own = cdpam.embed(sounds, sample_rate=SAMPLE_RATE, scaling=scaling)
        expected = torch.pdist(true, p=1)
        errors[f"{scaling}_error"] = float((torch.pdist(own, p=1) / expected - 1).abs().max())
        errors[f"layers_{scaling}_error"] = float((torch.pdist(rounded, p=1) / expected - 1).abs().max())
    return errors
