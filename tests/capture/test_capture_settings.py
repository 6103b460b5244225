"""`capture.toml`: what is accepted, and that every mistake names its key."""

import math
from pathlib import Path
from typing import Any

import pytest

from avmsf.capture import CaptureSettings
from avmsf.errors import CaptureError
from factories.raising import raises


def read(folder: Path, text: str) -> CaptureSettings:
    (folder / "capture.toml").write_text(text)
    return CaptureSettings.read(folder / "capture.toml")


def test_every_key_is_optional_and_the_paper_keeps_three_seconds(tmp_path: Path) -> None:
    settings = read(tmp_path, "")
    assert settings == CaptureSettings()
    assert settings.kept_seconds(48000.0) == 3.0


def test_keys_are_read_and_whole_numbers_serve_as_numbers(tmp_path: Path) -> None:
    settings = read(tmp_path, 'unit = "mm"\nseconds = 2\nforce_channel = 1\nresponse_channel = 2\nalign = false\n')
    assert settings == CaptureSettings(unit="mm", seconds=2.0, force_channel=1, response_channel=2, align=False)
    assert settings.meters == 1e-3


@pytest.mark.parametrize(("unit", "meters"), [("m", 1), ("cm", 0.01), ("mm", 0.001), ("in", 0.0254), ("ft", 0.3048)])
def test_units_are_the_international_ones(unit: str, meters: float) -> None:
    assert CaptureSettings(unit=unit).meters == meters
    assert CaptureSettings(unit="m", surface_unit=unit).surface_meters == meters
    assert CaptureSettings(unit=unit).surface_meters == meters


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("second = 2.0", "second", "seconds"),
        ("color = 2.0", "color", None),
        ('seconds = "3"', "seconds", "3"),
        ("seconds = true", "seconds", True),
        ("response_channel = 1.5", "response_channel", 1.5),
        ("response_channel = true", "response_channel", True),
        ("align = 1", "align", 1),
        ("name = 3", "name", 3),
        ("seconds = 0", "seconds", 0.0),
        ("seconds = nan", "seconds", pytest.approx(math.nan, nan_ok=True)),
        ("playback_speed = -1", "playback_speed", -1.0),
        ("regularization = 0.0", "regularization", 0.0),
        ("force_scale = 0", "force_scale", 0.0),
        ('unit = "km"', "unit", "km"),
        ('surface_unit = "yd"', "surface_unit", "yd"),
        ("force_channel = 0", "force_channel", 0),
        ("force_channel = 2\nresponse_channel = 2", "force_channel", 2),
        ('normalize = "rms"', "normalize", "rms"),
        ('normalize = "deconvolve"', "force_channel", None),
        ('time_zero = "middle"', "time_zero", "middle"),
        ("highpass = -1.0", "highpass", -1.0),
        ("seconds = ", None, None),
        (f"seconds = {10**400}", "seconds", 10**400),
        ("a = " + "[" * 3000 + "]" * 3000, None, None),
    ],
    ids=lambda each: str(each)[:30],
)
def test_a_mistake_names_file_and_key(tmp_path: Path, text: str, name: str | None, value: Any) -> None:
    with raises(CaptureError, file="capture.toml", name=name, value=value):
        read(tmp_path, text)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with raises(CaptureError, file="nowhere.toml"):
        CaptureSettings.read(tmp_path / "nowhere.toml")


def test_slow_recordings_are_kept_for_as_many_samples() -> None:
    assert CaptureSettings().kept_seconds(44100.0) == 3.0
    assert CaptureSettings().kept_seconds(96000.0) == 3.0
    assert CaptureSettings().kept_seconds(400.0) * 400.0 == pytest.approx(3.0 * 44100.0)
    assert CaptureSettings(seconds=2.0).kept_seconds(400.0) == 2.0
