"""ObjectFolder Real as it is published: a folder a contact, with the microphone, the hammer's force and two notes."""

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import soundfile

from avmsf._utils.text import in_order, parse_json, read_text
from avmsf.capture.audio import Recording, read_recording
from avmsf.capture.checks import find_surface
from avmsf.capture.filenames import SHAPE_SUFFIXES, files_in
from avmsf.capture.folder import Capture
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.table import Impact
from avmsf.datasets.dataset import DatasetReport, ObjectFacts, ObjectReport, VisualSource
from avmsf.datasets.numbering import REALIMPACT_NAMES, expect_known, in_words, material_in, number_of, shared_remarks
from avmsf.datasets.recordings import build_capture, refuse_few
from avmsf.errors import CaptureError, DatasetError

SAMPLE_RATE_HZ = 48_000
"""Of all recordings of ObjectFolder Real."""
FRAMES = 288_000
"""Of each recording, at least: 6 s, one of them before the impact."""
PAD_DB = 20.0
"""What the recorder's pad switch takes away."""
DOWNLOAD = "https://download.cs.stanford.edu/viscam/ObjectFolder_Real"
SETTINGS = CaptureSettings(force_channel=1, response_channel=2, normalize="peak")
CONTACT_LISTS = ("objectfolder_real_train.json", "objectfolder_real_val.json")
"""SonicGauss's lists of recordings with their contacts."""
MESH_FOLDERS = ("mesh_16k", "mesh_64k", "mesh_full")
"""The same scans in three resolutions, preferred in this order: about 16,000 faces are plenty to see where an impact
was and to render pictures, and are read the fastest."""
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_LISTED = re.compile(r"(?:^|/)(\d+)_(\d+)_[^/]*\.wav$")

Point = tuple[float, float, float]


