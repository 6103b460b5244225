"""Names and materials of ObjectFolder Real's objects: by RealImpact's names, or by the published list."""

import csv
import io
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avmsf._utils.text_files import parse_json, read_text
from avmsf.capture.datasets.dataset import ObjectFacts
from avmsf.capture.datasets.numbering import (
    REALIMPACT_NAMES,
    folder_number,
    material_in,
    number_of,
    realimpact_name,
)
from avmsf.errors import DatasetError

_NUMBER_COLUMNS = ("id", "index")
_HOW_TO_WRITE = (
    "expected a CSV file with the header id,name,material and one row an object, or a JSON list of objects with these "
    "keys"
)


@dataclass(frozen=True)
class _Entry:
    """One object of a list."""

    number: int
    name: str
    material: str | None


def read_names(path: Path, present: Collection[int]) -> dict[int, ObjectFacts]:
    """Read a list of objects and return what it tells, by the numbers of the folders.

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
            raise DatasetError(f"{path}: object {entry.number} stands there twice: leave one row of it")
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
        rows = _json_rows(parse_json(text)) if path.suffix.lower() == ".json" else _csv_rows(text)
    except FileNotFoundError as error:
        raise DatasetError(f"{path}: there is no such list of objects; {_HOW_TO_WRITE}") from error
    except (OSError, ValueError, csv.Error) as error:
        raise DatasetError(f"{path}: not a list of objects that can be read ({error}); {_HOW_TO_WRITE}") from error
    if not rows:
        raise DatasetError(f"{path}: the list is empty; {_HOW_TO_WRITE}")
    return [_entry(row, f"{path} {where}") for where, row in rows]


def _csv_rows(text: str) -> list[tuple[str, dict[str, Any]]]:
    reader = csv.DictReader(io.StringIO(text))
    return [(f"line {reader.line_num}", dict(row)) for row in reader]


def _json_rows(value: Any) -> list[tuple[str, dict[str, Any]]]:
    if not isinstance(value, list) or not all(isinstance(row, dict) for row in value):
        raise ValueError("no list of objects")
    return [(f"object {place}", row) for place, row in enumerate(value, start=1)]


def _entry(row: Mapping[str, Any], where: str) -> _Entry:
    cells = {str(key).strip().lower(): "" if value is None else str(value).strip() for key, value in row.items()}
    number = next((cells[key] for key in _NUMBER_COLUMNS if key in cells), None)
    if number is None or "name" not in cells:
        raise DatasetError(f"{where}: found the columns {', '.join(cells)}; {_HOW_TO_WRITE}")
    if not (number.isascii() and number.isdecimal() and int(number) > 0) or not cells["name"]:
        raise DatasetError(
            f"{where}: id is {number!r} and name {cells['name']!r}; expected a whole number above 0 and a name"
        )
    return _Entry(int(number), cells["name"].replace("_", " "), cells.get("material", "").lower() or None)
