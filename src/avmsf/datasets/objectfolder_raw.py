"""ObjectFolder Real as it is published: a folder a contact, with the microphone, the hammer's force and two notes."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from avmsf.capture.audio import Recording, read_recording
from avmsf.capture.folder import Capture
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.together import find_surface
from avmsf.datasets.annotations import Gains, read_gains, read_newtons
from avmsf.datasets.contact_lists import Contacts, find_contacts, read_contacts
from avmsf.datasets.dataset import DatasetReport, Look, ObjectFacts, ObjectReport
from avmsf.datasets.meshes import find_mesh, mesh_folders
from avmsf.datasets.names import facts_of, read_names
from avmsf.datasets.numbering import in_order, number_of, refuse_unknown, shared_remarks
from avmsf.datasets.recordings import Blow, gather, judge_wav, refuse_few
from avmsf.errors import CaptureError, DatasetError

RATE = 48_000.0
"""Of all recordings of ObjectFolder Real, Hz."""
FRAMES = 288_000
"""Of each recording: 6 s, one of them before the blow."""
DOWNLOAD = "https://download.cs.stanford.edu/viscam/ObjectFolder_Real"
SETTINGS = CaptureSettings(force_channel=1, response_channel=2, normalize="peak")


@dataclass(frozen=True)
class _Strike:
    """A contact's folder that can be used."""

    contact: str
    folder: Path
    newtons: float
    gains: Gains | None
    """None where the note is missing."""


