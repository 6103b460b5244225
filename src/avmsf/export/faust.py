"""A field as a Faust program: a bank of resonators with the contact, the force and the hammer's softness as controls.

The text needs no library of Faust's. An impact adds, over its contact time, its point's amplitudes to the resonators,
p[n] = z p[n-1] + (sine + i cosine) x[n] with z = exp((-d + 2 pi i f) / rate), of which the imaginary part is the sound:
at any sample rate, and in single precision without drift, which two-pole filters at low frequencies have.
"""

import re
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from avmsf._utils.text import csv_text
from avmsf.errors import ExportError
from avmsf.export.sampled_field import SampledField
from avmsf.export.writing import FORMATS, Written, check_suffix, generator, write_files

_MIN_POINTS = 16
"""Number of points below which the noise is left out so that more points fit."""
_ROW = 8
"""Numbers in one line."""
MAX_NUMBERS = 150_000
"""Maximum of all tables together: with 128 modes Faust compiles as many in half a minute."""


def write_faust(
    field: SampledField, path: str | Path, *, contacts: int | None = None, overwrite: bool = False
) -> Written:
    """Write a `.dsp` with controls, or a `.lib` without them, by the path's ending, and a table of the contacts.

    The table is `contacts_path(path)`: the coordinates of each `contact`, object frame, meters. More than `contacts`
    are reduced by farthest point sampling, by default to as many as Faust compiles in reasonable time; then a noise so
    long that few would fit is left out. Raises `ExportError` for another ending, and for `contacts` with more numbers
    than Faust compiles in reasonable time.
    """
    path = Path(path)
    check_suffix(path, FORMATS["faust"].suffixes)
    held, noisy, reason = len(field), bool(field.noise.any()), ""
    if contacts is None:
        reason = ": Faust compiles few in reasonable time"
        contacts, kept = _compiled(field, noise=noisy)
        field = field if kept else field.without_noise()
    field = field if held <= contacts else field.take(field.spread(contacts))
    text = faust_library(field)
    if path.suffix.lower() == ".dsp":
        text += _CONTROLS.format(*(field.average_force * factor for factor in (1.0, 100.0, 0.001)))
    remarks = ["all impacts share one bank of resonators; the force of an impact is half a sine over the contact time"]
    if not field.shared_damping:
        remarks.append("dampings are those of the last contact, for earlier impacts too")
    if len(field) < held:
        remarks.append(f"{len(field)} of {held} contacts are written, evenly spread{reason}")
    if field.noise.any():
        remarks.append("the noise restarts with every impact")
    elif noisy:
        remarks.append("the residual noise is left out")
    rows = ([row, *(f"{value:.9g}" for value in point)] for row, point in enumerate(field.points.tolist()))
    coordinates = csv_text([("contact", "x", "y", "z"), *rows])
    contents = {path: text.encode(), contacts_path(path): coordinates.encode()}
    return Written(write_files(contents, overwrite=overwrite), tuple(remarks))


def contacts_path(path: Path) -> Path:
    """Return the name of the table of contacts of a program: thing.contacts.csv for thing.dsp."""
    return path.with_suffix(".contacts.csv")


