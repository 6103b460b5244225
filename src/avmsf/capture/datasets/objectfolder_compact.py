"""ObjectFolder Real as its contact-localization benchmark copies it: 53 objects, no forces, a split of its own."""

import math
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from avmsf._utils.text_files import read_json
from avmsf.capture.audio import read_recording
from avmsf.capture.datasets.arrays import ArrayForm, judge_array, read_array
from avmsf.capture.datasets.blows import Blow, gather, judge_wav, listed, refuse_few
from avmsf.capture.datasets.contactlists import ContactFolder
from avmsf.capture.datasets.dataset import DatasetReport, Look, ObjectFacts, ObjectReport
from avmsf.capture.datasets.meshes import find_mesh
from avmsf.capture.datasets.names import facts_of, read_names
from avmsf.capture.datasets.numbering import in_order, refuse_unknown, shared_remarks
from avmsf.capture.datasets.objectfolder_raw import FRAMES, RATE
from avmsf.capture.datasets.signs import PARTS
from avmsf.capture.folder import Capture
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.surface import Surface, find_surface
from avmsf.errors import CaptureError, DatasetError

POINTS = ArrayForm("float64", (1024, 3))
SETTINGS = CaptureSettings(normalize="none")
SPLITS = ("train", "val", "test")


class ObjectFolderCompact:
    """The compact copy: `audio/<object>/<contact>.wav` with `contacts/<object>/<contact>.npy`.

    There is no force, so sounds start where they exceed the noise, or with `time_zero` "peak" at their peaks, and keep
    their recorded level: impacts of another force and recordings of another gain differ in level. The surface is a mesh
    where there is one in the folder or next to it (`find_mesh`), else the copy's own 1,024 points. `table` is a list of
    names (`read_names`).
    """

    name = "ObjectFolder Real (compact)"

    def __init__(self, folder: str | Path, *, table: str | Path | None = None, time_zero: str | None = None) -> None:
        self.folder = Path(folder)
        self._settings = SETTINGS.starting(time_zero)
        self._table = None if table is None else Path(table)

    def objects(self) -> tuple[str, ...]:
        """Return the numbers of all objects with recordings, in their order."""
        audio = self.folder / "audio"
        found = [path.name for path in audio.iterdir() if path.name.isdecimal()] if audio.is_dir() else []
        return in_order(name for name in found if any((audio / name).glob("*.wav")))

    def facts(self, identifier: str) -> ObjectFacts:
        """Return what is known of an object. Raises DatasetError for an unknown one."""
        self._expect(identifier)
        return facts_of(identifier, self._names)

    def capture(self, identifier: str) -> Capture:
        """Read one object's recordings, in the order of their numbers.

        Raises DatasetError for an unknown object, where split.json names recordings that are not there, and where fewer
        than two can be used; a warning names those that were left out.
        """
        self._expect(identifier)
        contacts, problems, lost = self._examine(identifier)
        origin = f"{self.name}, object {identifier}"
        if lost:
            raise DatasetError(
                f"{origin}: expected the {len(lost)} recordings {listed(lost)} of split.json, got none of them; unpack "
                "audio.tar.gz again",
                file=self.folder / "split.json",
                name=identifier,
                value=lost,
            )
        refuse_few(len(contacts), origin=origin, reasons=problems)
        return gather(
            self._blows(identifier, contacts),
            name=self.facts(identifier).name,
            origin=origin,
            settings=self._settings,
            surface=self._surface(identifier, origin),
            remarks=problems,
        )

    def look(self, identifier: str) -> Look | None:
        """Return the object's mesh, if the meshes of ObjectFolder Real were unpacked in this folder or next to it."""
        self._expect(identifier)
        return find_mesh(self.folder, identifier)

    def split(self, identifier: str) -> dict[str, tuple[str, ...]]:
        """Return the benchmark's own split of an object, names of recordings under `train`, `val` and `test`.

        Raises DatasetError where split.json is missing or malformed, or gives one recording to two parts.
        """
        self._expect(identifier)
        return {
            part: tuple(f"{contact}.wav" for owner, contact in pairs if owner == identifier)
            for part, pairs in self._splits.items()
        }

    def size(self, identifier: str) -> float:
        """Return the object's size of scale.json, the denominator of the benchmark's contact error.

        Raises DatasetError where there is none.
        """
        self._expect(identifier)
        value = self._json("scale.json").get(identifier)
        if not isinstance(value, int | float) or not 0 < value < math.inf:
            raise DatasetError.expected(
                f"the size of object {identifier}, above 0", value, file=self.folder / "scale.json", name=identifier
            )
        return float(value)

    def check(self) -> DatasetReport:
        """Report which files are there and which are missing, from names and headers alone."""
        reports = []
        for identifier in self.objects():
            contacts, problems, lost = self._examine(identifier)
            named = [f"{file}: expected a file, as split.json lists it, got none" for file in lost]
            reports.append(ObjectReport(self.facts(identifier), len(contacts), (*named, *problems)))
        missing = [
            f"{part}: unpack {part}.tar.gz of the contact-localization benchmark in {self.folder}"
            if "." not in part
            else f"{part}: download it from the contact-localization benchmark into {self.folder}"
            for part in PARTS
            if not (self.folder / part).exists()
        ]
        without = in_order(
            {owner for pairs in self._splits_if_any.values() for owner, _ in pairs} - set(self.objects())
        )
        if without:
            missing.append(f"recordings of objects {', '.join(without)} of split.json: unpack audio.tar.gz again")
        return DatasetReport(self.name, tuple(reports), tuple(missing), self._remarks())

    @cached_property
    def _names(self) -> dict[int, ObjectFacts]:
        present = {int(name) for name in self.objects()}
        return {} if self._table is None else read_names(self._table, present)

    @cached_property
    def _splits(self) -> dict[str, list[tuple[str, str]]]:
        path = self.folder / "split.json"
        table = self._json("split.json")
        splits: dict[str, list[tuple[str, str]]] = {}
        owner: dict[tuple[str, str], str] = {}
        for part in SPLITS:
            pairs = table.get(part)
            if not isinstance(pairs, list) or not all(isinstance(pair, list) and len(pair) == 2 for pair in pairs):
                raise DatasetError(
                    f"{path}: expected {part} with a list of [object, contact], got {type(pairs).__name__}; download "
                    "it again",
                    file=path,
                    name=part,
                    value=type(pairs).__name__,
                )
            splits[part] = [(str(pair[0]), str(pair[1])) for pair in pairs]
            for pair in splits[part]:
                if owner.setdefault(pair, part) != part:
                    raise DatasetError(
                        f"{path}: expected disjoint parts, got contact {pair[1]} of object {pair[0]} in {owner[pair]} "
                        f"and {part}; download the file again",
                        file=path,
                        name=part,
                        value=pair,
                    )
        return splits

    @property
    def _splits_if_any(self) -> dict[str, list[tuple[str, str]]]:
        return self._splits if (self.folder / "split.json").is_file() else {}

    def _json(self, name: str) -> dict[str, Any]:
        path = self.folder / name
        try:
            value = read_json(path)
        except FileNotFoundError as error:
            raise DatasetError.expected(
                "a file", file=path, advice="download it from the contact-localization benchmark"
            ) from error
        except (OSError, ValueError) as error:
            raise DatasetError(f"{path}: expected a JSON file, got {error}; download it again", file=path) from error
        if not isinstance(value, dict):
            raise DatasetError(
                f"{path}: expected a JSON object, got a {type(value).__name__}; download it again",
                file=path,
                value=type(value).__name__,
            )
        return value

    def _expect(self, identifier: str) -> None:
        if identifier not in self.objects():
            if not self.objects():
                raise DatasetError.expected("recordings", file=self.folder, advice="unpack audio.tar.gz there")
            refuse_unknown(identifier, self.objects(), self.name)

    def _examine(self, identifier: str) -> tuple[list[str], list[str], list[str]]:
        """Return the usable contacts, the problems of the others, and the missing recordings of the split."""
        folder = self.folder / "audio" / identifier
        places = ContactFolder(self.folder / "contacts")
        present = in_order(path.stem for path in folder.glob("*.wav"))
        contacts, problems = [], []
        for contact in present:
            shown = f"audio/{identifier}/{contact}.wav"
            wrong = judge_wav(folder / f"{contact}.wav", shown=shown, rate=RATE, frames=FRAMES)
            wrong = wrong or places.judge(identifier, contact)
            if wrong is not None:
                problems.append(str(wrong))
            else:
                contacts.append(contact)
        cloud = self._points_path(identifier)
        if cloud.parent.is_dir():
            wrong = judge_array(cloud, POINTS, shown=f"global_gt_points/{identifier}.npy")
            problems += [] if wrong is None else [str(wrong)]
        named = [contact for pairs in self._splits_if_any.values() for owner, contact in pairs if owner == identifier]
        lost = [f"audio/{identifier}/{contact}.wav" for contact in in_order(set(named) - set(present))]
        return contacts, problems, lost

    def _blows(self, identifier: str, contacts: list[str]) -> Iterator[Blow]:
        places = ContactFolder(self.folder / "contacts")
        for contact in contacts:
            file = f"audio/{identifier}/{contact}.wav"
            recording = read_recording(self.folder / file, file)
            yield Blow(f"{contact}.wav", recording, places.place(identifier, contact))

    def _surface(self, identifier: str, origin: str) -> Surface | None:
        look = self.look(identifier)
        if look is not None:
            try:
                return find_surface(look.folder, look.settings)
            except CaptureError as error:
                raise DatasetError(f"{origin}: {error}", **error.attributes) from error
        path = self._points_path(identifier)
        if judge_array(path, POINTS, shown=path.name) is not None:
            return None
        points = read_array(path, POINTS, shown=path.name)
        return Surface(torch.from_numpy(points.astype(np.float32)), torch.zeros(0, 3, dtype=torch.int64))

    def _points_path(self, identifier: str) -> Path:
        return self.folder / "global_gt_points" / f"{identifier}.npy"

    def _remarks(self) -> tuple[str, ...]:
        forces = "no forces: sounds keep their recorded level, which depends on the impact's force and the gain"
        return (forces, *shared_remarks(self.objects(), "RealImpact"))