class ObjectFolderRaw:
    """ObjectFolder Real, unpacked from its audio archives: `<object>/audio/<contact>/mic.wav` and so on.

    The archives hold no contacts. `contacts` names a folder of arrays or one of SonicGauss's lists (`read_contacts`);
    by default they are sought in the folder and its parent. `table` is a list of the objects' names and materials
    (`read_names`). Meshes are found in the folder or its parent (`find_mesh`).

    Sounds start at the force's onset, or with `time_zero` "peak" at their peaks, as in the paper. They are divided by
    the peak force in newtons and by the recorder's gain, so that one is the microphone's full scale at 0 dB of gain,
    per newton.
    """

    name = "ObjectFolder Real"

    def __init__(
        self,
        folder: str | Path,
        *,
        contacts: str | Path | None = None,
        table: str | Path | None = None,
        time_zero: str | None = None,
    ) -> None:
        self.folder = Path(folder)
        self._settings = SETTINGS.starting(time_zero)
        self._given_contacts = None if contacts is None else Path(contacts)
        self._table = None if table is None else Path(table)

    def objects(self) -> tuple[str, ...]:
        """Return the numbers of all objects with recordings, in their order."""
        return tuple(self._folders)

    def facts(self, identifier: str) -> ObjectFacts:
        """Return what is known of an object. Raises DatasetError for an unknown one."""
        self._expect(identifier)
        return facts_of(identifier, self._names)

    def capture(self, identifier: str) -> Capture:
        """Read one object's recordings, in the order of their numbers. Raises DatasetError for an unknown object, and
        where fewer than two recordings can be used; a warning names those that were left out."""
        self._expect(identifier)
        strikes, problems = self._examine(identifier)
        origin = f"{self.name}, object {identifier}"
        refuse_few(len(strikes), origin=origin, reasons=problems or [self._no_contacts])
        look = self.look(identifier)
        try:
            surface = None if look is None else find_surface(look.folder, look.settings)
        except CaptureError as error:
            raise DatasetError(f"{origin}: {error}", **error.attributes) from error
        return gather(
            self._blows(identifier, strikes),
            name=self.facts(identifier).name,
            origin=origin,
            settings=self._settings,
            surface=surface,
            remarks=problems,
        )

    def look(self, identifier: str) -> Look | None:
        """Return the object's scanned mesh; None where the meshes' archive was not unpacked here."""
        self._expect(identifier)
        return find_mesh(self.folder, identifier)

    def check(self) -> DatasetReport:
        """Report which files are there and which are missing, from names and headers alone."""
        reports = []
        for identifier in self.objects():
            strikes, problems = self._examine(identifier)
            reports.append(ObjectReport(self.facts(identifier), len(strikes), tuple(problems)))
        missing = []
        if self._contacts is None:
            missing.append(self._no_contacts)
        if not mesh_folders(self.folder):
            missing.append(f"meshes, the only visual input: unpack {DOWNLOAD}/mesh/mesh_16k.tar.gz in {self.folder}")
        return DatasetReport(self.name, tuple(reports), (*missing, *self._missing_archives()), self._remarks())

    @cached_property
    def _folders(self) -> dict[str, Path]:
        """The `audio` folder of each object."""
        found = {path.name: path / "audio" for path in self.folder.iterdir() if path.name.isdecimal()}
        return {name: found[name] for name in in_order(found) if any(found[name].glob("[0-9]*/*.wav"))}

    @cached_property
    def _contacts(self) -> Contacts | None:
        if self._given_contacts is not None:
            return read_contacts(self._given_contacts)
        return find_contacts(self.folder)

    @cached_property
    def _names(self) -> dict[int, ObjectFacts]:
        present = {int(name) for name in self._folders}
        return {} if self._table is None else read_names(self._table, present)

    @property
    def _no_contacts(self) -> str:
        return (
            f"contact coordinates, which the audio archives do not hold: put contacts/OBJECT/CONTACT.npy of the "
            f"contact-localization benchmark, or SonicGauss's objectfolder_real_train.json and _val.json, into "
            f"{self.folder} or its parent"
        )

    def _expect(self, identifier: str) -> None:
        if identifier not in self._folders:
            refuse_unknown(identifier, self._folders, self.name)

    def _examine(self, identifier: str) -> tuple[list[_Strike], list[str]]:
        """Return the usable recordings, and a message for each problem or assumption."""
        strikes, problems, unknown_gains = [], [], []
        for folder in sorted(
            self._folders[identifier].iterdir(), key=lambda path: (number_of(path.name) or 0, path.name)
        ):
            contact = folder.name
            if not folder.is_dir() or contact.startswith(".") or contact.endswith("_deprecated"):
                continue
            if not contact.isdecimal():
                problems.append(f"audio/{contact}: expected a contact's number as name; it is left out")
                continue
            wrong = self._judge(identifier, contact, folder)
            if wrong:
                problems += wrong
                continue
            gains = None
            if (folder / "metadata.yaml").is_file():
                gains = read_gains(folder / "metadata.yaml")
            else:
                unknown_gains.append(contact)
            strikes.append(_Strike(contact, folder, read_newtons(folder / "striking_force.yaml"), gains))
        if unknown_gains:
            assumed = _usual_gain(strikes)
            taken = "0 dB" if assumed is None else f"{assumed}, the most frequent of the object's recordings"
            problems.append(
                f"metadata.yaml is missing for contact {', '.join(unknown_gains)}: the recorder's gain is assumed to "
                f"be {taken}"
            )
        return strikes, problems

    def _judge(self, identifier: str, contact: str, folder: Path) -> list[str]:
        """Return why a contact's recording cannot be used, a message for each reason."""
        shown = f"{identifier}/audio/{contact}"
        wrong = [
            judge_wav(folder / name, shown=f"{shown}/{name}", rate=RATE, frames=FRAMES)
            for name in ("mic.wav", "Force.wav")
        ]
        for name, read in (("metadata.yaml", read_gains), ("striking_force.yaml", read_newtons)):
            path = folder / name
            if path.is_file():
                try:
                    read(path)
                except DatasetError as error:
                    wrong.append(error)
            elif read is read_newtons:
                wrong.append(DatasetError(f"{shown}/{name}: expected a file, got none; unpack it again", file=path))
        if self._contacts is not None:
            wrong.append(self._contacts.judge(identifier, contact))
        elif not any(wrong):
            wrong.append(DatasetError(f"{shown}: expected contact coordinates, got none", file=folder))
        return [str(error) for error in wrong if error is not None]

    def _blows(self, identifier: str, strikes: list[_Strike]) -> Iterator[Blow]:
        usual = _usual_gain(strikes)
        assert self._contacts is not None  # without contacts no strike can be used
        for strike in strikes:
            force, sound = (read_recording(strike.folder / name) for name in ("Force.wav", "mic.wav"))
            frames = min(force.frames, sound.frames)
            gains = strike.gains or usual
            yield Blow(
                name=f"{strike.contact}.wav",
                recording=Recording(
                    f"{identifier}/audio/{strike.contact}/mic.wav",
                    np.stack([force.channels[0, :frames], sound.channels[0, :frames]]),
                    sound.sample_rate,
                    sound.subtype,
                ),
                contact=self._contacts.place(identifier, strike.contact),
                newtons=strike.newtons,
                gain_db=0.0 if gains is None else gains.microphone_db,
            )

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

    def _remarks(self) -> tuple[str, ...]:
        remarks = []
        if self._contacts is not None:
            remarks.append(f"contacts are read from {self._contacts}")
        remarks += shared_remarks(self.objects(), "RealImpact")
        if self._table is None:
            remarks.append("names are inferred from RealImpact's numbers; --table adds the published list")
        return tuple(remarks)


def _usual_gain(strikes: list[_Strike]) -> Gains | None:
    """Return the commonest gain, the first of several; None where none is known."""
    known = Counter(strike.gains for strike in strikes if strike.gains is not None)
    return known.most_common(1)[0][0] if known else None
