"""Checks of errors and warnings by their type and key values; their wording is free."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from avmsf.errors import AvmsfError, AvmsfWarning

_ANY = object()


@contextmanager
def raises(
    kind: type[AvmsfError], *, file: Path | str | None = None, row: Any = _ANY, name: Any = _ANY, value: Any = _ANY
) -> Iterator[pytest.ExceptionInfo[AvmsfError]]:
    """Expect an error of this type whose attributes are these; `file` may be the last parts of a path."""
    with pytest.raises(kind) as caught:
        yield caught
    _compare(caught.value, file, row, name, value)


@contextmanager
def warns(
    kind: type[AvmsfWarning], *, file: Path | str | None = None, row: Any = _ANY, name: Any = _ANY, value: Any = _ANY
) -> Iterator[pytest.WarningsRecorder]:
    """Expect a warning of this type whose attributes are these, among the warnings given."""
    with pytest.warns(kind) as caught:
        yield caught
    given = [each.message for each in caught if isinstance(each.message, kind)]
    for each in given[:-1]:
        if _mismatch(each, file, row, name, value) is None:
            return
    _compare(given[-1], file, row, name, value)


def _compare(
    found: AvmsfError | AvmsfWarning | Warning, file: Path | str | None, row: Any, name: Any, value: Any
) -> None:
    difference = _mismatch(found, file, row, name, value)
    assert difference is None, f"{difference}: {found}"


def _mismatch(found: Any, file: Path | str | None, row: Any, name: Any, value: Any) -> str | None:
    """Return the first attribute that differs, with both values."""
    if file is not None and (found.file is None or not found.file.match(str(file))):
        return f"file: expected {file}, found {found.file}"
    for attribute, expected in (("row", row), ("name", name), ("value", value)):
        actual = getattr(found, attribute)
        if expected is not _ANY and actual != expected:
            return f"{attribute}: expected {expected!r}, found {actual!r}"
    return None
