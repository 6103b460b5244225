"""The header of a safetensors file and the JSON in it, read without torch, which takes seconds to load."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from avmsf._utils.text import parse_json
from avmsf.errors import AvmsfError

FEATURES_KEY = "avmsf_features"
"""Entry of a file's metadata that holds the record of features."""


@dataclass(frozen=True)
class FileKind:
    """One kind of safetensors file: the entry of its metadata that holds its text, and what its errors say."""

    key: str
    what: str
    advice: str
    """What to do in place of a file that cannot be read."""
    error: type[AvmsfError]
    formats: tuple[int, ...] = ()
    """Numbers of the formats that are read, of which the last one is written. A number grows with every change that
    older versions could not read."""

    def read_text(self, path: Path) -> str:
        """Return the text of a file. Raises `error` for one that is missing, damaged or of another kind."""
        if not path.exists():
            advice = f"check the name, or {self.advice}"
            raise self.error.expected(self.what, got="no such file", file=path, advice=advice)
        try:
            metadata = read_metadata(path)
        except (OSError, ValueError) as error:
            raise self.unreadable(path) from error
        if self.key not in metadata:
            wanted, got = f"{self.what} with the metadata entry {self.key!r}", "another safetensors file"
            advice = f"name another, or {self.advice}"
            raise self.error.expected(wanted, sorted(metadata), got=got, file=path, name=self.key, advice=advice)
        return metadata[self.key]

    def parse(
        self, text: str, path: Path, check: Callable[[dict[str, Any]], object] = lambda _: None
    ) -> dict[str, Any]:
        """Return the record that a file's text is, JSON with a `format` and the `version` that wrote it.

        `check` raises ValueError, TypeError or KeyError for a record whose entries are not those of the formats.
        Raises `error` for such records, and for those in another format.
        """
        try:
            record = parse_json(text)
            found, writer = record["format"], record["version"]
            if found in self.formats:
                check(record)
                return dict(record)
            advice = self.advice
            if isinstance(found, int) and found > max(self.formats):
                advice = f"install avmsf {writer} or newer, or {advice}"
        except (ValueError, TypeError, KeyError) as error:
            raise self.damaged(path, error, name="header") from error
        wanted = f"{self.what} in format {' or '.join(map(str, self.formats))}"
        got = f"format {found}, written by avmsf {writer} (this is avmsf {version('avmsf')})"
        raise self.error.expected(wanted, found, got=got, file=path, name="format", advice=advice)

    def to_text(self, record: Mapping[str, Any], path: Path, *, name: str) -> str:
        """Return a record as JSON, with its format and version.

        Raises `error` for what JSON does not hold, which came in the entry `name`.
        """
        try:
            return json.dumps({"format": self.formats[-1], "version": version("avmsf"), **record}, allow_nan=False)
        except (TypeError, ValueError) as error:
            wanted, got = "finite numbers, text, lists and dicts", f"other values ({error})"
            raise self.error.expected(wanted, str(error), got=got, file=path, name=name) from error

    def unreadable(self, path: Path) -> AvmsfError:
        """Return the error of a file that safetensors cannot read."""
        found = "a folder" if path.is_dir() else "another, an unreadable or a damaged file"
        advice = f"check its name and permissions, or {self.advice}"
        return self.error.expected(self.what, found, got=found, file=path, advice=advice)

    def damaged(self, path: Path, error: Exception, *, name: str | None = None) -> AvmsfError:
        """Return the error of a file whose record or tensors raised another one, about `name` if that names nothing."""
        value = None
        if isinstance(error, AvmsfError):
            name, value = error.name or name, error.value
        elif isinstance(error, KeyError):
            name = str(error.args[0])
        got = f"another or a damaged one ({type(error).__name__}: {error})"
        return self.error.expected(self.what, value, got=got, file=path, name=name, advice=self.advice)


def read_metadata(path: Path) -> dict[str, str]:
    """Return the metadata of a safetensors file. Raises OSError or ValueError where there is none to read."""
    try:
        # Of the frameworks that safetensors knows, numpy takes the least time to import.
        with safe_open(path, framework="numpy") as file:
            return dict(file.metadata() or {})
    except SafetensorError as error:
        raise ValueError(str(error)) from error