class ObjectFolderRaw:
    """ObjectFolder Real, unpacked from its audio archives: `<object>/audio/<contact>/mic.wav` and so on.

    The archives hold no contacts: these come from SonicGauss's lists (`read_contacts`). `contacts` names one of them or
    a folder with them; by default they are sought in the folder and its parent, and so are meshes (`find_mesh`).

    Sounds start at the force's onset, or with `time_zero` "peak" at their peaks, as in the paper. They are divided by
    the peak force in newtons and by the recorder's gain, so that one is the microphone's full scale at 0 dB of gain,
    per newton.
    """

    name = "ObjectFolder Real"

    def __init__(self, folder: str | Path, *, contacts: str | Path | None = None, time_zero: str | None = None) -> None:
        self.folder = Path(folder)
        self._settings = SETTINGS.starting(time_zero)
        self._given_contacts = None if contacts is None else Path(contacts)

    def objects(self) -> tuple[str, ...]:
        """Return the numbers of all objects with recordings, in their order."""
        return tuple(self._folders)

    def facts(self, identifier: str) -> ObjectFacts:
        """Return RealImpact's name and material for an object of this number, inferred; else its number alone.

        Raises DatasetError for an unknown object.
        """
        expect_known(identifier, self._folders, self.name)
        name = next((each for each in REALIMPACT_NAMES if number_of(each) == int(identifier)), None)
        if name is None:
            return ObjectFacts(identifier, identifier)
        return ObjectFacts(identifier, in_words(name), material_in(name), inferred=True)

    def capture(self, identifier: str) -> Capture:
        """Read one object's recordings, in the order of their numbers. Raises DatasetError for an unknown object, and
        where fewer than two recordings can be used; a warning names those that were left out."""
        expect_known(identifier, self._folders, self.name)
        impacts, problems = self._examine(identifier)
        origin = f"{self.name}, object {identifier}"
        refuse_few(len(impacts), origin=origin, reasons=problems or [self._no_contacts])
        source = self.visual_source(identifier)
        try:
            surface = None if source is None else find_surface(source.folder, source.settings)
        except CaptureError as error:
            raise DatasetError(f"{origin}: {error}", **error.attributes) from error
        return build_capture(
            self._recordings(identifier, impacts),
            name=self.facts(identifier).name,
            origin=origin,
            settings=self._settings,
            surface=surface,
            remarks=problems,
        )

    def visual_source(self, identifier: str) -> VisualSource | None:
        """Return the object's scanned mesh; None where the meshes' archive was not unpacked here."""
        expect_known(identifier, self._folders, self.name)
        return find_mesh(self.folder, identifier)

    def check(self) -> DatasetReport:
        """Report which files are there and which are missing, from names and headers alone."""
        reports = []
        for identifier in self.objects():
            impacts, problems = self._examine(identifier)
            reports.append(ObjectReport(self.facts(identifier), len(impacts), tuple(problems)))
        missing, remarks = self._missing_archives(), shared_remarks(self.objects(), "RealImpact")
        if not mesh_folders(self.folder):
            mesh = f"meshes, the only visual input: unpack {DOWNLOAD}/mesh/mesh_16k.tar.gz in {self.folder}"
            missing.insert(0, mesh)
        if self._contact_files:
            remarks.insert(0, f"contacts are read from {', '.join(map(str, self._contact_files))}")
        else:
            missing.insert(0, self._no_contacts)
        remarks.append("names are inferred from RealImpact's numbers")
        return DatasetReport(self.name, tuple(reports), tuple(missing), tuple(remarks))

    @cached_property
    def _folders(self) -> dict[str, Path]:
        """The `audio` folder of each object."""
        found = {path.name: path / "audio" for path in self.folder.iterdir() if path.name.isdecimal()}
        return {name: found[name] for name in in_order(found) if any(found[name].glob("[0-9]*/*.wav"))}

    @cached_property
    def _contact_files(self) -> tuple[Path, ...]:
        return find_contacts(self.folder, self._given_contacts)

    @cached_property
    def _contacts(self) -> Mapping[tuple[str, str], Point]:
        return read_contacts(self._contact_files)

    @property
    def _no_contacts(self) -> str:
        return (
            "contact coordinates, which the audio archives do not hold: put SonicGauss's "
            f"{' and '.join(CONTACT_LISTS)} into {self.folder} or its parent"
        )

    def _examine(self, identifier: str) -> tuple[list[Impact], list[str]]:
        """Return the usable recordings' impacts, and a message for each problem or assumption."""
        found: list[tuple[str, float, float | None]] = []
        problems = []
        folders = self._folders[identifier]
        for folder in (folders / name for name in in_order(path.name for path in folders.iterdir())):
            contact = folder.name
            if not folder.is_dir() or contact.startswith(".") or contact.endswith("_deprecated"):
                continue
            if not contact.isdecimal():
                problems.append(f"audio/{contact}: expected a contact's number as name; it is left out")
                continue
            wrong, newtons, gain_db = self._check_folder(identifier, contact, folder)
            problems += wrong
            if not wrong:
                found.append((contact, newtons, gain_db))
        gains = Counter(gain_db for _, _, gain_db in found if gain_db is not None)
        usual = gains.most_common(1)[0][0] if gains else 0.0
        unknown = [contact for contact, _, gain_db in found if gain_db is None]
        if unknown:
            taken = f"{usual:g} dB, the most frequent of the object's recordings" if gains else "0 dB"
            problems.append(
                f"metadata.yaml is missing for contact {', '.join(unknown)}: the recorder's gain is assumed to be "
                f"{taken}"
            )
        impacts = [
            Impact(
                f"{contact}.wav",
                self._contacts[identifier, contact],
                newtons=newtons,
                gain_db=usual if gain_db is None else gain_db,
            )
            for contact, newtons, gain_db in found
        ]
        return impacts, problems

    def _check_folder(self, identifier: str, contact: str, folder: Path) -> tuple[list[str], float, float | None]:
        """Return why a contact's recording cannot be used, a message for each reason; its force, N, and gain, dB."""
        shown = f"{identifier}/audio/{contact}"
        found = [check_wav(folder / name, shown=f"{shown}/{name}") for name in ("mic.wav", "Force.wav")]
        wrong = [str(error) for error in found if error is not None]
        newtons, gain_db = math.nan, None
        try:
            gain_db = read_gain_db(folder / "metadata.yaml") if (folder / "metadata.yaml").is_file() else None
            newtons = read_newtons(folder / "striking_force.yaml")
        except DatasetError as error:
            wrong.append(str(error))
        if (identifier, contact) not in self._contacts and (self._contact_files or not wrong):
            files = ", ".join(path.name for path in self._contact_files)
            wrong.append(f"{shown}: expected contact coordinates{files and f' in {files}'}, got none")
        return wrong, newtons, gain_db

    def _recordings(self, identifier: str, impacts: list[Impact]) -> Iterator[tuple[Impact, Recording]]:
        for impact in impacts:
            folder = self._folders[identifier] / impact.file.removesuffix(".wav")
            force, sound = (read_recording(folder / name) for name in ("Force.wav", "mic.wav"))
            frames = min(force.frames, sound.frames)
            channels = np.stack([force.channels[0, :frames], sound.channels[0, :frames]])
            name = f"{identifier}/audio/{folder.name}/mic.wav"
            yield impact, Recording(name, channels, sound.sample_rate, sound.subtype)

    def _missing_archives(self) -> list[str]:
        present = {int(name) for name in self._folders}
        missing = []
        for first in range(1, 100, 10):
            archive = f"audio_data_{first}_{first + 9}.tar.gz"
            if not present & set(range(first, first + 10)):
                packed = (self.folder / archive).is_file()
                source = archive if packed else f"{DOWNLOAD}/audio/{archive}"
                missing.append(f"objects {first} to {first + 9}: unpack {source} in {self.folder}")
        return missing


