"""A capture as a whole: what its sounds have in common, and that written folders read back bit for bit."""

import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from avmsf.capture import Capture, CaptureSettings, Impacts, read_capture, write_capture
from avmsf.errors import CaptureError
from avmsf.mesh import Surface
from factories.capture_folder import fill, ring
from factories.raising import raises


def invented(*, names: tuple[str, ...] = ("takes/one.wav", "two.wav"), sample_rate: float = 48_000.0) -> Capture:
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(2, 3, generator=generator)
    contacts = torch.randn(2, 3, dtype=torch.float64, generator=generator) / 7
    impacts = Impacts(
        contacts=contacts,
        sounds=torch.from_numpy(np.stack([ring(1.0, seed=1), ring(1.0, seed=2)]).astype(np.float32)),
        sample_rate=sample_rate,
        names=names,
        directions=directions / directions.norm(dim=1, keepdim=True),
        forces=torch.rand(2, generator=generator) + 1,
    )
    # Its corners are the contacts and others, so that the contacts lie on it.
    corners = torch.cat([contacts.float(), torch.randn(4, 3, generator=generator) / 5])
    surface = Surface(corners, torch.tensor([[0, 1, 2], [3, 4, 5]]))
    return Capture('a "cup" \\ für Tee', impacts, surface)


def assert_same(first: Capture, second: Capture) -> None:
    assert first.name == second.name
    assert first.impacts.names == second.impacts.names
    assert first.impacts.sample_rate == second.impacts.sample_rate
    for name in ("contacts", "sounds", "directions", "forces"):
        one, other = getattr(first.impacts, name), getattr(second.impacts, name)
        assert (one is None) == (other is None), name
        assert one is None or torch.equal(one, other), name
    assert (first.surface is None) == (second.surface is None)
    if first.surface is not None and second.surface is not None:
        assert torch.equal(first.surface.vertices, second.surface.vertices)
        assert torch.equal(first.surface.faces, second.surface.faces)


def test_seconds_count_as_recorded_and_speed_only_raises_the_rate(tmp_path: Path) -> None:
    folder = fill(tmp_path)
    plain = read_capture(folder, CaptureSettings(seconds=0.25)).impacts
    fast = read_capture(folder, CaptureSettings(seconds=0.25, playback_speed=2.5)).impacts
    assert plain.sounds.shape == (3, 2000)
    assert torch.equal(plain.sounds, fast.sounds)
    assert (plain.sample_rate, fast.sample_rate) == (8000, 20_000)
    assert (plain.duration, fast.duration) == (0.25, 0.1)


def test_settings_given_replace_those_of_the_folder(tmp_path: Path) -> None:
    folder = fill(tmp_path, settings='seconds = 0.1\nname = "cup"')
    for settings, samples, name in ((None, 800, "cup"), (CaptureSettings(seconds=0.2), 1600, tmp_path.name)):
        capture = read_capture(folder, settings)
        assert (capture.impacts.sounds.shape[1], capture.name) == (samples, name)


@pytest.mark.parametrize("sample_rate", [48_000.0, 44_100.0, 512 * 1.3, 8000 / 3, 100.01, 7839.059834067738])
def test_a_written_capture_reads_back_bit_for_bit(tmp_path: Path, sample_rate: float) -> None:
    full = invented(sample_rate=sample_rate)
    bare = replace(full, impacts=replace(full.impacts, directions=None, forces=None), surface=None)
    cloud = replace(bare, surface=Surface(torch.randn(5, 3), torch.zeros(0, 3, dtype=torch.int64)))
    for number, capture in enumerate((full, bare, cloud)):
        with warnings.catch_warnings():
            # These few random points make no shape about the contacts.
            warnings.simplefilter("ignore" if capture is cloud else "error")
            write_capture(capture, tmp_path / f"{number}/cup")
            assert_same(read_capture(tmp_path / f"{number}/cup"), capture)


@pytest.mark.parametrize("names", [("strike 1", "strike 2"), ("../a.wav", "b.wav"), ("a.wav", "A.WAV"), ("a.wav", " ")])
def test_names_that_cannot_be_files_become_numbers(tmp_path: Path, names: tuple[str, ...]) -> None:
    write_capture(invented(names=names), tmp_path / "cup")
    assert read_capture(tmp_path / "cup").impacts.names == ("001.wav", "002.wav")
    assert sorted(os.listdir(tmp_path)) == ["cup"]


def test_writing_never_overwrites(tmp_path: Path) -> None:
    (tmp_path / "cup").mkdir()
    write_capture(invented(), tmp_path / "cup")
    before = sorted(path.name for path in (tmp_path / "cup").iterdir())
    with raises(CaptureError, file="cup"):
        write_capture(invented(), tmp_path / "cup")
    assert sorted(path.name for path in (tmp_path / "cup").iterdir()) == before
