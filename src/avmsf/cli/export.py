"""`avmsf export`: a field in the formats of other tools."""

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from avmsf._utils.text import counted, format_number
from avmsf.capture.filenames import find_surface_file
from avmsf.capture.folder import read_capture
from avmsf.capture.impacts import Impacts
from avmsf.capture.settings import METRES, settings_of
from avmsf.cli.contacts import given_contacts, note_off, refuse_far
from avmsf.cli.options.export import Options, unused_options
from avmsf.cli.printing import next_step, print_result, say
from avmsf.editing.modal_edit import EDITS
from avmsf.errors import ExportError
from avmsf.export.faust import contacts_path, fitted
from avmsf.export.geometry import read_gaussians
from avmsf.export.sampled_field import SampledField, spread_rows
from avmsf.export.samples import INSTRUMENT, Layer, hertz_layers
from avmsf.export.write import WRITERS
from avmsf.export.writing import POINTS, SUFFIXES, Format, Written
from avmsf.field.positions import points_on_object
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load
from avmsf.gaussians.ply import holds_gaussians
from avmsf.mesh.surface import Surface
from avmsf.pipeline.config import CACHE
from avmsf.pipeline.shape import SURFACE

_DEAD_DB = 40.0
"""Energy of a contact below the loudest one's, dB, from which on it is no key of a sample set by default."""
_Prepared = tuple[SoundField | SampledField, dict[str, Any]]
"""What a writer writes, and its settings."""


def run(options: Options) -> int:
    """Read, write, and print the size and what is left out."""
    for sentence in unused_options(options):
        say(f"note: {sentence}")
    field = load(options.field)
    source, settings = _PREPARED[options.to](field, options)
    written: Written = WRITERS[options.to](source, options.output, overwrite=options.overwrite, **settings)
    for remark in written.remarks:
        say(f"note: {remark}")
    if written.error:
        say(
            f"note: waveforms differ from the field's by up to {format_number(100 * written.error, 2)} % of its "
            f"loudest sample, magnitude spectra by {format_number(written.spectrum_error_db, 2)} dB on average"
        )
    largest = max(written.sizes, key=lambda path: written.sizes[path])
    files = f"{len(written.sizes)} files, the largest {largest.name}" if len(written.sizes) > 1 else "one file"
    text = f"wrote {options.output}: {options.to}, {written.size / 1e6:.3g} MB, {files}"
    values: dict[str, Any] = {
        "output": str(options.output),
        "format": options.to,
        "bytes": written.size,
        "error": written.error,
        "spectrum_error_db": written.spectrum_error_db,
        "files": {str(path): size for path, size in written.sizes.items()},
        "notes": list(written.remarks),
    }
    if options.to == "wavs":
        values["instrument"] = str(options.output / INSTRUMENT)
    elif options.to == "faust":
        contacts = contacts_path(options.output)
        text += f"; {contacts} has the coordinates of each contact"
        values["contacts"] = str(contacts)
    print_result(text, values, json=options.json)
    next_step(_following(options))
    if options.to == "wavs" and len(options.forces) == 1:
        next_step("the same command with --overwrite --forces 0.3 1 3, for a layer at each force")
    return 0


def _following(options: Options) -> str:
    """Return what to do with the files of a format."""
    output = shlex.quote(str(options.output))
    match options.to:
        case "web" if options.output.suffix.lower() in SUFFIXES["web"]:
            return f"open {output} in a browser"
        case "web":
            return f"python -m http.server --directory {output}, then open http://localhost:8000 in a browser"
        case "gltf":
            return f"open {output} in a glTF viewer"
        case "faust" if options.output.suffix.lower() == ".lib":
            call = "strike(contact, force, contactTime, gate)"
            return f'in a Faust program beside it: library("{options.output.name}").{call}'
        case "faust":
            return f"open {output} in the Faust IDE (https://faustide.grame.fr), or compile it: faust2jack {output}"
        case "wavs":
            return f"load {shlex.quote(str(options.output / INSTRUMENT))} in a sampler that reads SFZ"
        case "uff":
            return f"open {output} in a program for modal analysis"
        case _:
            return f"open {output} in the paper's web demo"


def _sampled(field: SoundField, options: Options) -> SampledField:
    """Return the field at the contacts of the options, or at its own points spread over the object."""
    if options.contacts_given:
        contacts = given_contacts(options.position, options.contact_table, unit=options.unit)
        refuse_far(contacts, field, advice=", see --unit")
        note_off(contacts, field)
        return SampledField.of(field, contacts.places, directions=contacts.directions)
    points = points_on_object(field.gain_field)
    sampled = SampledField.of(field, points, limit=options.contacts or POINTS[options.to])
    if len(sampled) < len(points) and options.contacts is None:
        held = counted(len(points), "contact")
        say(f"note: written: {len(sampled)} of the field's {held}; --contacts sets the number")
    return sampled


def _object(field: SoundField, options: Options) -> tuple[Path | Surface | None, float]:
    """Return what shows the object, and what its coordinates count in meters; print where there is nothing.

    A capture's own mesh is shown, otherwise the surface of the body that the field's gains are computed on, otherwise
    what was reconstructed from photographs, whose cavities may be closed. A capture shows the object as it was
    recorded: of a field edited to another size its mesh is scaled alike. Raises `ExportError` for a capture's Gaussians
    then.
    """
    if options.object is not None:
        _note_size(field, options.object)
        return options.object, METRES[options.object_unit]
    path, meters = _captured(options)
    if path is None:
        body = field.gain_field.surface
        if body is not None:
            return body, 1.0
        path, meters = _reconstructed(options), 1.0
    length = field.gain_field.length
    if length == 1.0 or path is None:
        return path, meters
    if holds_gaussians(path):
        wanted, got = f"a mesh for a field edited to {length:g} times its size", "Gaussians, which are not scaled"
        advice = "name a mesh of that size by --object, or leave --capture out"
        raise ExportError.expected(wanted, length, got=got, file=path, name="--capture", advice=advice)
    say(f"note: {path} is shown {length:g} times as large, as the field was edited")
    return path, meters * length