def find_mesh(folder: Path, identifier: str) -> VisualSource | None:
    """Return an object's mesh from the dataset's folder, a `mesh` folder in it, or beside it; None where there is none.

    How the archives are laid out inside is not known for certain, so a mesh may be called `<object>.obj`, or be the one
    mesh in a folder `<object>`, however deep.
    """
    for place in mesh_folders(folder):
        flat = [place / f"{identifier}{suffix}" for suffix in SHAPE_SUFFIXES]
        deep = [path for path in files_in(place / identifier) if path.suffix.lower() in SHAPE_SUFFIXES]
        for path in (*flat, *deep):
            if path.is_file():
                return VisualSource(path.parent, CaptureSettings(surface=path.name))
    return None


def mesh_folders(folder: Path) -> list[Path]:
    """Return the folders of meshes that there are, the preferred first."""
    places = [folder, folder / "mesh", folder.resolve().parent, folder.resolve().parent / "mesh"]
    return [place / name for name in MESH_FOLDERS for place in places if (place / name).is_dir()]


def find_contacts(folder: Path, given: Path | None = None) -> tuple[Path, ...]:
    """Return the lists of contacts in the folder or its parent, or those that are `given`: one, or a folder with some.

    Raises DatasetError where nothing `given` is there.
    """
    if given is not None and given.is_file():
        return (given,)
    for place in (folder, folder.resolve().parent) if given is None else (given,):
        found = tuple(place / name for name in CONTACT_LISTS if (place / name).is_file())
        if found:
            return found
    if given is not None:
        got = "a folder without them" if given.is_dir() else "no file or folder"
        wanted = f"{' and '.join(CONTACT_LISTS)}, or one of these lists"
        raise DatasetError.expected(wanted, got=got, file=given, name="contacts")
    return ()


def read_contacts(files: Sequence[Path]) -> dict[tuple[str, str], Point]:
    """Return the contacts of lists by object and contact, meters in the mesh's frame.

    A list is one JSON array of objects, or has an object a line. Raises DatasetError for a list of another form, and
    where a contact has two positions.
    """
    places: dict[tuple[str, str], Point] = {}
    for path in files:
        for row, record in _records(path):
            key, place = _parse_record(record, path, row)
            if places.setdefault(key, place) != place:
                wanted, got = f"one position of contact {key[1]} of object {key[0]}", f"{place} and {places[key]}"
                raise DatasetError.expected(
                    wanted, place, got=got, file=path, row=row, name=key[1], advice="delete one"
                )
    return places


def _records(path: Path) -> list[tuple[int, Any]]:
    """Return a list's records with their rows: indices of one JSON list, or lines, from 1, with an object each."""
    try:
        text = read_text(path)
        if text.lstrip().startswith("["):
            return list(enumerate(parse_json(text)))
        return [(row, parse_json(line)) for row, line in enumerate(text.splitlines(), start=1) if line.strip()]
    except (OSError, ValueError) as error:
        raise DatasetError.expected("a JSON list of contacts", got=str(error), file=path) from error


