"""`avmsf export`: a field, or many, in the formats of other tools."""

import math
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from avmsf._utils.text import format_number
from avmsf.capture.filenames import find_surface_file
from avmsf.capture.settings import METRES, settings_of
from avmsf.cli.many import Many, run_many
from avmsf.cli.options import Flag, Int, Number, Unit, option_of
from avmsf.cli.output import finish, note
from avmsf.cli.paths import ContactTable, FieldFiles, New, OtherCapture, PositionList, ShapeFile, arg
from avmsf.errors import ExportError
from avmsf.export.writing import FORMATS, Axis, Format, Precision, check_free
from avmsf.modal.config import PulseShape
from avmsf.pipeline.config import CACHE, SURFACE

if TYPE_CHECKING:
    from avmsf.export.sampled_field import SampledField
    from avmsf.field.sound_field import SoundField
    from avmsf.gaussians.cloud import GaussianCloud
    from avmsf.mesh.surface import Surface

_CONTACTS = ("position", "contact_table", "unit")
_USED: dict[Format, tuple[str, ...]] = {
    "web": ("object", "object_unit", "capture", "no_noise"),
    "gltf": ("object", "object_unit", "capture", "up", *_CONTACTS),
    "faust": ("no_noise", *_CONTACTS),
    "avmsf-demo": ("object", "variant", "precision"),
    "wavs": ("forces", "contact_times", "pulse", "seconds", "no_noise", *_CONTACTS),
    "uff": ("functions", *_CONTACTS),
}
"""Options that each format uses, in addition to those that all use."""
_NEXT: dict[str, str] = {
    **dict.fromkeys(FORMATS["web"].suffixes, "open {0} in a browser"),
    "web": "python -m http.server --directory {0}, then open http://localhost:8000 in a browser",
    "gltf": "open {0} in a glTF viewer",
    ".lib": 'in a Faust program beside it: library("{1}").strike(contact, force, contactTime, gate)',
    "faust": "open {0} in the Faust IDE (https://faustide.grame.fr), or compile it: faust2jack {0}",
    "wavs": "load {0}/instrument.sfz in a sampler that reads SFZ",
    "uff": "open {0} in a program for modal analysis",
    "avmsf-demo": "open {0} in the paper's web demo",
}
"""What to do with the files of a suffix or a format, of the quoted path and of the file's name."""


@dataclass(frozen=True)
class Options(Many):
    """Write a field for other tools: web page, glTF, Faust, samplers, modal analysis.

    web: a page that plays impacts, as a folder or one .html file. gltf: a .glb that any viewer shows, with the draft
    extension KHR_audio_rigid_bodies. faust: a .dsp with controls, or a .lib. wavs: sounds with a table and an SFZ
    instrument. uff: the universal file format. avmsf-demo: the layout of the paper's demo. Of several fields, -o is a
    folder of their exports, --capture one of their captures.
    """

    inputs: tyro.conf.Positional[FieldFiles]
    """Field files, as `avmsf fit` writes them."""
    to: Format
    """Format to write."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE|FOLDER")]
    """Folder, or file (.html, .glb, .dsp, .lib, .uff)."""
    object: ShapeFile = None
    """Mesh or Gaussians to show; by default the capture's."""
    object_unit: Annotated[Unit, arg("UNIT")] = "m"
    """m (default), cm, mm, in or ft, of the object's mesh."""
    capture: OtherCapture = None
    """Its mesh is shown, and a page plays its recordings."""
    contacts: Int = None
    """Maximum number of contacts, spread over the object."""
    position: PositionList = ()
    """A contact in place of these; once for each."""
    contact_table: ContactTable = None
    """Table of such contacts: x,y,z and perhaps nx,ny,nz."""
    unit: Annotated[Unit, arg("UNIT")] = "m"
    """Of --position and --contact-table."""
    overwrite: Flag = False
    """Replace a file, or the folder of an earlier export."""
    forces: Annotated[tuple[float, ...], tyro.conf.arg(metavar="F ...")] = ()
    """wavs: force of each layer; by default that of an average recorded impact."""
    contact_times: Annotated[tuple[float, ...], arg("SECONDS ...")] = ()
    """wavs: of each layer; by default by Hertz's law."""
    seconds: Number = None
    """wavs: length; by default that of the training sounds."""
    pulse: Annotated[PulseShape, arg("half-sine|hertz")] = "half-sine"
    """wavs: force over the contact time."""
    up: Axis = "z"
    """gltf: axis that points up."""
    no_noise: Flag = False
    """web, faust, wavs: the modes without the residual noise."""
    functions: int = 16
    """uff: points with response functions."""
    variant: Annotated[str, tyro.conf.arg(metavar="NAME")] = "original"
    """avmsf-demo: name of the sound."""
    precision: Annotated[Precision, arg("float16|float32")] = "float32"
    """avmsf-demo: number format of the gains."""

    alone = ("object", *_CONTACTS)

    def of(self, given: Path, output: Path) -> "Options":
        """Return the options for one of many fields."""
        capture = None if self.capture is None else self.capture / output.name
        path = output.with_name(f"{output.name}{''.join(FORMATS[self.to].suffixes[:1])}")
        return replace(self, inputs=(given,), output=path, capture=capture)

    def read(self) -> Iterator[Path]:
        """Return the files and folders on whose content the output depends."""
        yield from super().read()
        if self.capture is not None:
            yield from (each for each in _surfaces(self.inputs[0], self.capture) if each.is_file())

    def cells(self, values: Mapping[str, Any]) -> dict[str, str]:
        """Return what the table of many shows of an export."""
        return {"bytes": str(values.get("bytes", "")), "error": str(values.get("error", ""))}

    @property
    def contacts_given(self) -> bool:
        """Whether the contacts are given, and used by the format."""
        return "position" in _USED[self.to] and bool(self.position or self.contact_table)

    def _check(self) -> None:
        if self.several:
            return
        given = sum((bool(self.position), self.contact_table is not None, self.contacts is not None))
        if self.contacts_given and given > 1:
            wanted, advice = "contacts by one of --position, --contact-table and --contacts", "leave out the others"
            name = "--position" if self.position else "--contact-table"
            raise ExportError.expected(wanted, given, name=name, advice=advice)
        if self.contacts is not None and self.contacts < 1:
            raise ExportError.expected("1 or more", self.contacts, name="--contacts")
        # A web page is a file or, by a name without its suffix, a folder.
        suffixes = FORMATS[self.to].suffixes
        (New(suffixes, or_folder=self.to == "web") if suffixes else New()).check(self.output)
        check_free(self.output, folder=self.output.suffix.lower() not in suffixes, overwrite=self.overwrite)


