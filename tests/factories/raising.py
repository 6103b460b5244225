"""Checks of errors and warnings by their type and key values; their wording is free."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from avmsf.errors import AvmsfError, AvmsfWarning


@contextmanager
def raises(kind: type[AvmsfError], **attributes: Any) -> Iterator[pytest.ExceptionInfo[AvmsfError]]:
    """Expect an error of this type whose `row`, `name` and `value` are these; `file` may be the end of a path."""
    with pytest.raises(kind) as caught:
        yield caught
    difference = _difference(caught.value, attributes)
    assert difference is None, f"{difference}: {caught.value}"


@contextmanager
def warns(kind: type[AvmsfWarning], **attributes: Any) -> Iterator[pytest.WarningsRecorder]:
    """Expect a warning of this type whose attributes are these, among the warnings given."""
    with pytest.warns(kind) as caught:
        yield caught
    given = [each.message for each in caught if isinstance(each.message, kind)]
    found = {str(each): _difference(each, attributes) for each in given}
    assert None in found.values(), found


def _difference(found: Any, attributes: dict[str, Any]) -> str | None:
    """Return the first attribute that differs, with both values."""
    for name, expected in attributes.items():
        actual = getattr(found, name)
        if name == "file":
            same = expected is None or (actual is not None and actual.match(str(expected)))
        else:
            same = actual == expected
        if not same:
            return f"{name}: expected {expected!r}, found {actual!r}"
    return None
