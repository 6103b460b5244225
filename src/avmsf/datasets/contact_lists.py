"""The contacts of ObjectFolder Real: from a folder of small arrays, or from SonicGauss's lists."""

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from avmsf._utils.text_files import parse_json, read_text
from avmsf.datasets.arrays import ArrayForm, judge_array, read_array
from avmsf.errors import DatasetError

CONTACT = ArrayForm("float64", (3,))
LISTS = ("objectfolder_real_train.json", "objectfolder_real_val.json")
FOLDER = "contacts"
_RECORDING = re.compile(r"(?:^|/)(\d+)_(\d+)_[^/]*\.wav$")


@dataclass(frozen=True, eq=False)
class ContactFolder:
    """Contacts as arrays: `<object>/<contact>.npy` below one folder."""

    folder: Path

    def objects(self) -> set[str]:
        """Return the numbers of the objects with contacts."""
        return {path.name for path in self.folder.iterdir() if path.name.isdecimal() and path.is_dir()}

    def judge(self, identifier: str, contact: str) -> DatasetError | None:
        """Return the error of a contact that cannot be used, or None."""
        shown = f"{FOLDER}/{identifier}/{contact}.npy"
        path = self._path(identifier, contact)
        wrong = judge_array(path, CONTACT, shown=shown)
        if wrong is None and not np.isfinite(read_array(path, CONTACT, shown=shown)).all():
            return DatasetError(f"{shown}: expected finite coordinates, got NaN or inf", file=path, name=contact)
        return wrong

    def place(self, identifier: str, contact: str) -> Float64[np.ndarray, " 3"]:
        """Return a contact, meters in the mesh's frame. Raises DatasetError for one that is missing or malformed."""
        return read_array(self._path(identifier, contact), CONTACT, shown=f"{FOLDER}/{identifier}/{contact}.npy")

    def __str__(self) -> str:
        return str(self.folder)

    def _path(self, identifier: str, contact: str) -> Path:
        return self.folder / identifier / f"{contact}.npy"


@dataclass(frozen=True, eq=False)
class ContactLists:
    """Contacts as SonicGauss's lists have them, all read at once."""

    files: tuple[Path, ...]
    places: Mapping[tuple[str, str], tuple[float, float, float]] = field(init=False)
    """By object and contact."""

    def __post_init__(self) -> None:
        places: dict[tuple[str, str], tuple[float, float, float]] = {}
        for path in self.files:
            for row, record in _records(path):
                key, place = _understand(record, path, row)
                if places.setdefault(key, place) != place:
                    raise DatasetError(
                        f"{path}, row {row}: expected one position of contact {key[1]} of object {key[0]}, got {place} "
                        f"and {places[key]}; delete one",
                        file=path,
                        row=row,
                        name=key[1],
                        value=place,
                    )
        object.__setattr__(self, "places", places)

    def objects(self) -> set[str]:
        """Return the numbers of the objects with contacts."""
        return {identifier for identifier, _ in self.places}

    def judge(self, identifier: str, contact: str) -> DatasetError | None:
        """Return the error of a contact that is in none of the lists, or None."""
        if (identifier, contact) in self.places:
            return None
        return DatasetError(
            f"object {identifier}: expected contact {contact} in {', '.join(path.name for path in self.files)}, "
            "got none",
            file=self.files[0],
            name=contact,
        )

    def place(self, identifier: str, contact: str) -> Float64[np.ndarray, " 3"]:
        """Return a contact, meters in the mesh's frame. Raises DatasetError for one that is not listed."""
        wrong = self.judge(identifier, contact)
        if wrong is not None:
            raise wrong
        return np.array(self.places[identifier, contact])

    def __str__(self) -> str:
        return ", ".join(str(path) for path in self.files)


Contacts = ContactFolder | ContactLists


def read_contacts(given: Path) -> Contacts:
    """Return the contacts of a folder of arrays, of a folder that holds one or lists, or of one list.

    Raises DatasetError for a path that is none of these.
    """
    if given.is_file():
        return ContactLists((given,))
    found = _look_in(given, bare=True)
    if found is None:
        raise DatasetError(
            f"{given}: expected a folder with OBJECT/CONTACT.npy, with {FOLDER}/ or with {' and '.join(LISTS)}, or one "
            f"of these lists, got {'a folder without them' if given.is_dir() else 'no file or folder'}",
            file=given,
            name="contacts",
        )
    return found


def find_contacts(folder: Path) -> Contacts | None:
    """Return the contacts that lie in the folder, beside it, or in a folder beside it; None where there are none."""
    beside = folder.resolve().parent
    others = sorted(path for path in beside.iterdir() if path.name[0] != "." and os.access(path, os.R_OK | os.X_OK))
    return next((found for place in (folder, beside, *others) if (found := _look_in(place)) is not None), None)


def _look_in(folder: Path, *, bare: bool = False) -> Contacts | None:
    """Return the contacts in a folder; with `bare` its arrays too, whatever it is called."""
    lists = tuple(folder / name for name in LISTS if (folder / name).is_file())
    for arrays in (folder / FOLDER, folder):
        if (bare or arrays != folder) and any(arrays.glob("[0-9]*/[0-9]*.npy")):
            return ContactFolder(arrays)
    return ContactLists(lists) if lists else None


def _records(path: Path) -> Iterator[tuple[int, Any]]:
    """Yield a list's records with their rows: indices of one JSON list, or lines, from 1, with an object each."""
    try:
        text = read_text(path)
        if text.lstrip().startswith("["):
            yield from enumerate(parse_json(text))
            return
        for number, line in enumerate(text.splitlines(), start=1):
            if line.strip():
                yield number, parse_json(line)
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: expected a JSON list of contacts, got {error}", file=path) from error


def _understand(record: Any, path: Path, row: int) -> tuple[tuple[str, str], tuple[float, float, float]]:
    location = record.get("location") if isinstance(record, dict) else None
    found = _RECORDING.search(location) if isinstance(location, str) else None
    if found is None:
        raise DatasetError.expected(
            "a location that ends in OBJECT_CONTACT_3sec_48000hz.wav", location, file=path, row=row, name="location"
        )
    contact = record.get("contact")
    numbers = isinstance(contact, list) and all(type(value) in (int, float) for value in contact)
    if not numbers or len(contact) != 3 or not np.isfinite(contact).all():
        raise DatasetError.expected("a contact of three numbers, meters", contact, file=path, row=row, name="contact")
    x, y, z = map(float, contact)
    return (str(int(found[1])), str(int(found[2]))), (x, y, z)
