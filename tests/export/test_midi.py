"""Notes from MIDI files and inputs."""

from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from avmsf.errors import PlayerError
from avmsf.export.midi import Note, listen, read_midi

mido = pytest.importorskip("mido", reason="needs pip install 'avmsf[play]'")


def score(path, *notes, tempo=500_000):
    """Write notes as (number, velocity, beats since the last message), each let go of a beat later."""
    file, track = mido.MidiFile(ticks_per_beat=480), mido.MidiTrack()
    track.append(mido.MetaMessage("set_tempo", tempo=tempo))
    for number, velocity, beats in notes:
        track.append(mido.Message("note_on", note=number, velocity=velocity, time=round(480 * beats)))
        track.append(mido.Message("note_on", note=number, velocity=0, time=480))
    file.tracks.append(track)
    file.save(path)
    return path


def test_notes_come_at_their_times_and_releases_are_none(tmp_path):
    found = read_midi(score(tmp_path / "a.mid", (60, 100, 0), (36, 1, 0.5), tempo=1_000_000))
    assert found == [Note(60, 100, 0.0), Note(36, 1, 1.5)]


def test_files_that_hold_no_notes_are_refused(tmp_path):
    with pytest.raises(PlayerError, match="expected a MIDI file, found none"):
        read_midi(tmp_path / "absent.mid")
    (tmp_path / "text.mid").write_text("no music")
    with pytest.raises(PlayerError, match="this is no MIDI file"):
        read_midi(tmp_path / "text.mid")
    (tmp_path / "empty.mid").write_bytes(b"")
    with pytest.raises(PlayerError, match="it ends too soon"):
        read_midi(tmp_path / "empty.mid")
    with pytest.raises(PlayerError, match="a MIDI file without any"):
        read_midi(score(tmp_path / "silent.mid"))


def test_an_input_is_found_by_part_of_its_name(monkeypatch):
    opened = {}

    @contextmanager
    def open_input(name, callback):
        opened[name] = callback
        yield

    monkeypatch.setattr(mido, "get_input_names", lambda: ["Through 0", "Drum Pad 1"], raising=False)
    monkeypatch.setattr(mido, "open_input", open_input, raising=False)
    heard = []
    with listen("pad", heard.append) as name:
        assert name == "Drum Pad 1"
        opened[name](SimpleNamespace(type="note_on", note=40, velocity=90))
        opened[name](SimpleNamespace(type="note_on", note=40, velocity=0))
        opened[name](SimpleNamespace(type="control_change"))
    assert [(note.number, note.velocity) for note in heard] == [(40, 90)]
    with pytest.raises(PlayerError, match="named like 'organ', found Through 0, Drum Pad 1"), listen("organ", print):
        pass


def test_no_midi_at_all_is_one_clear_error(monkeypatch):
    def fail():
        raise SystemError("no sequencer")

    monkeypatch.setattr(mido, "get_input_names", fail, raising=False)
    with pytest.raises(PlayerError, match=r"no MIDI input can be opened here \(no sequencer\)"), listen("", print):
        pass
    monkeypatch.setitem(__import__("sys").modules, "mido", None)
    with pytest.raises(PlayerError, match=r"pip install 'avmsf\[play\]'"), listen("", print):
        pass
