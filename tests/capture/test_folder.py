"""Tables and settings kind to spreadsheets, captures as a whole that read back bit for bit, and their impacts."""

import math
import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from avmsf.capture import Capture, CaptureSettings, read_capture, write_capture
from avmsf.capture.impacts import SAME_PLACE, Impacts, places_of
from avmsf.errors import ArrayError, CaptureError
from avmsf.mesh import Surface
from factories.capture_folder import ROWS, fill, ring
from factories.raising import raises


def invented(*, names: tuple[str, ...] = ("takes/one.wav", "two.wav"), sample_rate: float = 48_000.0) -> Capture:
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(2, 3, generator=generator)
    contacts = torch.randn(2, 3, dtype=torch.float64, generator=generator) / 7
    directions, forces = directions / directions.norm(dim=1, keepdim=True), torch.rand(2, generator=generator) + 1
    sounds = torch.from_numpy(np.stack([ring(1.0, seed=1), ring(1.0, seed=2)]).astype(np.float32))
    impacts = Impacts(contacts, sounds, sample_rate, names, directions=directions, forces=forces)
    # Its corners are the contacts and others, so that the contacts lie on it.
    corners = torch.cat([contacts.float(), torch.randn(4, 3, generator=generator) / 5])
    surface = Surface(corners, torch.tensor([[0, 1, 2], [3, 4, 5]]))
    return Capture('a "cup" \\ für Tee', impacts, surface)


def assert_same(first: Capture, second: Capture) -> None:
    assert first.name == second.name
    assert first.impacts.digest() == second.impacts.digest()
    assert first.surface is second.surface is None or first.surface.digest() == second.surface.digest()


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
    unknown = replace(full.impacts, directions=full.impacts.directions * torch.tensor([[0.0], [1.0]]))
    bare = replace(full, impacts=replace(full.impacts, directions=None, forces=None), surface=None)
    cloud = replace(bare, surface=Surface(torch.randn(5, 3), torch.zeros(0, 3, dtype=torch.int64)))
    for number, capture in enumerate((full, bare, cloud, replace(full, impacts=unknown))):
        with warnings.catch_warnings():
            # These few random points make no shape about the contacts.
            warnings.simplefilter("ignore" if capture is cloud else "error")
            write_capture(capture, tmp_path / f"{number}/cup")
            assert_same(read_capture(tmp_path / f"{number}/cup"), capture)


def test_a_written_capture_is_aligned_held_and_measured_as_the_one_it_was_read_from(tmp_path: Path) -> None:
    sounds = {f"{seed}.wav": ring(before=0.05 + 0.01 * seed, seed=seed) for seed in range(4)}
    read = read_capture(fill(tmp_path / "cup", sounds=sounds, settings='unit = "ft"\nheld = [[1, 2, 3]]'))
    read.write(tmp_path / "again" / "cup")
    again = read_capture(tmp_path / "again" / "cup")
    # Starts that a hammer's channel told stay.
    pushed = {
        name: np.stack([np.eye(1, len(sound), 400 + 80 * row)[0], sound], axis=1)
        for row, (name, sound) in enumerate(sounds.items())
    }
    told = read_capture(fill(tmp_path / "told", sounds=pushed, settings="force_channel = 1\nresponse_channel = 2"))
    told.write(tmp_path / "again" / "told")
    assert torch.equal(read_capture(tmp_path / "again" / "told").impacts.sounds, told.impacts.sounds)
    for name in ("sounds", "before", "after", "contacts"):
        torch.testing.assert_close(
            getattr(again.impacts, name), getattr(read.impacts, name), rtol=0, atol=0, equal_nan=True
        )
    peaks = read_capture(tmp_path / "cup", CaptureSettings(time_zero="peak"))
    peaks.write(tmp_path / "peaks")
    assert read_capture(tmp_path / "peaks").settings.from_peaks
    assert torch.equal(read_capture(tmp_path / "peaks").impacts.sounds, peaks.impacts.sounds)
    assert again.settings.held_at == read.settings.held_at
    assert [*again.settings.unit_ratios(0.2).values()] == [*read.settings.unit_ratios(0.2).values()] == [1.0]


@pytest.mark.parametrize("names", [("strike 1", "strike 2"), ("../a.wav", "b.wav"), ("a.wav", "A.WAV"), ("a.wav", " ")])
def test_names_that_cannot_be_files_become_numbers(tmp_path: Path, names: tuple[str, ...]) -> None:
    write_capture(invented(names=names), tmp_path / "cup")
    assert read_capture(tmp_path / "cup").impacts.names == ("001.wav", "002.wav")
    assert sorted(os.listdir(tmp_path)) == ["cup"]


def test_writing_never_overwrites(tmp_path: Path) -> None:
    write_capture(invented(), tmp_path / "cup")
    before = sorted(os.listdir(tmp_path / "cup"))
    with raises(CaptureError, file="cup"):
        write_capture(invented(), tmp_path / "cup")
    assert sorted(os.listdir(tmp_path / "cup")) == before


CONTACTS = torch.tensor([[0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]], dtype=torch.float64)


