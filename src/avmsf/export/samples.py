"""A grid of impacts as wav files, with a table of them and an SFZ instrument, for samplers."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int, Int64
from torch import Tensor

from avmsf._utils.text import counted, csv_text
from avmsf.capture.audio import wav_bytes
from avmsf.errors import ExportError
from avmsf.export.sampled_field import SampledField
from avmsf.export.writing import Written, write_folder
from avmsf.modal.config import PulseShape
from avmsf.modal.modes import ForcePulse

TABLE, INSTRUMENT, SOUNDS = "samples.csv", "instrument.sfz", "sounds"
COLUMNS = (
    *("file", "x", "y", "z", "nx", "ny", "nz", "force", "contact_time", "midi_note", "velocity_low", "velocity_high"),
    *("seconds", "peak_db", "contact"),
)
HIGHEST_NOTE = 127
LEVEL_DB = -1.0
"""Peak of the loudest sound, relative to full scale."""
LOWEST_NOTE = 36
"""MIDI note of the first contact: C2, where drum maps begin."""

_CONTACT = 5e-4
"""Contact time that the recorded impacts are taken to have had, s: that of a small steel tip on plastic, as
`avmsf.simulate.hammer` computes it; on steel it has a sixth of it."""


@dataclass(frozen=True)
class Layer:
    """The force at all contacts for one range of a keyboard's velocities."""

    force: float
    """Newtons where the field knows forces, else relative to an average recorded impact."""
    contact_time: float = 0.0
    """Seconds that hammer and object are in contact; 0 is the impact as recorded."""
    shape: PulseShape = "half-sine"
    """Course of the force over that time."""


def hertz_layers(forces: Sequence[float], shape: PulseShape = "half-sine") -> tuple[Layer, ...]:
    """Return layers of which the hardest is as recorded, and softer ones are longer in contact by Hertz's law.

    A round tip's contact time goes with its speed to the power -1/5 and its force with the speed to the power 6/5
    (`avmsf.simulate.hammer`), so that the time goes with the force to the power -1/6. The recorded pulse is in the
    gains already: what is added makes its width, whose squares add, as long as the softer impact's.
    """
    hardest = max(forces, default=0.0)
    ratios = [(hardest / force) ** (1 / 3) - 1.0 if force > 0 else 0.0 for force in forces]
    return tuple(Layer(force, _CONTACT * math.sqrt(each), shape) for force, each in zip(forces, ratios, strict=True))


def write_grid(
    field: SampledField,
    folder: str | Path,
    *,
    layers: Sequence[Layer] | None = None,
    seconds: float | None = None,
    range_db: float = 40.0,
    overwrite: bool = False,
) -> Written:
    """Write a float32 wav for every contact and layer, the table and the instrument.

    Contacts, of which each has a MIDI note, with `range_db` less energy than the loudest are left out. Each has one
    impact of each of the `layers`, sorted by their level, by default one of an average recorded force. Sounds last
    `seconds`, by default as long as the training sounds. All are scaled by one factor, the manifest's `scale`, so that
    the loudest peaks at `LEVEL_DB`. Raises `ExportError` for no layers, more contacts than MIDI has notes, and settings
    not positive.
    """
    layers = (Layer(field.average_force),) if layers is None else layers
    _check(field, layers, seconds, range_db)
    rate = round(field.sample_rate)
    rows, remarks = _chosen(field, range_db)
    samples = samples_in(seconds, field.sample_rate) or field.samples
    rendered = []
    for layer in layers:
        pulse = ForcePulse(layer.contact_time, layer.shape)
        rendered.append((layer, field.render(rows, force=layer.force, samples=samples, pulse=pulse)))
    # From soft to loud; equally loud ones stay in order.
    rendered.sort(key=lambda each: float(each[1].double().square().sum()))
    ordered = [layer for layer, _ in rendered]
    peak = max(float(sounds.abs().max()) for _, sounds in rendered)
    scale = 10 ** (LEVEL_DB / 20) / peak if peak > 0 else 1.0
    # From 1 on: a note of velocity 0 is the end of one. No range is empty, as there are no more layers than velocities.
    edges = np.linspace(1, HIGHEST_NOTE + 1, len(ordered) + 1).round().astype(int)
    amplitudes = np.stack([sounds.double().square().mean(1).sqrt().numpy() for _, sounds in rendered])
    files, records = dict[str, bytes](), list[tuple[object, ...]]()
    groups = {(low, high - 1): [f"<group> lovel={low} hivel={high - 1}"] for low, high in pairwise(edges.tolist())}
    for place, row in enumerate(rows.tolist()):
        note, curves = LOWEST_NOTE + place, _curves(amplitudes[:, place], edges)
        where = [f"{value:.9g}" for value in (*field.points[row].tolist(), *field.normals[row].tolist())]
        for number, ((layer, sounds), velocities, curve) in enumerate(zip(rendered, groups, curves, strict=True), 1):
            sound = scale * sounds[place]
            loudest = float(sound.abs().max())
            name = f"{SOUNDS}/{place + 1:03d}-{number}.wav"
            files[name] = wav_bytes(sound.numpy(), rate, file=Path(name))
            level = f"{20 * math.log10(loudest):.2f}" if loudest > 0 else "-inf"
            how = (f"{layer.force:g}", f"{layer.contact_time:g}", note, *velocities)
            records.append((name, *where, *how, f"{samples / rate:.6g}", level, row))
            groups[velocities].append(f"<region> sample={name} key={note} {curve}")
    files[TABLE] = csv_text([COLUMNS, *records]).encode()
    head = [f"// {field.name or 'object'}, as exported by avmsf", "<global> loop_mode=one_shot amp_veltrack=100"]
    files[INSTRUMENT] = "\n".join([*head, *chain.from_iterable(groups.values()), ""]).encode()
    manifest = {"name": field.name, "sampleRate": rate, "scale": scale, "perNewton": field.per_newton}
    manifest["pulses"] = [layer.shape for layer in ordered]
    remarks.append(f"all sounds are scaled by {scale:.4g}, so that the loudest reaches {LEVEL_DB:g} dB")
    remarks += _on_background(field, rendered[-1][1])
    if ordered != list(layers):
        named = ", ".join(f"{layer.force:g} ({layer.contact_time:g} s)" for layer in ordered)
        remarks.append(f"layers are sorted from soft to loud: force (contact time) {named}")
    return Written(write_folder(Path(folder), files, manifest, overwrite=overwrite), tuple(remarks))


