"""Names and materials of ObjectFolder Real's objects: by RealImpact's names, or by the published list."""

import csv
import io
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avmsf._utils.text_files import parse_json, read_text
from avmsf.datasets.dataset import ObjectFacts
from avmsf.datasets.numbering import REALIMPACT_NAMES, folder_number, material_in, number_of, realimpact_name
from avmsf.errors import DatasetError

_NUMBER_COLUMNS = ("id", "index")
_EXPECTED = "a CSV file with the header id,name,material, or a JSON list of objects with these keys"


@dataclass(frozen=True)
class _Entry:
    """One object of a list."""

    row: int
    """Line of a CSV file, from 1, or index in a JSON list."""
    number: int
    name: str
    material: str | None


def read_names(path: Path, present: Collection[int]) -> dict[int, ObjectFacts]:
    """Read a list of objects and return their names and materials, by the numbers of the folders.

    `path` is a CSV file with the header `id,name,material` or a JSON list of such objects (`index` serves for `id`,
    the material may be left empty). Numbers up to 100 are taken for those of the published list, which has no gaps,
    and mapped to the folders' (`folder_number`, inferred); where one is greater they are the folders' already.
    `present` are the folders' numbers there are. Raises DatasetError for a file that cannot be read so.
    """
    entries = _entries(path)
    of_folders = any(entry.number > 100 for entry in entries)
    facts: dict[int, ObjectFacts] = {}
    for entry in entries:
        number = entry.number if of_folders else folder_number(entry.number, present)
        if number is None:
            continue
        if number in facts:
            raise DatasetError(
                f"{path}, row {entry.row}: expected each object once, got {entry.number} again; delete one row",
                file=path,
                row=entry.row,
                name="id",
                value=entry.number,
            )
        facts[number] = ObjectFacts(str(number), entry.name, entry.material, inferred=not of_folders)
    return facts


def facts_of(identifier: str, listed: Mapping[int, ObjectFacts]) -> ObjectFacts:
    """Return what is known of an object of ObjectFolder Real, from a list that was read or else from RealImpact."""
    number = number_of(identifier)
    if number is None:
        return ObjectFacts(identifier, identifier)
    if number in listed:
        return listed[number]
    name = realimpact_name(number)
    if name is None:
        return ObjectFacts(identifier, identifier)
    folder = next(each for each in REALIMPACT_NAMES if number_of(each) == number)
    return ObjectFacts(identifier, name, material_in(folder), inferred=True)


def _entries(path: Path) -> list[_Entry]:
    try:
        text = read_text(path)
        records = _json_records(parse_json(text)) if path.suffix.lower() == ".json" else _csv_records(text)
    except FileNotFoundError as error:
        raise DatasetError.expected(_EXPECTED, got="no such file", file=path, advice="check the path") from error
    except (OSError, ValueError, csv.Error) as error:
        raise DatasetError.expected(_EXPECTED, got=str(error), file=path) from error
    if not records:
        raise DatasetError.expected(_EXPECTED, 0, got="no entry", file=path)
    return [_entry(record, path, row) for row, record in records]


def _csv_records(text: str) -> list[tuple[int, dict[str, Any]]]:
    reader = csv.DictReader(io.StringIO(text))
    return [(reader.line_num, dict(record)) for record in reader]


def _json_records(value: Any) -> list[tuple[int, dict[str, Any]]]:
    if not isinstance(value, list) or not all(isinstance(record, dict) for record in value):
        raise ValueError("no list of objects")
    return list(enumerate(value))


def _entry(record: Mapping[str, Any], path: Path, row: int) -> _Entry:
    cells = {str(key).strip().lower(): "" if value is None else str(value).strip() for key, value in record.items()}
    number = next((cells[key] for key in _NUMBER_COLUMNS if key in cells), None)
    if number is None or "name" not in cells:
        raise DatasetError.expected(_EXPECTED, tuple(cells), got=", ".join(cells), file=path, row=row)
    if not (number.isascii() and number.isdecimal() and int(number) > 0) or not cells["name"]:
        raise DatasetError(
            f"{path}, row {row}: expected an id above 0 and a name, got {number!r} and {cells['name']!r}",
            file=path,
            row=row,
            value=(number, cells["name"]),
        )
    return _Entry(row, int(number), cells["name"].replace("_", " "), cells.get("material", "").lower() or None)