def run(options: Options) -> int:
    """Read, write, and print the size and what is left out."""
    if options.several:
        return run_many("export", options, raising=ExportError)
    from avmsf.export.faust import contacts_path
    from avmsf.export.samples import INSTRUMENT
    from avmsf.export.write import write
    from avmsf.field.store import load

    for each in fields(options):
        users = [name for name, used in _USED.items() if each.name in used]
        if users and options.to not in users and getattr(options, each.name) != each.default:
            note(f"{option_of(each.name)} is not used by --to {options.to}, only by {', '.join(users)}")
    field = load(options.inputs[0])
    if field.residual.recordings is not None and not options.no_noise:
        note("what the nearest recordings have in addition to their modes is in no export, unlike in avmsf render")
    source, settings = _for_format(field, options)
    written = write(
        source, options.output, to=options.to, contacts=options.contacts, noise=not options.no_noise,
        overwrite=options.overwrite, **settings,
    )  # fmt: skip
    for remark in written.remarks:
        note(remark)
    if written.error:
        note(
            f"waveforms differ from the field's by up to {format_number(100 * written.error, 2)} % of its "
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
        values["contacts"] = str(contacts_path(options.output))
        text += f"; {values['contacts']} has the coordinates of each contact"
    following = _NEXT.get(options.output.suffix.lower(), _NEXT[options.to])
    steps = [following.format(shlex.quote(str(options.output)), options.output.name)]
    if options.to == "wavs" and len(options.forces) < 2:
        forces = " ".join(format_number(factor * (field.residual.force or 1.0), 2) for factor in (0.3, 1.0, 3.0))
        steps.append(f"the same command with --overwrite --forces {forces}, for a layer at each force")
    return finish(text, values, *steps)


def _for_format(field: "SoundField", options: Options) -> "tuple[SoundField | SampledField, dict[str, Any]]":
    """Return the field, or what it is at the contacts that are given, and the settings of the format's writer."""
    from avmsf.capture.folder import read_capture
    from avmsf.cli.contacts import contacts_on
    from avmsf.editing.modal_edit import EDITS
    from avmsf.export.sampled_field import SampledField
    from avmsf.export.samples import samples_in
    from avmsf.mesh.surface import Surface

    source: SoundField | SampledField = field
    if options.contacts_given:
        contacts = contacts_on(field, options.position, options.contact_table, unit=options.unit)
        samples = samples_in(options.seconds, field.sample_rate) if options.to == "wavs" else None
        source = SampledField.of(field, contacts.places, directions=contacts.directions, samples=samples)
    settings: dict[str, Any] = {}
    match options.to:
        case "web":
            shown, meters = _object(field, options)
            surface = None if isinstance(shown, Surface) else field.gain_field.surface
            settings = {"object": shown, "meters": meters, "surface": surface}
            if options.capture is not None and field.origin.report.get(EDITS):
                note("the field is edited, so the page has no recordings to compare it with")
            elif options.capture is not None:
                # From where the field's sounds start.
                starting = settings_of(options.capture).starting(field.origin.settings.time_zero)
                settings["strikes"] = read_capture(options.capture, starting).impacts
        case "gltf":
            shown, meters = _object(field, options)
            settings = {"object": shown, "meters": meters, "up": options.up}
        case "wavs":
            settings = _wav_settings(options, field.residual.force or 1.0)
        case "uff":
            settings = {"functions": options.functions}
        case "avmsf-demo":
            settings = {"variant": options.variant, "precision": options.precision}
            if options.object is not None:
                limit = options.contacts or FORMATS[options.to].points
                source, settings["cloud"] = _at_gaussians(field, options.object, limit)
    return source, settings


def _object(field: "SoundField", options: Options) -> "tuple[Path | Surface | None, float]":
    """Return what shows the object, and what its coordinates count in meters; print where there is nothing.

    A capture's own mesh is shown, otherwise the surface of the body that the field's gains are computed on, otherwise
    what was reconstructed from photographs, whose cavities may be closed. A capture shows the object as it was
    recorded: of a field edited to another size its mesh is scaled alike. Raises `ExportError` for a capture's Gaussians
    then.
    """
    from avmsf.gaussians.ply import holds_gaussians

    length, path, meters = field.gain_field.length, None, 1.0
    if options.object is not None:
        _note_size(field, options.object)
        return options.object, METRES[options.object_unit]
    if options.capture is not None:
        settings = settings_of(options.capture)
        path, meters = find_surface_file(options.capture, settings), settings.surface_meters
    if path is None:
        if field.gain_field.surface is not None:
            return field.gain_field.surface, 1.0
        path, meters = _reconstructed(options), 1.0
    if length == 1.0 or path is None:
        return path, meters
    if holds_gaussians(path):
        wanted, got = f"a mesh for a field edited to {length:g} times its size", "Gaussians, which are not scaled"
        advice = "name a mesh of that size by --object, or leave --capture out"
        raise ExportError.expected(wanted, length, got=got, file=path, name="--capture", advice=advice)
    note(f"{path} is shown {length:g} times as large, as the field was edited")
    return path, meters * length


def _note_size(field: "SoundField", path: Path) -> None:
    if (length := field.gain_field.length) != 1.0:
        note(f"the field was edited to {length:g} times its size; {path} is not scaled and has to have it")


def _surfaces(field: Path, capture: Path) -> list[Path]:
    """Return where a surface for a field may lie, the field's own first."""
    caches = [capture / CACHE / SURFACE, *([field.parent / SURFACE] if field.parent.name == CACHE else [])]
    return [field.with_name(f"{field.stem}-{SURFACE}"), *caches]


def _reconstructed(options: Options) -> Path | None:
    """Return the surface, in meters, that `fit` left in a cache or `demo` next to the field; print if none."""
    field, capture = options.inputs[0], options.capture
    if capture is None:
        note("only the field's points are shown; --object or --capture adds the surface")
        return None
    made = next((each for each in _surfaces(field, capture) if each.is_file()), None)
    if made is None:
        advice = f"make one by avmsf fit {capture} --until surface, or give --object"
        note(f"{capture} has no surface: only the field's points are shown; {advice}")
    return made


def _at_gaussians(field: "SoundField", path: Path, limit: int) -> "tuple[SampledField, GaussianCloud]":
    """Return the field at Gaussians of a file, and these, at most `limit`. Raises `ExportError` for another file."""
    from avmsf.export.geometry import read_gaussians
    from avmsf.export.sampled_field import SampledField, spread_rows
    from avmsf.field.gains.model import points_on_object

    cloud = read_gaussians(path, points_on_object(field.gain_field))
    if cloud is None:
        wanted, advice = "a .ply of Gaussians", "name one, or leave --object out for a disc at each contact"
        raise ExportError.expected(wanted, got="another file", file=path, name="--object", advice=advice)
    _note_size(field, path)
    if len(cloud) > limit:
        cloud = cloud.take(spread_rows(cloud.centers, limit))
    return SampledField.of(field, cloud.centers), cloud


def _wav_settings(options: Options, average_force: float) -> dict[str, Any]:
    from avmsf.export.samples import Layer, hertz_layers

    forces, times = options.forces or (average_force,), options.contact_times
    if len(times) == 1:
        times = times * len(forces)
    elif len(forces) == 1:
        forces = forces * max(len(times), 1)
    if times and len(times) != len(forces):
        wanted = f"one, or one for each of {len(forces)} --forces"
        raise ExportError.expected(wanted, len(times), name="--contact-times")
    layers = tuple(Layer(force, each, options.pulse) for force, each in zip(forces, times, strict=False))
    settings = {"layers": layers or hertz_layers(forces, options.pulse), "seconds": options.seconds}
    return settings | ({"range_db": math.inf} if options.contacts_given else {})
