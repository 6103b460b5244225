"""What errors hold, texts of others, names of the hub, progress and compiled loops."""

import errno
import math
import os
from pathlib import Path
from types import SimpleNamespace

import numba.core.caching
import pytest

from avmsf._utils.compiled import compiled
from avmsf._utils.files import model_folder
from avmsf._utils.text import format_number, read_text
from avmsf.errors import CaptureError, SceneError, from_extra, lacks_memory
from factories.raising import raises


def test_an_error_is_composed_of_its_attributes_and_keeps_them():
    error = CaptureError.expected("a number", 0.1 + 0.2, file="impacts.csv", row=3, name="x", advice="correct it")
    assert type(error) is CaptureError
    kept = {**error.attributes, "file": str(error.file)}
    assert kept == {"file": "impacts.csv", "row": 3, "name": "x", "value": 0.1 + 0.2}
    assert str(error) == "impacts.csv, row 3: expected a number, got 0.3; correct it"
    error = CaptureError.expected("a file", got="a folder", file="a.wav", name="file")
    assert str(error) == "a.wav: expected a file, got a folder"


def hidden() -> OSError:
    """Return an error whose cause a library hides."""
    error = OSError("the library could not be found")
    error.__context__ = OSError("libllvmlite.so: failed to map segment from shared object")
    return error


@pytest.mark.parametrize(
    ("error", "lacks"),
    [
        (hidden(), True),
        (OSError("libllvmlite.so: cannot allocate memory in static TLS block"), True),
        (OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)), True),
        (ImportError("No module named 'torch'"), False),
        (OSError("the library could not be found"), False),
    ],
)
def test_errors_of_missing_memory_are_told_from_others(error: Exception, lacks: bool) -> None:
    assert lacks_memory(error) is lacks


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


def test_numbers_have_three_significant_digits() -> None:
    words = {None: "–", math.nan: "–", 0.0: "0", 0.01234: "0.0123", 1.53e-4: "1.53e-04", 8.5: "8.50", 1234.5: "1234"}
    assert {value: format_number(value) for value in words} == words


def test_an_owner_and_a_model_are_a_name_and_a_path_is_none(tmp_path: Path) -> None:
    assert model_folder("laion/clap-htsat-unfused", "a model", raising=SceneError) is None
    assert model_folder(tmp_path, "a model", raising=SceneError) == tmp_path
    paths = ["./model", "../model", "~/model", "/model", "model/", "model", "a/b/c", Path("owner/model")]
    for path in paths:
        with raises(SceneError, file=Path(path).expanduser(), name="source", value=str(path)):
            model_folder(path, "a model", raising=SceneError)


def twice(value: float) -> float:
    return 2 * value


def test_a_loop_is_compiled_and_kept():
    made = compiled()(twice)
    assert made(1.5) == 3.0
    assert made.stats.cache_path is not None


@pytest.mark.parametrize("full", [False, True])
def test_where_nothing_can_be_kept_it_is_compiled_all_the_same(monkeypatch: pytest.MonkeyPatch, full: bool):
    if full:
        monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=0))
    else:
        monkeypatch.setattr(numba.core.caching.CompileResultCacheImpl, "_locator_classes", [])
    made = compiled(error_model="numpy")(twice)
    assert made(1.5) == 3.0
    assert made.stats.cache_path is None


@pytest.mark.parametrize("cause", [ImportError, RuntimeError])
def test_a_package_of_an_extra_is_named_with_how_to_install_it(cause: type[Exception]) -> None:
    with raises(SceneError, name="pyuff") as caught, from_extra("uff", "pyuff", raising=SceneError):
        raise cause
    assert "pip install 'avmsf[uff]'" in str(caught.value)
