"""The message that errors compose from their attributes."""

import pytest

from avmsf.errors import CaptureError, FitError


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (FitError.expected("1 or more", 0, name="count"), "count: expected 1 or more, got 0"),
        (
            FitError.expected("more than 0", 0.1 + 0.2, row=2, name="scale"),
            "scale, row 2: expected more than 0, got 0.3",
        ),
        (FitError.expected("cpu or cuda", "", name="device", advice="x"), "device: expected cpu or cuda, got ''; x"),
        (
            CaptureError.expected("a file", got="a folder", file="a.wav", name="file"),
            "a.wav: expected a file, got a folder",
        ),
    ],
)
def test_the_message_says_where_what_was_expected_and_what_was_found(error, message):
    assert str(error) == message


def test_what_is_expected_and_found_is_an_attribute_too():
    error = CaptureError.expected("a number", "left", file="impacts.csv", row=3, name="x", advice="correct it")
    assert type(error) is CaptureError
    assert {**error.attributes, "file": str(error.file)} == {
        "file": "impacts.csv",
        "row": 3,
        "name": "x",
        "value": "left",
    }
