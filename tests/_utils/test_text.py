"""Texts of others are read whole, or refused by `ValueError`, whatever they hold."""

import math
from pathlib import Path

import pytest

from avmsf._utils.text import MAX_TOML_BYTES, format_number, parse_json, read_json, read_text, read_toml


def test_line_ends_and_marks_do_not_matter(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    path.write_bytes(b"\xef\xbb\xbfa\r\nb\rc\n")
    assert read_text(path) == "a\nb\nc\n"


def test_length_is_bounded_whatever_the_file_says_of_it(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    path.write_text("x" * 10)
    assert read_text(path, max_bytes=10) == "x" * 10
    with pytest.raises(ValueError) as caught:
        read_text(path, max_bytes=9)
    assert "9" in str(caught.value)
    # A device has no size, and no end.
    with pytest.raises(ValueError) as caught:
        read_text(Path("/dev/zero"))
    assert "16,777,216" in str(caught.value)


def test_json_and_toml_have_bounded_depth(tmp_path: Path) -> None:
    assert parse_json("[" * 100 + "]" * 100)
    (tmp_path / "x.json").write_text('{"a":' * 100_000)
    (tmp_path / "x.toml").write_text("a = " + "[" * 3000 + "]" * 3000)
    for read in (
        lambda: parse_json("[" * 100_000),
        lambda: read_json(tmp_path / "x.json"),
        lambda: read_toml(tmp_path / "x.toml"),
    ):
        with pytest.raises(ValueError) as caught:
            read()
        assert isinstance(caught.value.__cause__, RecursionError)
    (tmp_path / "x.toml").write_text("#" * (MAX_TOML_BYTES + 1))
    with pytest.raises(ValueError):
        read_toml(tmp_path / "x.toml")


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (None, "–"),
        (math.nan, "–"),
        (0.0, "0"),
        (0.01234, "0.0123"),
        (1.53e-4, "1.53e-04"),
        (8.5, "8.50"),
        (1234.5, "1234"),
    ],
)
def test_numbers_have_three_significant_digits(value: float | None, words: str) -> None:
    assert format_number(value) == words