def test_rows_keep_their_order_and_contacts_are_meters(tmp_path: Path) -> None:
    capture = read_capture(fill(tmp_path / "bowl", rows=(ROWS[2], ROWS[0], ROWS[1])))
    assert capture.name == "bowl"
    assert capture.impacts.names == ("c.wav", "a.wav", "b.wav")
    assert torch.equal(capture.impacts.contacts, CONTACTS[[2, 0, 1]])
    assert capture.impacts.directions is None
    assert capture.impacts.forces is None
    assert capture.surface is None


SPREADSHEETS = {
    "bom and windows": "\ufefffile,x,y,z\r\na.wav,0.1,0,0\r\nb.wav,0,0.2,0\r\nc.wav,0,0,0.3\r\n",
    "spaces, case": " File , X,Y , z\n a.wav , 0.1, 0 ,0\n\nb.wav,0,0.2,0\nc.wav,0,0,0.3",
    "semicolons": "file;x;y;z\na.wav;0,1;0;0\nb.wav;0;0,2;0\nc.wav;0;0;0,3\n",
    "tabs": "file\tx\ty\tz\na.wav\t0.1\t0\t0\nb.wav\t0\t0.2\t0\nc.wav\t0\t0\t0.3\n",
    "sep": "sep=;\nfile;x;y;z\na.wav;0,1;0;0\nb.wav;0;0,2;0\nc.wav;0;0;0,3\n",
    "sep, comment": "sep=,\n# a, b\nfile,x,y,z\na.wav,0.1,0,0\nb.wav,0,0.2,0\nc.wav,0,0,0.3\n",
    "comments, minus": "# bowl\n#\nfile,x,y,z\na.wav,0.1,\u22120,0\nb.wav,0,0.2,0\nc.wav,0,0,0.3\n",
    "order, quotes, backslash, empty row": 'z,y,x,file\n0,0,0.1,"a.wav"\n0,0.2,0,.\\b.wav\n0.3,0,0,./c.wav\n,,,\n',
}


@pytest.mark.parametrize("text", SPREADSHEETS.values(), ids=SPREADSHEETS)
def test_what_spreadsheets_write_is_read(tmp_path: Path, text: str) -> None:
    folder = fill(tmp_path)
    (folder / "impacts.csv").write_bytes(text.encode())
    impacts = read_capture(folder).impacts
    assert impacts.names == ("a.wav", "b.wav", "c.wav")
    assert torch.equal(impacts.contacts, CONTACTS)


def test_a_name_is_found_composed_or_decomposed(tmp_path: Path) -> None:
    folder = fill(tmp_path)
    (folder / "a.wav").rename(folder / "a\u0308.wav")
    text = (folder / "impacts.csv").read_text().replace("a.wav", "\u00e4.wav")
    (folder / "impacts.csv").write_text(text, encoding="utf-8")
    assert read_capture(folder).impacts.names[0] == "a\u0308.wav"


@pytest.mark.parametrize("surface_unit", ["mm", "cm"])
def test_units_scale_contacts_and_surface(tmp_path: Path, surface_unit: str) -> None:
    size = {"mm": 100, "cm": 10}[surface_unit]
    settings = f'unit = "mm"\nname = "cup"\nsurface_unit = "{surface_unit}"'
    folder = fill(tmp_path, rows=("a.wav,100,0,0", "b.wav,0,200,0", "c.wav,0,0,300"), settings=settings)
    trimesh.creation.box((2 * size, 4 * size, 6 * size)).export(folder / "surface.stl")
    capture = read_capture(folder)
    assert capture.name == "cup"
    # A few roundings in float64.
    assert torch.allclose(capture.impacts.contacts, CONTACTS, rtol=1e-15, atol=0)
    assert capture.surface.vertices.amax(0).tolist() == pytest.approx([0.1, 0.2, 0.3], rel=1e-6)


def test_an_error_names_a_folder_that_a_files_name_begins_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    fill(Path("0"), sounds={"001.wav": np.zeros(5000)})
    with raises(CaptureError, file=Path("0/001.wav")):
        read_capture("0")


def test_directions_become_unit_vectors(tmp_path: Path) -> None:
    rows = ("a.wav,0.1,0,0,0,0,-2", "b.wav,0,0.2,0,3,0,4", "c.wav,0,0,0.3,1,0,0")
    directions = read_capture(fill(tmp_path, header="file,x,y,z,nx,ny,nz", rows=rows)).impacts.directions
    assert directions is not None
    assert torch.allclose(directions, torch.tensor([[0, 0, -1.0], [0.6, 0, 0.8], [1, 0, 0]]), rtol=1e-6, atol=0)


def test_a_unit_is_open_only_where_none_is_stated_and_gives_an_object_of_usual_size():
    assert CaptureSettings().unit_ratios(8.0) == pytest.approx({"m": 1.0, "cm": 0.01, "in": 0.0254, "ft": 0.3048})
    assert CaptureSettings().unit_ratios(0.02) == {"m": 1.0}
    for stated in ({"unit": "cm"}, {"surface_unit": "m"}, {"views_unit": "mm"}):
        assert list(CaptureSettings(**stated).unit_ratios(8.0).values()) == [1.0]


