"""What the server answers where something is missing, full, too large or too deep: never 500, always one sentence."""

import errno
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from avmsf.errors import LocationError, StudioError
from avmsf.field.sound_field import SoundField
from avmsf.studio.locate import Finder
from avmsf.studio.opening import open_target
from avmsf.studio.server import serve
from factories.capture_folder import fill
from factories.raising import raises
from opened_plate import blow, open_plate, wav
from served import Answer, Served, served

PLACE = "capture/strikes?x=0.01&y=0.02&z=0"


@pytest.fixture(scope="module")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Return one server for all requests that change nothing."""
    home = tmp_path_factory.mktemp("plate")
    with served(open_plate(home / "opened", "elastic"), home / "files") as running:
        yield running


@pytest.fixture
def capture(tmp_path: Path) -> Iterator[Served]:
    with served(open_target(fill(tmp_path / "struck")), tmp_path / "files") as running:
        yield running


def refused(answer: Answer, *statuses: int) -> str:
    assert answer.status in statuses
    words = answer.words["error"]
    assert 10 < len(words) < 600
    return words


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), 507),
        (PermissionError(errno.EACCES, "Permission denied", "x.wav"), 503),
        (OSError("no number"), 503),
        (MemoryError(), 503),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 4 bytes."), 503),
        (RecursionError("maximum recursion depth exceeded"), 400),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes"), 503),
        (ImportError("libtorch.so: failed to map segment from shared object"), 503),
        (ValueError("a bug"), 500),
        (RuntimeError("another bug"), 500),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else str(value),
)
def test_a_failure_becomes_a_sentence(
    plate: Served, monkeypatch: pytest.MonkeyPatch, error: Exception, status: int
) -> None:
    def fail(*arguments: object) -> None:
        raise error

    monkeypatch.setattr(plate.studio.session, "undo", fail)
    refused(plate.ask("POST", "undo", {"base": 1}), status)


@pytest.mark.parametrize(
    "error",
    [
        ValueError("x" * 10_000),
        UnicodeEncodeError("utf-8", "\ud800" * 10_000, 0, 1, "surrogates"),
        OverflowError("too large"),
        torch.linalg.LinAlgError("singular"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_a_computation_that_leads_nowhere_asks_for_other_values(
    plate: Served, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(*arguments: object) -> None:
        raise error

    monkeypatch.setattr(plate.studio.session, "edit", fail)
    monkeypatch.setattr(Finder, "locate", fail)
    refused(plate.ask("POST", "edit", {"base": 1, "pitch": 1.5}), 422)
    refused(plate.ask("POST", "locate", blow()), 422)


def test_a_server_without_a_temporary_folder_does_not_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = open_plate(tmp_path / "opened")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "none"))
    with raises(StudioError, name="TMPDIR"):
        serve(opened, port=0, browser=False, log=print)


def test_a_capture_folder_that_is_gone_is_said_to_be(capture: Served, tmp_path: Path) -> None:
    folder = capture.studio.opened.capture
    assert folder is not None
    [first, *_] = capture.get("capture").words["strikes"]
    recording = f"capture/strikes/{first['file']}"
    folder.rename(tmp_path / "elsewhere")
    for method, place, body in (
        ("GET", "capture", None),
        ("GET", recording, None),
        ("POST", "capture/check", blow()),
        ("POST", PLACE, blow()),
        ("PUT", recording, blow()),
        ("DELETE", recording, None),
        ("POST", "reconstruct", None),
        ("POST", "object", None),
    ):
        answer = capture.ask(method, place, body)
        assert str(folder) in refused(answer, 503), (method, place)
    assert not folder.exists()
    (tmp_path / "elsewhere").rename(folder)
    assert capture.ask("POST", PLACE, blow(7)).status == 201


def test_a_file_name_that_is_not_unicode_is_answered(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"sch\xfcssel")
    try:
        fill(tmp_path / "struck").rename(folder)
    except OSError:
        pytest.skip("this file system has Unicode names only")
    with served(open_target(folder), tmp_path / "files") as running:
        assert running.manifest()["name"] == folder.name
        assert running.get("capture").words["folder"] == str(folder)


@pytest.mark.parametrize("place", ["edit", "undo", "save"])
@pytest.mark.parametrize(
    "body",
    [
        b"[" * 100_000,
        b'{"base":' * 50_000,
        b'{"base":1,"name":' + b"[" * 900 + b"]" * 900 + b',"pitch":' + b"[" * 900 + b"]" * 900 + b"}",
        b'{"base":' + b"9" * 5000 + b"}",
        b'{"base":' + b"9" * 4000 + b"}",
        b'{"base":1,"name":"\\ud800","\\ud800":1}',
        b'{"base":"' + b"x" * 900_000 + b'"}',
        b"\xff\xfe{",
        b"",
    ],
    ids=["lists", "objects", "inner", "digits", "fewer", "surrogates", "long", "bytes", "none"],
)
def test_a_body_that_is_no_request_is_refused(plate: Served, place: str, body: bytes) -> None:
    refused(plate.ask("POST", place, body), 400, 409)
    assert plate.manifest()["live"]["revision"] == 1


@pytest.mark.parametrize(
    "words",
    [
        {"modes": [{"mode": k, "pitch": 1.1} for k in range(6)]},
        {"modes": [{"mode": 1, "db": -100.0}] * 2},
        {"modes": [{"mode": 10**400}]},
        {str(k): k for k in range(50_000)},
        {"material": {"to": "w" * 500_000}},
        {"law": "w" * 500_000},
        *({name: value} for name in ("size", "pitch", "decay") for value in (1e308, 5e-324, 1001.0, 1e-4, 0.0, -1.0)),
        *({"modes": [{"mode": 0, name: value}]} for name in ("pitch", "decay") for value in (1e308, 5e-324, 0.0)),
        {"prompt": "w" * 500_000},
    ],
    ids=lambda words: str(words)[:40],
)
def test_an_edit_out_of_bounds_is_refused(
    plate: Served, monkeypatch: pytest.MonkeyPatch, words: dict[str, Any]
) -> None:
    monkeypatch.setattr(plate.studio, "model", "a model")
    refused(plate.ask("POST", "edit", {"base": 1, **words}), 400)
    assert plate.manifest()["live"]["revision"] == 1


def test_the_body_of_an_edit_is_bounded(plate: Served) -> None:
    refused(plate.ask("POST", "edit", {"base": 1, "law": "w" * (1 << 20)}), 413)


def test_samples_beyond_float32_are_refused(plate: Served) -> None:
    for samples in (np.full(4000, 1e308), np.array([1e308, -1e308] * 2000)):
        refused(plate.ask("POST", "locate", wav(samples, subtype="DOUBLE")), 422)


def test_an_error_ahead_of_time_is_reported_and_the_next_revision_prepared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    prepared: list[SoundField] = []

    def prepare(finder: Finder) -> None:
        prepared.append(finder.field)
        if len(prepared) == 2:
            raise LocationError("no mode is left to locate by")

    monkeypatch.setattr(Finder, "prepare", prepare)
    monkeypatch.setattr("avmsf.studio.locate._SETTLED", 0.0)
    with served(open_plate(tmp_path / "opened", "elastic"), tmp_path / "files") as running:
        for number in range(3):
            if number:
                running.ask("POST", "edit", {"base": number, "pitch": 1.0 + number / 10})
            end = time.monotonic() + 20
            while len(prepared) <= number:
                assert time.monotonic() < end, prepared
                time.sleep(0.01)
        assert prepared[2] is running.studio.session.current.field
    assert "LocationError: no mode is left to locate by" in capfd.readouterr().err
