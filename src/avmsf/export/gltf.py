"""A field as a `.glb` that any viewer shows, with its modes in the draft extension `KHR_audio_rigid_bodies`.

In the draft (as of 2026, not ratified) the sound of an impulse j at a point is the sum over modes of 2 pi f (shape . j)
exp(-d t) sin(2 pi f t). Here an impulse of 1 N s perpendicular to the surface is an impact of force 1, so a shape is
minus the normal times the gain over 2 pi f. The draft leaves the absolute level to the player. It has only sines, one
damping for each mode, and no noise; phases, dampings at each contact and the noise are in `extras`.
"""

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from avmsf.export.formats import GLTF_SUFFIXES, Axis
from avmsf.export.geometry import DisplayGeometry
from avmsf.export.one_phase import approximation_error, importance, shared_dampings, signed_amplitudes
from avmsf.export.sampled_field import SampledField
from avmsf.export.writing import Written, check_suffix, generator, no_modes, write_file

EXTENSION = "KHR_audio_rigid_bodies"
_FLOAT, _UNSIGNED = 5126, 5125
_POINTS, _TRIANGLES = 0, 4
_VERTICES, _INDICES = 34962, 34963
_GRAY = 0.7
_TURNS: dict[Axis, tuple[float, float, float, float]] = {
    "x": (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)),
    "y": (0.0, 0.0, 0.0, 1.0),
    "z": (-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)),
}
"""Quaternions (x, y, z, w) that rotate each axis to +y, which is up in glTF."""


def write_gltf(
    sampled: SampledField,
    path: str | Path,
    *,
    geometry: DisplayGeometry | None = None,
    up: Axis = "z",
    overwrite: bool = False,
) -> Written:
    """Write the object, or its points, and one modal model, with the modes sorted by energy.

    All coordinates are in the object's frame; the node rotates its axis `up` to glTF's +y. Raises
    `ExportError` for a name that does not end in .glb, and a field without modes.
    """
    path = Path(path)
    check_suffix(path, GLTF_SUFFIXES)
    if not len(sampled.frequency):
        raise no_modes(path)
    damping = shared_dampings(sampled)
    order = importance(sampled, damping)
    gains = signed_amplitudes(sampled)
    document, arrays = _document(sampled, geometry or DisplayGeometry.of_points(sampled), up, order, gains, damping)
    sizes = write_file(path, _glb(document, arrays), overwrite=overwrite)
    return Written(sizes, _remarks(sampled), *approximation_error(sampled, sine=gains, damping=damping))


@dataclass
class _Buffer:
    """The binary chunk, with its buffer views and accessors."""

    content: bytes = b""
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)

    def add(self, values: Shaped[np.ndarray, "..."], *, bounds: bool = False, target: int | None = None) -> int:
        """Append an array as float32 or uint32 and return its accessor; arrays with two axes are of type VEC3."""
        whole = values.dtype.kind in "iu"
        packed = np.ascontiguousarray(values, dtype="<u4" if whole else "<f4")
        view = {"buffer": 0, "byteOffset": len(self.content), "byteLength": packed.nbytes}
        self.views.append(view if target is None else view | {"target": target})
        self.content += packed.tobytes()
        record: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": _UNSIGNED if whole else _FLOAT,
            "count": len(packed),
            "type": "VEC3" if packed.ndim == 2 else "SCALAR",
        }
        if bounds:
            record |= {"min": packed.min(0).tolist(), "max": packed.max(0).tolist()}
        self.accessors.append(record)
        return len(self.accessors) - 1


def _document(
    sampled: SampledField,
    geometry: DisplayGeometry,
    up: Axis,
    order: Int[Tensor, " modes"],
    gains: Float[Tensor, "points modes"],
    damping: Float[Tensor, " modes"],
) -> tuple[dict[str, Any], bytes]:
    buffer = _Buffer()
    frequency = sampled.frequency[order]
    shapes = -sampled.normals.double()[None] * (gains.double()[:, order] / (2 * math.pi * frequency)).T[:, :, None]
    model = {
        "name": sampled.name or "object",
        "frequencies": buffer.add(frequency.numpy()),
        "decayRates": buffer.add(damping[order].numpy()),
        "positions": buffer.add(sampled.points.numpy(), bounds=True),
        "shapes": buffer.add(shapes.reshape(-1, 3).numpy()),
        "extras": _extras(sampled, order, buffer),
    }
    primitive: dict[str, Any] = {
        "attributes": {
            "POSITION": buffer.add(geometry.vertices.numpy(), bounds=True, target=_VERTICES),
            "NORMAL": buffer.add(torch.nn.functional.normalize(geometry.normals, dim=1).numpy(), target=_VERTICES),
        },
        "mode": _TRIANGLES if len(geometry.faces) else _POINTS,
        "material": 0,
    }
    if geometry.colors is not None:
        primitive["attributes"]["COLOR_0"] = buffer.add(_linear(geometry.colors).numpy(), target=_VERTICES)
    if len(geometry.faces):
        primitive["indices"] = buffer.add(geometry.faces.reshape(-1).numpy(), target=_INDICES)
    shade = 1.0 if geometry.colors is not None else float(_linear(torch.tensor(_GRAY)))
    surface = {"baseColorFactor": [shade] * 3 + [1.0], "metallicFactor": 0.0, "roughnessFactor": 0.6}
    sounds = {"modalModel": 0}
    document = {
        "asset": {"version": "2.0", "generator": generator()},
        "extensionsUsed": [EXTENSION],
        "extensions": {EXTENSION: {"modalModels": [model]}},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": model["name"], "mesh": 0, "rotation": list(_TURNS[up]), "extensions": {EXTENSION: sounds}}],
        "meshes": [{"name": model["name"], "primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": surface, "doubleSided": True}],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.content)}],
    }
    return document, buffer.content


def _extras(sampled: SampledField, order: Int[Tensor, " modes"], buffer: _Buffer) -> dict[str, Any]:
    """Return what the draft cannot represent; arrays as accessors, mode-major like the shapes."""
    extras: dict[str, Any] = {
        "generator": generator(),
        "sampleRate": sampled.sample_rate,
        "samples": sampled.samples,
        "perNewton": sampled.per_newton,
        "impulse": "1 N s against the normal is an impact of force 1",
    }
    if sampled.cosine.any():
        extras["sine"] = buffer.add(sampled.sine[:, order].T.reshape(-1).numpy())
        extras["cosine"] = buffer.add(sampled.cosine[:, order].T.reshape(-1).numpy())
    if not sampled.shared_damping:
        extras["decayRates"] = buffer.add(sampled.damping[:, order].T.reshape(-1).numpy())
    if sampled.noise.any():
        extras["noise"] = buffer.add(sampled.noise.numpy())
    return {"avmsf": extras}


def _glb(document: Mapping[str, Any], content: bytes) -> bytes:
    """Return the container: a header and two chunks, padded to multiples of four bytes."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    content += b"\0" * (-len(content) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(content), b"BIN\0") + content
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _remarks(sampled: SampledField) -> tuple[str, ...]:
    remarks = ["the draft leaves the absolute level to the player: an impulse of 1 N s is an impact of force 1 here"]
    if sampled.cosine.any():
        remarks.append("every mode starts as a sine, with the field's level; phases are in extras")
    if not sampled.shared_damping:
        remarks.append("each mode has one damping, its mean by energy; those of each point are in extras")
    if sampled.noise.any():
        remarks.append("the residual noise is in extras only")
    return tuple(remarks)


def _linear(colors: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Return linear colors, as vertex colors are in glTF, of sRGB colors (IEC 61966-2-1)."""
    return torch.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