def _compiled(field: SampledField, *, noise: bool) -> tuple[int, bool]:
    """Return how many points Faust compiles in reasonable time, and whether with the noise or, as few fit, without."""
    at_a_point = max(1, _numbers_at_a_point(field))
    most = (MAX_NUMBERS - field.samples) // at_a_point
    if noise and most >= min(_MIN_POINTS, len(field)):
        return most, True
    return max(1, MAX_NUMBERS // at_a_point), False


def _numbers_at_a_point(field: SampledField) -> int:
    return field.gains.shape[1] * (1 + field.has_phases + (not field.shared_damping))


def faust_library(field: SampledField) -> str:
    """Return the definitions; `strike(contact, force, contactTime, gate)` is the sound.

    Raises ExportError for more than `MAX_NUMBERS`.
    """
    (points, modes), noise = field.gains.shape, bool(field.noise.any())
    numbers = points * _numbers_at_a_point(field) + noise * field.samples
    if numbers > MAX_NUMBERS:
        samples = f", {field.samples} samples of noise" if noise else ""
        wanted = f"at most {MAX_NUMBERS}, which Faust compiles in seconds"
        got = f"{numbers} ({points} points, {modes} modes{samples})"
        advice = "ask for fewer points, or leave the noise out"
        raise ExportError.expected(wanted, numbers, got=got, name="numbers", advice=advice)
    name = re.sub(r'["\\\x00-\x1f]', "", field.name) or "object"
    parts = [
        f"// {name}: {modes} modes at {points} points, as exported by {generator()}",
        f'declare name "{name}";',
        f"points = {points};\nrecordedRate = {float(field.sample_rate)!r};",
        _BASE.strip(),
        f"noiseDraw = {_waveform(field.noise)};" if noise else "",
        _NOISE.format(samples=field.samples).strip() if noise else "noise(since) = 0.0;",
        _bank(field),
        _STRIKE.format("force" if field.background_force is None else _number(field.background_force)).strip(),
    ]
    return "\n".join(part for part in parts if part) + "\n"


def _bank(field: SampledField) -> str:
    """Return the parallel resonators, each with a table of its mode's parameters indexed by the contact."""
    # One table for each mode: Faust copies a table for all modes once per mode, and takes minutes.
    lines = []
    for k, frequency in enumerate(field.frequency.tolist()):
        damping = repr(float(field.damping[k])) if field.shared_damping else _at_contact(field.damping[:, k])
        sine, cosine = _at_contact(field.gains[:, k].real), _at_contact(field.gains[:, k].imag)
        lines.append(f"  resonator({frequency!r}, {damping},\n    {sine},\n    {cosine})")
    return "bank(contact) = _ <:\n" + ",\n".join(lines) + "\n  :> _;"


def _at_contact(values: Float[Tensor, " points"]) -> str:
    if bool((values == values[0]).all()):
        return _number(float(values[0]))
    return f"({_waveform(values)}, contact : rdtable)"


def _waveform(values: Float[Tensor, " numbers"]) -> str:
    words = [_number(value) for value in values.tolist()]
    rows = (", ".join(words[start : start + _ROW]) for start in range(0, len(words), _ROW))
    return "waveform{" + ",\n    ".join(rows) + "}"


def _number(value: float) -> str:
    word = f"{value:.9g}"
    # Without a decimal point the table would be of integers.
    return word if any(mark in word for mark in ".en") else f"{word}.0"


_BASE = """
SR = min(192000.0, max(1.0, fconstant(int fSamplingFreq, <math.h>)));
PI = 3.14159265358979323846;
resonator(frequency, damping, sine, cosine) = (step ~ (_, _)) : !, _ with {
  decay = exp(0.0 - damping / SR);
  turn = 2.0 * PI * frequency / SR;
  zr = decay * cos(turn);
  zi = decay * sin(turn);
  audible = frequency < 0.5 * SR;
  step(re, im, x) = zr * re - zi * im + audible * sine * x, zr * im + zi * re + audible * cosine * x;
};
// Samples since the gate opened, from 1 on; 0 before the first impact.
sinceImpact(gate) = count ~ _ with {
  opened = (gate > 0) & (gate' <= 0);
  count(before) = select2(opened, min(before + (before > 0), 1073741824), 1);
};
// The part of half a sine that falls into each sample's time; all parts together are 1.
pulse(contactTime, since) = (since > 0) * sin((from + to) * PI / 2.0) * sin((to - from) * PI / 2.0) with {
  length = max(contactTime * SR, 1.0);
  from = min(max(since - 1, 0) / length, 1.0);
  to = min(since / length, 1.0);
};
"""
_NOISE = """
noise(since) = (since > 0) * (place < {samples}) * (noiseDraw, int(min(place, {samples} - 1)) : rdtable) with {{
  place = max(since - 1, 0) * (recordedRate / SR);
}};
"""
_STRIKE = """
strike(contact, force, contactTime, gate) = force * pulse(contactTime, since) : bank(contact) : +({} * noise(since))
with {{
  since = sinceImpact(gate);
}};
"""
_CONTROLS = """
process = strike(
  int(nentry("contact", 0, 0, points - 1, 1)),
  hslider("force", {:g}, 0, {:g}, {:g}),
  hslider("contactTime[unit:s]", 0, 0, 0.02, 0.0001),
  button("gate"));
"""
