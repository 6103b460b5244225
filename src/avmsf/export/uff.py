"""A field in the universal file format, which modal-analysis programs read: nodes, mode shapes, response functions.

Data set 2411 holds the points, 55 how a force excites each mode, 58 the frequency response functions of some of the
points. Numbers of data set 55 have six digits, as the format sets them; those of 58 are in double precision.
"""

import contextlib
import io
import math
import re
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from avmsf.errors import ExportError, from_extra
from avmsf.export.sampled_field import SampledField, shared_dampings
from avmsf.export.writing import FORMATS, Written, check_suffix, generator, write_files

_TIME = re.compile(rb"^\d\d-\w{3}-\d\d \d\d:\d\d:\d\d *$", re.MULTILINE)


def write_universal(field: SampledField, path: str | Path, *, functions: int = 16, overwrite: bool = False) -> Written:
    """Write points, modes, and the response functions of `functions` points (by farthest point sampling).

    If all modes start as sines, shapes are real: normal modes with undamped frequency and damping ratio. Otherwise they
    are the residues of the complex eigenvalues -d + 2 pi i f. Raises `ExportError` for a name that does not end in .uff
    or .unv, and where pyuff is missing.
    """
    path = Path(path)
    check_suffix(path, FORMATS["uff"].suffixes)
    if functions < 0:
        raise ExportError.expected("0 or more", functions, name="functions")
    with from_extra("uff", "pyuff", raising=ExportError):
        import pyuff
    damping = shared_dampings(field)
    sets = [_header(field), _units(), _nodes(field)]
    sets += [_mode(field, mode, damping) for mode in range(len(field.frequency))]
    rows = field.spread(functions) if functions else torch.zeros(0, dtype=torch.int64)
    frequencies = response_frequencies(field)
    sets += [_function(field, row, frequencies) for row in rows.tolist()]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "field.uff"
        # The output and warnings of pyuff are about its own implementation.
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            pyuff.UFF(str(place)).write_sets(sets, mode="overwrite")
        # Without the time, which pyuff adds, the same field gives the same file.
        content = _TIME.sub(lambda found: b" " * len(found[0]), place.read_bytes(), count=1)
    remarks = ["frequencies, dampings and shapes have six digits in data set 55, as the format sets them"]
    if not field.shared_damping:
        remarks.append("each mode has one damping, its mean by energy; response functions have each point's dampings")
    if field.noise.any():
        remarks.append("the residual noise is left out")
    leaning = math.degrees(math.acos(min(1.0, float(field.normals[rows].abs().amax(1).min())))) if len(rows) else 0.0
    # Nearer than a degree, a normal counts as along an axis.
    if leaning > 1.0:
        axis = f"their reference direction is the nearest axis, up to {leaning:.0f} degrees off"
        remarks.append(f"response functions are of impacts against the normal; {axis}")
    return Written(write_files({path: content}, overwrite=overwrite), tuple(remarks))