def samples_in(seconds: float | None, sample_rate: float) -> int | None:
    """Return how many samples, 1 or more, last so long; None for None, and for what no sound lasts."""
    return max(1, round(seconds * sample_rate)) if seconds is not None and 0 < seconds < math.inf else None


def _on_background(field: SampledField, sounds: Float32[Tensor, "rows samples"]) -> list[str]:
    """Return a remark where the background makes up most of the loudest layer's energy."""
    noise = field.average_force * field.noise[: sounds.shape[1]].double()
    background = len(sounds) * float(noise.square().sum())
    if field.background_force is None or float(sounds.double().square().sum()) >= 2 * background:
        return []
    known = f"an average recorded impact has {field.average_force:.3g}"
    return [f"the recordings' background is louder than all layers: {known}; or leave the noise out"]


def _check(field: SampledField, layers: Sequence[Layer], seconds: float | None, range_db: float) -> None:
    most, contacts, rate = HIGHEST_NOTE + 1 - LOWEST_NOTE, len(field), field.sample_rate
    checks = [
        ("contacts", contacts, 1 <= contacts <= most, f"1 to {most}, a MIDI note each from {LOWEST_NOTE}"),
        ("layers", len(layers), 1 <= len(layers) <= HIGHEST_NOTE, f"1 to {HIGHEST_NOTE} forces"),
        *(("force", each.force, 0 < each.force < math.inf, "a number above 0") for each in layers),
        *(("contact_time", each.contact_time, 0 <= each.contact_time < 1, "0 to 1 s") for each in layers),
        ("seconds", seconds, seconds is None or 0 < seconds < math.inf, "more than 0"),
        ("range_db", range_db, range_db >= 0, "0 dB or above"),
        ("sample_rate", rate, rate >= 1 and rate == round(rate), "whole hertz for wav files"),
    ]
    for name, value, valid, wanted in checks:
        if not valid:
            raise ExportError.expected(wanted, value, name=name)


def _chosen(field: SampledField, range_db: float) -> tuple[Int64[Tensor, " chosen"], list[str]]:
    """Return the rows of the points that are audible, and a note on those left out."""
    energy_db = 10 * field.energy.clamp_min(1e-300).log10()
    audible = energy_db >= energy_db.max() - range_db
    left = f"{counted(int((~audible).sum()), 'contact')} left out, {range_db:g} dB or more below the loudest"
    return torch.nonzero(audible).flatten(), [] if audible.all() else [left]


def _curves(amplitude: Float64[np.ndarray, " layers"], edges: Int[np.ndarray, " edges"]) -> list[str]:
    """Return the velocity curves of one contact's layers, whose root mean square amplitudes are given.

    Each layer's hardest velocity plays its sound as it is. From there down to the hardest velocity of the layer below,
    the level falls evenly in decibels to that layer's; the lowest layer falls with the velocity's square, as SFZ
    players do. A layer that is louder than the next one is lowered to it, so that the level never falls as the
    velocity rises.
    """
    tops = np.minimum.accumulate(np.maximum(amplitude, np.finfo(float).tiny)[::-1])[::-1]
    curves = []
    for number, top in enumerate(tops):
        velocity = np.arange(edges[number], edges[number + 1])
        if number == 0:
            level = top * (velocity / velocity[-1]) ** 2
        else:
            part = (velocity - edges[number] + 1) / len(velocity)
            level = tops[number - 1] ** (1 - part) * top**part
        gains = level / max(amplitude[number], np.finfo(float).tiny)
        curves.append(" ".join(f"amp_velcurve_{each}={gain:.6g}" for each, gain in zip(velocity, gains, strict=True)))
    return curves
