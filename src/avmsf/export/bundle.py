"""A field as the page reads it: `manifest.json`, tensors in `field.bin`, the object, its surface, measured impacts.

The manifest has the offset of each tensor in `field.bin`, little endian and row-major: points, normals, frequency,
damping, sine, noise, and cosine unless it is all zero. Dampings and frequencies are float64, because a float32
frequency has a large phase error after a second; amplitudes are float32. Recorded impacts are float32 wav files in the
field's unit.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from avmsf.capture.audio import wav_bytes
from avmsf.capture.impacts import Impacts
from avmsf.errors import ExportError
from avmsf.export.geometry import ObjectKind, read_object
from avmsf.export.sampled_field import SampledField
from avmsf.export.writing import no_modes, pack
from avmsf.mesh.surface import Surface

FORMAT = 1
"""Version of this format, increased by every change that older pages cannot read."""
SURFACE = "surface.glb"
"""Name of the surface's file."""
_OBJECTS: dict[ObjectKind, str | None] = {"mesh": "object.glb", "gaussians": "object.ply", "points": None}
"""Name of the object's file."""


@dataclass(frozen=True, eq=False)
class Bundle:
    """A page's data, in memory."""

    manifest: Mapping[str, Any]
    files: Mapping[str, bytes]
    """Contents by relative path, without the manifest."""
    remarks: tuple[str, ...] = ()
    """Notes on what the page leaves out."""


def make_bundle(
    field: SampledField,
    *,
    object: Path | Surface | None = None,
    meters: float = 1.0,
    surface: Path | Surface | None = None,
    strikes: Impacts | None = None,
    mute: bool = False,
) -> Bundle:
    """Return a field's bundle, with options as `write_webpage`.

    A field without modes is allowed if `mute`, for an object that is not recorded yet. Raises `ExportError`.
    """
    if len(field.frequency) == 0 and not mute:
        raise no_modes()
    kind, shown, notes = read_object(object, field.points, meters=meters)
    other, triangles, further_notes = read_object(surface, field.points)
    content, places = pack(_tensors(field))
    files, name = {"field.bin": content}, _OBJECTS[kind]
    if name is not None:
        files[name] = shown
    if other == "mesh":
        files[SURFACE] = triangles
    records, sounds = _strikes(strikes, field)
    manifest = {
        "format": FORMAT,
        "package": version("avmsf"),
        "name": field.name,
        "sampleRate": field.sample_rate,
        "samples": field.samples,
        "perNewton": field.per_newton,
        "backgroundForce": field.background_force,
        "modes": len(field.frequency),
        "supporting": list(field.supporting),
        "points": len(field),
        "damping": "shared" if field.shared_damping else "perContact",
        "tensors": {name: {"file": "field.bin", **place} for name, place in places.items()},
        "object": {"kind": kind, "file": name},
        "strikes": records,
        "live": None,
        "surface": {"kind": "mesh", "file": SURFACE} if SURFACE in files else None,
    }
    return Bundle(manifest, {**files, **sounds}, notes + further_notes)


def _tensors(field: SampledField) -> dict[str, Shaped[np.ndarray, "..."]]:
    # JavaScript needs offsets that are multiples of the item size: float64 comes first.
    named: dict[str, Shaped[np.ndarray, ...]] = {
        "frequency": field.frequency.numpy(),
        "damping": field.damping.numpy(),
        "points": field.points.float().numpy(),
        "normals": field.normals.numpy(),
        "sine": field.gains.real.numpy(),
        "noise": field.noise.numpy(),
    }
    return {**named, "cosine": field.gains.imag.numpy()} if field.has_phases else named


def _strikes(strikes: Impacts | None, field: SampledField) -> tuple[list[dict[str, Any]], dict[str, bytes]]:
    if strikes is None:
        return [], {}
    if not isinstance(strikes, Impacts):
        raise ExportError.expected(
            "Impacts, such as avmsf.read(folder).impacts", type(strikes).__name__, name="strikes"
        )
    if strikes.sample_rate != field.sample_rate:
        wanted, advice = f"the field's {field.sample_rate:g} Hz", "name the capture that the field was fitted to"
        raise ExportError.expected(wanted, strikes.sample_rate, name="strikes", advice=advice)
    paths = [f"strikes/{row + 1:03d}.wav" for row in range(len(strikes.names))]
    directions = [None] * len(paths) if strikes.directions is None else strikes.directions.tolist()
    values = zip(strikes.names, strikes.contacts.tolist(), directions, paths, strict=True)
    records = [dict(zip(("name", "contact", "direction", "sound"), each, strict=True)) for each in values]
    rate = round(field.sample_rate)
    return records, {path: wav_bytes(sound.numpy(), rate) for path, sound in zip(paths, strikes.sounds, strict=True)}
