"""`capture.toml`: what is accepted, and that every mistake names its key."""

from pathlib import Path

import pytest

from avmsf.capture import CaptureSettings
from avmsf.errors import CaptureError


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
    ("text", "message"),
    [
        ("second = 2.0", "unknown key 'second' .did you mean seconds"),
        ("color = 2.0", "unknown key 'color'; expected some of name, unit"),
        ('seconds = "3"', "seconds is '3'; expected a number"),
        ("seconds = true", "seconds is True; expected a number"),
        ("response_channel = 1.5", "response_channel is 1.5; expected a whole number"),
        ("response_channel = true", "response_channel is True; expected a whole number"),
        ("align = 1", "align is 1; expected true or false"),
        ("name = 3", "name is 3; expected text"),
        ("seconds = 0", "seconds is 0.0; expected a number above 0"),
        ("seconds = nan", "seconds is nan; expected a number above 0"),
        ("playback_speed = -1", "playback_speed is -1.0; expected a number above 0"),
        ("regularization = 0.0", "regularization is 0.0; expected a number above 0"),
        ("force_scale = 0", "force_scale is 0.0; expected newtons"),
        ('unit = "km"', "unit is 'km'; expected one of m, cm, mm, in, ft"),
        ('surface_unit = "yd"', "surface_unit is 'yd'"),
        ("force_channel = 0", "force_channel is 0; channels count from 1"),
        ("force_channel = 2\nresponse_channel = 2", "are both 2"),
        ('normalize = "rms"', "normalize is 'rms'; expected one of auto, peak, deconvolve, none, done"),
        ('normalize = "deconvolve"', "say which force_channel"),
        ("seconds = ", "not a TOML file"),
    ],
)
def test_a_mistake_names_file_and_key(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(CaptureError, match=rf"(?s)capture\.toml: .*{message}"):
        read(tmp_path, text)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"nowhere\.toml: there is no such file"):
        CaptureSettings.read(tmp_path / "nowhere.toml")


def test_slow_recordings_are_kept_for_as_many_samples() -> None:
    assert CaptureSettings().kept_seconds(44100.0) == 3.0
    assert CaptureSettings().kept_seconds(96000.0) == 3.0
    assert CaptureSettings().kept_seconds(400.0) * 400.0 == pytest.approx(3.0 * 44100.0)
    assert CaptureSettings(seconds=2.0).kept_seconds(400.0) == 2.0