def response_frequencies(field: SampledField) -> Float64[np.ndarray, " lines"]:
    """Return where response functions are given, Hz: from 0 to about half the rate, as finely as sounds allow."""
    # At most 65,536 lines of a function.
    lines = max(2, min(field.samples // 2 + 1, 1 << 16))
    # The format has six digits for the step, from which readers count.
    step = float(f"{0.5 * field.sample_rate / (lines - 1):.5e}")
    return step * np.arange(lines)


def response(
    field: SampledField, row: int, frequencies: Float64[np.ndarray, " lines"]
) -> Complex128[np.ndarray, " lines"]:
    """Return the Laplace transform of an impact's modes at 2 pi i times the frequencies (Hz): sound over impulse.

    Of sine exp(-d t) sin(w t) + cosine exp(-d t) cos(w t) it is (sine w + cosine (s + d)) / ((s + d)^2 + w^2).
    """
    damping = (field.damping if field.shared_damping else field.damping[row]).numpy()
    turning = 2 * math.pi * field.frequency.numpy()
    gains = field.gains[row].to(torch.complex128).numpy()
    total = np.zeros(len(frequencies), dtype=np.complex128)
    for a, b, omega, rate in zip(gains.real, gains.imag, turning, damping, strict=True):
        shifted = 2j * math.pi * frequencies + rate
        total += (a * omega + b * shifted) / (shifted**2 + omega**2)
    return total


def _header(field: SampledField) -> dict[str, Any]:
    # No times, so that the same field gives the same file.
    moments = ("db_created", "db_saved", "db_written")
    times = {f"{kind}_{moment}": "" for moment in moments for kind in ("date", "time")}
    words = {"model_name": field.name[:80] or "object", "description": "modal sound field", "program": generator()}
    return {"type": 151, "db_app": "avmsf", **words, **times, "version_db1": 0, "version_db2": 0, "file_type": 0}


def _units() -> dict[str, Any]:
    factors = {"length": 1.0, "force": 1.0, "temp": 1.0, "temp_offset": 0.0}
    return {"type": 164, "units_code": 1, "units_description": "SI: meter, newton", "temp_mode": 1, **factors}


def _nodes(field: SampledField) -> dict[str, Any]:
    zeros = np.zeros(len(field), dtype=int)
    places = dict(zip("xyz", field.points.double().numpy().T, strict=True))
    systems = dict.fromkeys(("def_cs", "disp_cs", "color"), zeros)
    return {"type": 2411, "node_nums": np.arange(1, len(field) + 1), **systems, **places}


def _mode(field: SampledField, mode: int, damping: Float64[Tensor, " modes"]) -> dict[str, Any]:
    frequency, rate = float(field.frequency[mode]), float(damping[mode])
    record: dict[str, Any] = {
        "type": 55,
        "id1": field.name[:80] or "object",
        "id2": f"mode {mode + 1}: {frequency:.9g} Hz, exp(-{rate:.9g} t)",
        "id4": "times the direction of a force: what it excites; impacts go against normals",
        "id5": "NONE",
        "model_type": 1,
        "data_ch": 2,  # translations
        "spec_data_type": 0,
        "load_case": 0,
        "mode_n": mode + 1,
        "node_nums": np.arange(1, len(field) + 1),
    }
    gains = field.gains[:, mode].to(torch.complex128).numpy()
    if field.has_phases:
        # sine sin + cosine cos = 2 Re(residue exp(i w t)).
        values = -0.5j * gains
        kind = {
            "analysis_type": 3,  # complex modes
            "id3": "residues: sound = 2 Re sum shape exp(eig t)",
            "eig": complex(-rate, 2 * math.pi * frequency),
            "modal_a": 1.0 + 0.0j,
            "modal_b": 0.0 + 0.0j,
        }
    else:
        values = gains.real
        undamped = math.hypot(frequency, rate / (2 * math.pi))
        kind = {
            "analysis_type": 2,  # normal modes
            "id3": "amplitudes: sound = sum shape exp(-d t) sin",
            "freq": undamped,
            "modal_m": 1.0,
            "modal_damp_vis": rate / (2 * math.pi * undamped),
            "modal_damp_his": 0.0,
        }
    normals = field.normals.double().numpy()
    # Times the direction of a force they are what it excites: the amplitudes themselves for one against the normal.
    return record | kind | {f"r{axis + 1}": -values * normals[:, axis] for axis in range(3)}


def _function(field: SampledField, row: int, frequencies: Float64[np.ndarray, " lines"]) -> dict[str, Any]:
    # The direction is the axis nearest to that of the impact, which is opposite to the normal.
    force = -field.normals[row].double()
    axis = int(force.abs().argmax())
    direction = (axis + 1) * (1 if float(force[axis]) > 0 else -1)
    return {
        "type": 58,
        "binary": 1,
        "func_type": 4,  # frequency response
        "id1": f"sound over impulse, impact at point {row + 1} against its normal",
        "rsp_ent_name": "MICROPHONE",
        "rsp_node": 0,
        "rsp_dir": 0,
        "ref_ent_name": "POINT",
        "ref_node": row + 1,
        "ref_dir": direction,
        "abscissa_spacing": 1,
        "x": frequencies,
        "data": response(field, row, frequencies),
        "abscissa_spec_data_type": 18,
        "abscissa_axis_lab": "Frequency",
        "abscissa_axis_units_lab": "Hz",
        "ordinate_spec_data_type": 15 if field.per_newton else 1,
        "ordinate_axis_lab": "Sound",
        "orddenom_spec_data_type": 13,
        "orddenom_axis_lab": "Force",
        "orddenom_axis_units_lab": "N" if field.per_newton else "NONE",
    }