def _parse_record(record: Any, path: Path, row: int) -> tuple[tuple[str, str], Point]:
    location = record.get("location") if isinstance(record, dict) else None
    found = _LISTED.search(location) if isinstance(location, str) else None
    if found is None:
        wanted = "a location that ends in OBJECT_CONTACT_3sec_48000hz.wav"
        raise DatasetError.expected(wanted, location, file=path, row=row, name="location")
    contact = record.get("contact")
    numbers = isinstance(contact, list) and all(type(value) in (int, float) for value in contact)
    if not numbers or len(contact) != 3 or not np.isfinite(contact).all():
        raise DatasetError.expected("a contact of three numbers, meters", contact, file=path, row=row, name="contact")
    x, y, z = map(float, contact)
    return (str(int(found[1])), str(int(found[2]))), (x, y, z)


def check_wav(path: Path, *, shown: str) -> DatasetError | None:
    """Return the error of a sound file, which it calls `shown`, from its header alone; or None."""
    advice = "unpack or download it again"
    if not path.is_file():
        return DatasetError.expected("a sound file", file=shown, advice=advice)
    try:
        header = soundfile.info(str(path))
    except (soundfile.LibsndfileError, OSError) as error:
        reason = getattr(error, "error_string", str(error)).strip().rstrip(".")
        return DatasetError.expected("a sound file", got=repr(reason), file=shown, advice=advice)
    for name, found, expected in (
        ("sample rate", header.samplerate, SAMPLE_RATE_HZ),
        ("number of channels", header.channels, 1),
        ("length in frames", header.frames, max(FRAMES, header.frames)),
    ):
        if found != expected:
            advice = "take the published file"
            return DatasetError.expected(f"a {name} of {expected}", found, file=shown, name=name, advice=advice)
    return None


def read_gain_db(path: Path) -> float:
    """Return by how much the recorder made the microphone's sound louder, by its amplifier less its pad, dB.

    A `metadata.yaml` has two lists, `gain` and `pad`, of the force and the microphone, in either of YAML's ways to
    write lists. Raises DatasetError where the file holds anything else.
    """
    text = _read_note(path)
    gain, pad = _pair(text, "gain", path), _pair(text, "pad", path)
    if not set(pad) <= {0.0, 1.0}:
        wanted, got = "pad 0 or 1 for each channel", f"{pad[0]:g} and {pad[1]:g}"
        raise DatasetError.expected(wanted, pad, got=got, file=path, name="pad")
    return gain[1] - PAD_DB * pad[1]


def read_newtons(path: Path) -> float:
    """Read the peak force of a `striking_force.yaml`, newtons. Raises DatasetError where it holds no force above 0."""
    found = re.findall(rf"\bstriking_force_newtons['\"]?\s*:\s*({_NUMBER})[\s,}}\]]", _read_note(path) + "\n")
    if len(found) != 1 or not 0 < float(found[0]) < math.inf:
        value, got = tuple(map(float, found)), ", ".join(found) or "none"
        key = "striking_force_newtons"
        raise DatasetError.expected(f"one {key} above 0", value, got=got, file=path, name=key)
    return float(found[0])


def _pair(text: str, key: str, path: Path) -> tuple[float, float]:
    # Either `gain: [12, 18]`, or the key alone and below it a line `- 12` for each number.
    flow = rf"\[\s*({_NUMBER})\s*,\s*({_NUMBER})\s*\]"
    block = rf"\n\s*-\s*({_NUMBER})[ \t]*\n\s*-\s*({_NUMBER})(?![ \t]*\n\s*-)"
    found = re.search(rf"^{key}[ \t]*:[ \t]*(?:{flow}|{block})[ \t]*$", text, flags=re.MULTILINE)
    if found is None:
        raise DatasetError.expected(f"{key} with a list of two numbers", text.strip()[:80], file=path, name=key)
    first, second = (float(number) for number in found.groups() if number is not None)
    return first, second


def _read_note(path: Path) -> str:
    try:
        return read_text(path)
    except (OSError, ValueError) as error:
        got = "none" if isinstance(error, FileNotFoundError) else "a file that cannot be read"
        raise DatasetError.expected("a text", got=got, file=path, advice="unpack or download it again") from error
