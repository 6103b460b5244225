"""`avmsf play`: what it writes is what would be heard, and what it says where nothing can be heard."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch

from avmsf.cli import main, play
from avmsf.errors import PlayerError
from avmsf.export.midi import Note
from avmsf.export.player import Blow, Capacity, Player, random_blows
from avmsf.export.sampledfield import SampledField
from avmsf.field.soundfield import Origin, SoundField
from avmsf.field.store import load, save
from avmsf.modal.residual import Residual
from made_fields import BANK, positional

Streams = pytest.CaptureFixture[str]
RATE, SAMPLES = 8000.0, 4000


@pytest.fixture(scope="module")
def field_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("field") / "plate.safetensors"
    zero = torch.zeros(len(BANK), dtype=torch.float64)
    save(SoundField(BANK, positional(), zero, Residual(torch.full((9,), 1e-3)), RATE, SAMPLES, Origin("plate")), path)
    return path


def bounced(field_file: Path, path: Path, *words: str) -> np.ndarray:
    assert main(["play", str(field_file), "--bounce", str(path), *words]) == 0
    sound, rate = soundfile.read(path)
    assert rate == RATE
    return sound


def test_random_blows_into_a_file_are_those_of_the_seed(field_file: Path, tmp_path: Path, capsys: Streams) -> None:
    heard = bounced(field_file, tmp_path / "a.wav", "--seconds", "1.5", "--blows", "6", "--seed", "3", "--points", "40")
    out, err = capsys.readouterr()
    field = SampledField.of(load(field_file), limit=40)
    blows = random_blows(field, seconds=1.5, each_second=6.0, seed=3)
    assert len(heard) == 12_000
    assert f"wrote {tmp_path / 'a.wav'}: {len(blows)} blows, 1.5 s at 8000 Hz" in out
    assert "times as fast as real time" in out
    assert "voices at once in real time: " in err
    true = np.zeros(12_000)
    scale = Player(field).level
    for blow in blows:
        sound = field.render(torch.tensor([blow.row]), force=blow.force)[0].double().numpy()[: 12_000 - blow.start]
        true[blow.start : blow.start + len(sound)] += scale * sound
    # Until the first blow's noise ends, behind which modes ring on that the render cuts off.
    np.testing.assert_allclose(heard[: SAMPLES - 80], true[: SAMPLES - 80], atol=2e-6)
    again = bounced(field_file, tmp_path / "b.wav", "--seconds", "1.5", "--blows", "6", "--seed", "4", "--points", "40")
    assert np.abs(again - heard).max() > 0.01


def test_a_score_is_played_to_its_end(field_file: Path, tmp_path: Path) -> None:
    mido = pytest.importorskip("mido", reason="needs pip install 'avmsf[play]'")
    file, track = mido.MidiFile(), mido.MidiTrack()
    track.append(mido.Message("note_on", note=72, velocity=100, time=480))
    file.tracks.append(track)
    file.save(tmp_path / "one.mid")
    point = positional().points[5].tolist()
    millimetres = [str(1000 * value) for value in point]
    words = ["--midi", str(tmp_path / "one.mid"), "--keys", "pitch", "--at", *millimetres, "--unit", "mm"]
    words += ["--level-db", "-20"]
    heard = bounced(field_file, tmp_path / "a.wav", *words)
    assert len(heard) == round(2.5 * RATE)
    assert not heard[: round(0.5 * RATE)].any()
    field = SampledField.of(load(field_file), limit=1000)
    player = Player(field, level=0.1)
    player.strike(Blow(int(field.nearest(torch.tensor([point]))[0]), 1.0, 4000, ratio=2.0))
    np.testing.assert_allclose(heard, player.render(len(heard)), atol=1e-6)
    # An octave up: the lowest mode sounds at twice its frequency, 780 Hz.
    spectrum = np.abs(np.fft.rfft(heard[4000:12_000] * np.hanning(8000)))
    strongest = int(spectrum.argmax())
    assert min(abs(strongest - 2 * frequency) for frequency in BANK.frequency.tolist()) < 3


class Device:
    """A sound device that takes blocks as fast as they come."""

    PortAudioError = OSError
    heard: list[np.ndarray]

    def __init__(self, *, fails: bool = False) -> None:
        self.heard, self.asked, self._fails = [], {}, fails

    def OutputStream(self, **asked: Any) -> Any:  # noqa: N802
        if self._fails:
            raise OSError("Error querying device -1")
        self.asked = asked
        device = self

        class Stream:
            def __enter__(self) -> "Stream":
                return self

            def __exit__(self, *_: object) -> None:
                for number in range(30):
                    out = np.full((asked["blocksize"], 1), np.nan, dtype=np.float32)
                    asked["callback"](out, asked["blocksize"], None, number == 7)
                    device.heard.append(out[:, 0])

        return Stream()


def test_a_device_hears_what_a_file_holds(
    field_file: Path, tmp_path: Path, capsys: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = Device()
    monkeypatch.setitem(sys.modules, "sounddevice", device)
    words = ["--seconds", "0.2", "--blows", "40", "--block", "50"]
    assert main(["play", str(field_file), "--device", "3", *words]) == 0
    assert "1 blocks came too late" in capsys.readouterr().err
    assert (device.asked["device"], device.asked["samplerate"], device.asked["blocksize"]) == (3, RATE, 50)
    filed = bounced(field_file, tmp_path / "a.wav", *words)
    np.testing.assert_allclose(np.concatenate(device.heard)[:1500], filed[:1500], atol=1e-7)


class Running(Device):
    """A sound device that takes a second's blocks at once when it starts, and then is interrupted by Ctrl-C."""

    def OutputStream(self, **asked: Any) -> Any:  # noqa: N802
        device = self

        class Stream:
            def __enter__(self) -> "Stream":
                for _ in range(round(RATE) // asked["blocksize"]):
                    out = np.full((asked["blocksize"], 1), np.nan, dtype=np.float32)
                    asked["callback"](out, asked["blocksize"], None, False)
                    device.heard.append(out[:, 0])
                return self

            def __exit__(self, *_: object) -> None:
                pass

        return Stream()


def test_without_an_end_blows_come_as_they_are_due_until_ctrl_c(
    field_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device, struck, hours = Running(), [], iter(range(1000))

    class Clock:
        perf_counter = staticmethod(time.perf_counter)

        @staticmethod
        def monotonic() -> float:
            hour = next(hours)
            if hour == 50:
                raise KeyboardInterrupt
            return 3600.0 * hour

    def strike(self: Player, blow: Blow) -> None:
        struck.append((self.now, blow.start))
        plain(self, blow)

    plain = Player.strike
    monkeypatch.setitem(sys.modules, "sounddevice", device)
    monkeypatch.setattr(play, "measure_capacity", lambda *_, **__: Capacity(1, 1.0))
    words = ["--blows", "40", "--block", "50"]
    with monkeypatch.context() as patched:
        patched.setattr(play, "time", Clock)
        patched.setattr(Player, "strike", strike)
        patched.setattr("threading.Event.wait", lambda *_: False)
        assert main(["play", str(field_file), *words]) == 130
    # Every blow is handed over within the block in which it begins, and none beforehand.
    assert all(now <= start < now + 50 for now, start in struck)
    assert 15 < len(struck) < 80
    filed = bounced(field_file, tmp_path / "a.wav", *words, "--seconds", "1")
    np.testing.assert_allclose(np.concatenate(device.heard), filed, atol=1e-7)


def test_a_keyboard_is_heard(field_file: Path, capsys: Streams, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def listen(wanted: str, hear: Callable[[Note], None]) -> Iterator[str]:
        hear(Note(40, 50, 0.0))
        yield f"the {wanted}"

    device = Device()
    monkeypatch.setitem(sys.modules, "sounddevice", device)
    monkeypatch.setattr(play, "listen", listen)
    assert main(["play", str(field_file), "--midi", "pad", "--seconds", "0.1", "--points", "50"]) == 0
    assert "listening to the pad" in capsys.readouterr().err
    field = SampledField.of(load(field_file), limit=50)
    player = Player(field)
    player.strike(Blow(field.spread(61)[4].item(), 0.25))
    np.testing.assert_allclose(np.concatenate(device.heard), player.render(30 * 256), atol=1e-7)


def refused(words: list[str], capsys: Streams) -> str:
    assert main(["play", *words]) == 2
    return capsys.readouterr().err


def test_no_device_is_one_clear_error(field_file: Path, capsys: Streams, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sounddevice", Device(fails=True))
    said = refused([str(field_file), "--seconds", "1"], capsys)
    assert "no sound device plays 8000 Hz here (Error querying device -1)" in said
    assert "--bounce" in said
    monkeypatch.setitem(sys.modules, "sounddevice", None)
    assert "pip install 'avmsf[play]'" in refused([str(field_file)], capsys)


def test_a_failing_callback_ends_the_playing(
    field_file: Path, capsys: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(self: Player, count: int, *, limit: bool = True) -> np.ndarray:
        raise ValueError("broken")

    player = Player(SampledField.of(load(field_file), limit=4))
    monkeypatch.setattr(Player, "render", fail)
    live = play._Live(player)
    out = np.ones((4, 1), dtype=np.float32)
    live.fill(out, 4, None, None)
    assert not out.any()
    with pytest.raises(PlayerError, match="the sound stopped: broken"):
        play._wait(live, 5.0, threading.Event())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--bounce", "a.mp3"], "ends in .wav"),
        (["--bounce", "a.wav", "--midi", "keyboard"], "expected a MIDI file, .mid"),
        (["--seconds", "-1"], "expected a time above 0"),
        (["--contact-time", "2"], "expected 0 to .1 s"),
        (["--block", "1"], "expected 16 to"),
        (["--level-db", "nan"], "expected a finite number"),
        (["--midi", "a.mid", "--keys", "pitch", "--at", "nan", "0", "0"], "--at is nan 0 0; expected finite numbers"),
        (["--midi", "a.mid", "--keys", "pitch", "--at", "1000", "0", "0"], "m outside an object"),
        (["--midi", "a.mid", "--at", "0", "0", "0"], "add --keys pitch"),
        (["--keys", "pitch"], "random blows have no keys"),
    ],
)
def test_bad_settings_are_refused(words: list[str], said: str, field_file: Path, capsys: Streams) -> None:
    assert said in refused([str(field_file), *words], capsys)
