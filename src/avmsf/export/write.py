"""A field in any format of other tools, by the ending of a file's name or the format's."""

from collections.abc import Callable
from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import Any

from avmsf.errors import ExportError
from avmsf.export import write_demo, write_faust, write_gltf, write_grid, write_universal, write_webpage
from avmsf.export.sampled_field import SampledField
from avmsf.export.samples import samples_in
from avmsf.export.writing import FORMATS, Format, Written
from avmsf.field.gains.model import points_on_object
from avmsf.field.sound_field import SoundField

_OF_SUFFIX: dict[str, Format] = {suffix: name for name, each in FORMATS.items() for suffix in each.suffixes}
WRITERS: dict[Format, Callable[..., Written]] = {
    "web": write_webpage,
    "gltf": write_gltf,
    "faust": write_faust,
    "avmsf-demo": write_demo,
    "wavs": write_grid,
    "uff": write_universal,
}
"""The writers, of a field at points of the object."""


def write(
    field: SoundField | SampledField,
    output: str | Path,
    *,
    to: Format | None = None,
    contacts: int | None = None,
    noise: bool = True,
    **options: Any,
) -> Written:
    """Write a field for other tools.

    Args:
        field: The field, or what it is at points of your own, all of which are written.
        output: File or folder. The ending decides the format: .html a web page, .glb glTF, .dsp and .lib Faust, .uff
            modal analysis.
        to: The format of a folder: "web", "wavs" (a sample set) or "avmsf-demo" (the layout of the paper's demo).
        contacts: Number of points, spread over the object, at most; by default as many as the format's tools read
            easily.
        noise: Whether the residual noise is written, where the format has it.
        options: Of the writer in `avmsf.export`: `overwrite=True` to replace files; of a page (`write_webpage`)
            `strikes`, recorded Impacts to hear beside the field, `object` and `surface`, files or Surfaces to show.

    Returns:
        The files, and what the format could not hold.

    Raises:
        ExportError: For an unknown ending or option, and as the writer.
    """
    output = Path(output)
    kind = _OF_SUFFIX.get(output.suffix.lower()) if to is None else to
    if kind is None or kind not in FORMATS:
        wanted = f"a name that ends in {', '.join(_OF_SUFFIX)}, or to= one of {', '.join(FORMATS)}"
        raise ExportError.expected(wanted, output.suffix if to is None else to, file=output, name="to")
    known = [name for name, each in signature(WRITERS[kind]).parameters.items() if each.kind is each.KEYWORD_ONLY]
    if unknown := next((name for name in options if name not in known), None):
        raise ExportError.unknown(unknown, known, name=f"an option of {kind}")
    remarks: tuple[str, ...] = ()
    if isinstance(field, SampledField):
        sampled = field
    else:
        limit = FORMATS[kind].points if contacts is None else contacts
        sampled = SampledField.of(field, limit=limit, samples=samples_in(options.get("seconds"), field.sample_rate))
        held = len(points_on_object(field.gain_field))
        if contacts is None and len(sampled) < held:
            remarks = (f"written: {len(sampled)} of the field's {held} contacts; `contacts` sets the number",)
    if not noise:
        sampled = sampled.without_noise()
    if kind == "faust" and (contacts is not None or isinstance(field, SampledField)):
        options = {"contacts": len(sampled), **options}
    written = WRITERS[kind](sampled, output, **options)
    return replace(written, remarks=(*remarks, *written.remarks))