def _note_size(field: SoundField, path: Path) -> None:
    if (length := field.gain_field.length) != 1.0:
        say(f"note: the field was edited to {length:g} times its size; {path} is not scaled and has to have it")


def _captured(options: Options) -> tuple[Path | None, float]:
    """Return the capture's own mesh or Gaussians, and what its coordinates count in meters."""
    if options.capture is None:
        return None, 1.0
    settings = settings_of(options.capture)
    return find_surface_file(options.capture, settings), settings.surface_meters


def _reconstructed(options: Options) -> Path | None:
    """Return the surface, in meters, that `fit` left in a cache or `demo` next to the field; print if none."""
    field, capture = options.field, options.capture
    if capture is None:
        say("note: only the field's points are shown; --object or --capture adds the surface")
        return None
    caches = [capture / CACHE / SURFACE, *([field.parent / SURFACE] if field.parent.name == CACHE else [])]
    made = next((each for each in [field.with_name(f"{field.stem}-{SURFACE}"), *caches] if each.is_file()), None)
    if made is None:
        say(
            f"note: {capture} has no surface: only the field's points are shown; make one by avmsf fit {capture} "
            "--until surface, or give --object"
        )
    return made


def _web(field: SoundField, options: Options) -> _Prepared:
    source, meters = _object(field, options)
    body = None if isinstance(source, Surface) else field.gain_field.surface
    strikes = _recordings(field, options.capture)
    limit = options.contacts or POINTS["web"]
    return field, {"object": source, "meters": meters, "surface": body, "strikes": strikes, "limit": limit}


def _recordings(field: SoundField, capture: Path | None) -> Impacts | None:
    """Return a capture's recordings; None for an edited field, which is not to sound like them."""
    if capture is not None and field.origin.report.get(EDITS):
        say("note: the field is edited, so the page has no recordings to compare it with")
        return None
    return None if capture is None else read_capture(capture).impacts


def _gltf(field: SoundField, options: Options) -> _Prepared:
    sampled = _sampled(field, options)
    source, meters = _object(field, options)
    return sampled, {"object": source, "meters": meters, "up": options.up}


def _faust(field: SoundField, options: Options) -> _Prepared:
    sampled, noise = _sampled(field, options), not options.no_noise
    if options.contacts is None and not options.contacts_given:
        asked = len(sampled)
        sampled, noise = fitted(sampled, noise=noise)
        if len(sampled) < asked:
            say(f"note: {len(sampled)} of these are written, as many as Faust compiles in reasonable time")
    return sampled, {"noise": noise}


def _demo(field: SoundField, options: Options) -> _Prepared:
    source, most = options.object, options.contacts or POINTS["avmsf-demo"]
    settings = {"variant": options.variant, "precision": options.precision}
    if source is None:
        return _sampled(field, options), settings
    cloud = read_gaussians(source, points_on_object(field.gain_field))
    if cloud is None:
        wanted, advice = (
            "a .ply of Gaussians for the demo",
            "name one, or leave --object out for a disc at each contact",
        )
        raise ExportError.expected(wanted, got="another file", file=source, name="--object", advice=advice)
    _note_size(field, source)
    if len(cloud) > most:
        cloud = cloud.take(spread_rows(cloud.centers, most))
    return SampledField.of(field, cloud.centers), {**settings, "cloud": cloud}


def _wavs(field: SoundField, options: Options) -> _Prepared:
    forces, times = options.forces, options.contact_times
    if len(times) == 1:
        times = times * len(forces)
    if times and len(times) != len(forces):
        raise ExportError.expected(
            f"one, or one for each of {len(forces)} --forces", len(times), name="--contact-times"
        )
    layers = tuple(Layer(force, each, options.pulse) for force, each in zip(forces, times, strict=False))
    layers = layers or hertz_layers(forces, options.pulse)
    sampled = _sampled(field, options)
    if not options.contacts_given:
        sampled = _loud(sampled)
    settings = {"layers": layers, "seconds": options.seconds, "noise": not options.no_noise}
    return sampled, {**settings, "contacts": len(sampled)}


def _loud(sampled: SampledField) -> SampledField:
    """Return the field at contacts that are heard beside the loudest; says how many are left out."""
    level = 10 * torch.log10(sampled.energy.clamp_min(torch.finfo(torch.float64).tiny))
    loud = torch.nonzero(level >= level.max() - _DEAD_DB).flatten()
    if len(loud) < len(sampled):
        left = counted(len(sampled) - len(loud), "contact")
        say(f"note: {left} left out, {_DEAD_DB:g} dB or more below the loudest; --position writes any")
    return sampled.take(loud)


def _uff(field: SoundField, options: Options) -> _Prepared:
    return _sampled(field, options), {"functions": options.functions}


_PREPARED: dict[Format, Callable[[SoundField, Options], _Prepared]] = {
    "web": _web,
    "gltf": _gltf,
    "faust": _faust,
    "avmsf-demo": _demo,
    "wavs": _wavs,
    "uff": _uff,
}
