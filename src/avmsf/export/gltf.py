"""A field as a `.glb` that any viewer shows, with its modes in the draft extension `KHR_audio_rigid_bodies`.

In the draft (as of 2026, not ratified) the sound of an impulse j at a point is the sum over modes of 2 pi f (shape . j)
exp(-d t) sin(2 pi f t). Here an impulse of 1 N s perpendicular to the surface is an impact of force 1, so a shape is
minus the normal times the gain over 2 pi f. The draft leaves the absolute level to the player. It has only sines, one
damping for each mode, and no noise: phases, differences of dampings between contacts and the noise are left out.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.export.geometry import read_vertices
from avmsf.export.sampled_field import SampledField, approximation_error, shared_dampings, signed_amplitudes
from avmsf.export.writing import FORMATS, Axis, Written, check_suffix, generator, pack, write_files
from avmsf.mesh.io import glb_bytes
from avmsf.mesh.surface import Surface

EXTENSION = "KHR_audio_rigid_bodies"
_FLOAT, _UNSIGNED = 5126, 5125
_POINTS, _TRIANGLES = 0, 4
_TARGETS = {**dict.fromkeys(("POSITION", "NORMAL", "COLOR_0"), 34962), "indices": 34963}
"""What a buffer view is bound to: vertices, or the indices of triangles."""
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
    object: Path | Surface | None = None,
    meters: float = 1.0,
    up: Axis = "z",
    overwrite: bool = False,
) -> Written:
    """Write an object, or the field's points, and one modal model, with the modes sorted by energy.

    `object` is a mesh with coordinates in units of `meters`, or Gaussians, of which the file has the centers and a copy
    beside it the rest. All coordinates are in the object's frame; the node rotates its axis `up` to glTF's +y. Raises
    `ExportError` for a name that does not end in .glb, and as `read_vertices`.
    """
    path = Path(path)
    check_suffix(path, FORMATS["gltf"].suffixes)
    damping, gains = shared_dampings(sampled), signed_amplitudes(sampled)
    vertices, gaussians = read_vertices(object, sampled, meters=meters)
    contents = {path: glb_bytes(*_document(sampled, vertices, up, gains, damping))}
    if gaussians is not None:
        contents[path.with_suffix(".gaussians.ply")] = gaussians.read_bytes()
    sizes = write_files(contents, overwrite=overwrite)
    error = approximation_error(sampled, torch.complex(gains, torch.zeros_like(gains)), damping)
    return Written(sizes, _remarks(sampled), *error)


def _document(
    sampled: SampledField,
    vertices: dict[str, Tensor],
    up: Axis,
    gains: Float[Tensor, "points modes"],
    damping: Float[Tensor, " modes"],
) -> tuple[dict[str, Any], bytes]:
    """Return the JSON and the binary chunk, whose arrays are in the order of the accessors' numbers."""
    order = torch.argsort(sampled.power.sum(0) / damping, descending=True, stable=True)
    frequency = sampled.frequency[order]
    shapes = -sampled.normals.double()[None] * (gains.double()[:, order] / (2 * math.pi * frequency)).T[:, :, None]
    modal = {"frequencies": frequency, "decayRates": damping[order], "positions": sampled.points}
    modal["shapes"] = shapes.reshape(-1, 3)
    drawn = vertices | {"NORMAL": torch.nn.functional.normalize(vertices["NORMAL"], dim=1)}
    if "COLOR_0" in drawn:
        drawn["COLOR_0"] = _linear(drawn["COLOR_0"])
    views, accessors, content = _packed(modal | drawn)
    number = {name: row for row, name in enumerate(modal | drawn)}
    facts = {"perNewton": sampled.per_newton, "impulse": "1 N s against the normal is an impact of force 1"}
    model: dict[str, Any] = {"name": sampled.name or "object", **{name: number[name] for name in modal}}
    model["extras"] = {"avmsf": facts}
    indices = {name: number[name] for name in drawn if name == "indices"}
    attributes = {name: number[name] for name in drawn if name != "indices"}
    primitive = {"attributes": attributes, "mode": _TRIANGLES if indices else _POINTS, "material": 0, **indices}
    # An object without colors is gray.
    shade = 1.0 if "COLOR_0" in drawn else float(_linear(torch.tensor(0.7)))
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
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(content)}],
    }
    return document, content


def _packed(named: Mapping[str, Tensor]) -> tuple[list[dict[str, Any]], list[dict[str, Any]], bytes]:
    """Return the buffer views, the accessors and the content of arrays, which become float32 or uint32."""
    arrays = {name: array.numpy() for name, array in named.items()}
    arrays = {name: array.astype("<u4" if array.dtype.kind in "iu" else "<f4") for name, array in arrays.items()}
    content, places = pack(arrays)
    views, accessors = [], []
    for row, (name, array) in enumerate(arrays.items()):
        view = {"buffer": 0, "byteOffset": places[name]["offset"], "byteLength": array.nbytes}
        views.append(view | ({"target": _TARGETS[name]} if name in _TARGETS else {}))
        record: dict[str, Any] = {
            "bufferView": row,
            "componentType": _UNSIGNED if array.dtype.kind == "u" else _FLOAT,
            "count": len(array),
            "type": "VEC3" if array.ndim == 2 else "SCALAR",
        }
        if name in ("positions", "POSITION"):
            record |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        accessors.append(record)
    return views, accessors, content


def _remarks(sampled: SampledField) -> tuple[str, ...]:
    remarks = ["the draft leaves the absolute level to the player: an impulse of 1 N s is an impact of force 1 here"]
    if sampled.has_phases:
        remarks.append("every mode starts as a sine, with the field's level")
    if not sampled.shared_damping:
        remarks.append("each mode has one damping, its mean by energy")
    if sampled.noise.any():
        remarks.append("the residual noise is left out")
    return tuple(remarks)


def _linear(colors: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Return linear colors, as vertex colors are in glTF, of sRGB colors (IEC 61966-2-1)."""
    return torch.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