def test_the_paper_s_three_seconds_are_kept_and_of_slow_recordings_as_many_samples() -> None:
    for settings, rate, seconds in (({}, 44100.0, 3.0), ({}, 96000.0, 3.0), ({"seconds": 2.0}, 400.0, 2.0)):
        assert CaptureSettings(**settings).kept_seconds(rate) == seconds
    assert CaptureSettings().kept_seconds(400.0) * 400.0 == pytest.approx(3.0 * 44100.0)


RATE = 8000.0


def impacts(sounds, before=None, after=None):
    return Impacts(
        torch.zeros(len(sounds), 3), sounds, RATE, tuple(map(str, range(len(sounds)))), before=before, after=after
    )


def band_limited(times):
    """Tones up to .4 of the rate, under a slow envelope that is smooth everywhere."""
    tones = sum(torch.cos(2 * math.pi * f * times + f) for f in (310.0, 1203.0, 2511.0, 3200.0))
    return tones * torch.exp(-((times - 0.05) ** 2) / 2e-3)


def test_whole_samples_are_those_of_the_file() -> None:
    file = torch.randn(2, 300, generator=torch.Generator().manual_seed(0))
    cut = impacts(file[:, 20:280], file[:, :20], file[:, 280:]).delayed(torch.tensor([-7.0, 5.0], dtype=torch.float64))
    assert torch.equal(cut.sounds, torch.stack([file[0, 13:273], file[1, 25:285]]))
    assert cut.before is None
    assert cut.after is None


def test_between_samples_a_band_limited_signal_is_interpolated() -> None:
    times = torch.arange(900, dtype=torch.float64) / RATE
    file = band_limited(times)[None].repeat(3, 1)
    delays = torch.tensor([0.37, -4.5, 11.04], dtype=torch.float64)
    cut = impacts(file[:, 50:850], file[:, :50], file[:, 850:]).delayed(delays)
    expected = torch.stack([band_limited(times[50:850] + delay / RATE) for delay in delays.tolist()])
    assert float((cut.sounds - expected).abs().max()) < 1e-3 * float(expected.abs().max())


def test_what_a_file_does_not_hold_is_zero() -> None:
    file = torch.ones(1, 100)
    before = torch.full((1, 4), torch.nan)
    before[:, 2:] = 1.0
    cut = impacts(file, before, torch.zeros(1, 0)).delayed(torch.tensor([-6.0], dtype=torch.float64)).sounds
    assert torch.equal(cut, torch.cat([torch.zeros(1, 4), torch.ones(1, 96)], dim=1))


def test_delays_are_numbers() -> None:
    with raises(ArrayError, row=0, name="delays"):
        impacts(torch.ones(1, 100)).delayed(torch.tensor([math.nan], dtype=torch.float64))


def test_contacts_nearer_than_a_hundredth_are_one_place():
    """Of the diagonal of the box around all; farther ones are not, and equal ones are always."""
    corners = torch.tensor([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]], dtype=torch.float64)
    near = torch.tensor([[1.0, 1.0, 0.0], [1.049, 1.0, 0.0], [2.0, 2.0, 0.0], [2.051, 2.0, 0.0]], dtype=torch.float64)
    places = places_of(torch.cat([corners, near, near[:1], corners[1:]]))
    assert places.unique().tolist() == [0, 1, 2, 3, 4]
    groups = [[0], [1, 7], [2, 3, 6], [4], [5]]
    assert sorted(torch.nonzero(places == place).flatten().tolist() for place in places.unique()) == groups
    assert places_of(corners[:1]).tolist() == [0]
    assert places_of(corners[[0, 0]]).tolist() == [0, 0]


def test_places_do_not_grow_along_a_row():
    """Of contacts each near to the next; nothing depends on the order of contacts."""
    along = torch.linspace(0.0, 1.0, 161, dtype=torch.float64)
    contacts = along[:, None] * torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    places = places_of(contacts)
    for place in places.unique():
        assert float(along[places == place].max() - along[places == place].min()) <= SAME_PLACE
    assert len(places.unique()) < 161
    order = torch.randperm(161, generator=torch.Generator().manual_seed(0))
    together = places[:, None] == places
    assert torch.equal((places_of(contacts[order])[:, None] == places_of(contacts[order])), together[order][:, order])


def test_a_capture_that_was_sped_up_is_read_back(tmp_path: Path) -> None:
    sounds = {f"{seed}.wav": ring(before=0.05, seed=seed) for seed in range(4)}
    read = read_capture(fill(tmp_path / "cup", sounds=sounds, settings="playback_speed = 4.0\nseconds = 0.03"))
    read.write(tmp_path / "again")
    again = read_capture(tmp_path / "again").impacts
    for name in ("sounds", "before", "after"):
        torch.testing.assert_close(getattr(again, name), getattr(read.impacts, name), rtol=0, atol=0, equal_nan=True)
