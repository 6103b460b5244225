"""Exports are whole or absent, and never write over what is not theirs."""

import json
import os

import pytest

from avmsf.errors import ExportError
from avmsf.export.faust import write_faust
from avmsf.export.gltf import write_gltf
from avmsf.export.universal import write_universal
from avmsf.export.webpage import write_webpage
from avmsf.export.written import Written, write_file, write_folder
from made_tables import table
from raising import raises


def fill(*names):
    def write(place):
        for name in names:
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            (place / name).write_text(name)

    return write


def listed(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_a_folder_lists_its_files_and_their_sizes(tmp_path):
    sizes = write_folder(tmp_path / "out", fill("b.txt", "in/a.txt"), {"name": "x"})
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["files"] == ["b.txt", "in/a.txt", "manifest.json"]
    assert manifest["name"] == "x"
    assert manifest["generator"].startswith("avmsf ")
    assert Written(sizes).size == sum(path.stat().st_size for path in (tmp_path / "out").rglob("*") if path.is_file())


def test_an_earlier_export_is_replaced_as_a_whole(tmp_path):
    write_folder(tmp_path / "out", fill("old.txt", "both.txt"), {})
    write_folder(tmp_path / "out", fill("both.txt"), {})
    assert listed(tmp_path / "out") == ["both.txt", "manifest.json"]
    assert listed(tmp_path) == ["out/both.txt", "out/manifest.json"]


def test_a_strangers_file_in_it_protects_a_folder(tmp_path):
    write_folder(tmp_path / "out", fill("a.txt"), {})
    (tmp_path / "out" / "notes.txt").write_text("mine")
    with raises(ExportError, file=tmp_path / "out", name="--overwrite"):
        write_folder(tmp_path / "out", fill("b.txt"), {})
    assert listed(tmp_path / "out") == ["a.txt", "manifest.json", "notes.txt"]
    write_folder(tmp_path / "out", fill("b.txt"), {}, force=True)
    assert (tmp_path / "out" / "notes.txt").read_text() == "mine"
    assert listed(tmp_path / "out") == ["a.txt", "b.txt", "manifest.json", "notes.txt"]


def test_an_empty_folder_is_free(tmp_path):
    (tmp_path / "out").mkdir()
    write_folder(tmp_path / "out", fill("a.txt"), {})
    assert listed(tmp_path / "out") == ["a.txt", "manifest.json"]


def test_what_fails_half_way_leaves_all_as_it_was(tmp_path):
    write_folder(tmp_path / "out", fill("a.txt"), {})

    def fail(place):
        (place / "b.txt").write_text("half")
        raise OSError(28, "No space left on device")

    with raises(ExportError, file=tmp_path / "out", value="No space left on device"):
        write_folder(tmp_path / "out", fail, {})
    assert listed(tmp_path) == ["out/a.txt", "out/manifest.json"]


def test_a_folder_behind_a_link_is_replaced_and_the_link_stays(tmp_path):
    write_folder(tmp_path / "real", fill("old.txt"), {})
    (tmp_path / "link").symlink_to("real")
    sizes = write_folder(tmp_path / "link", fill("a.txt"), {})
    assert set(sizes) == {tmp_path / "link" / name for name in ("a.txt", "manifest.json")}
    assert (tmp_path / "link").is_symlink()
    assert sorted(os.listdir(tmp_path)) == ["link", "real"]
    assert listed(tmp_path / "real") == ["a.txt", "manifest.json"]


def test_the_old_folder_comes_back_where_the_new_one_cannot_take_its_place(tmp_path, monkeypatch):
    write_folder(tmp_path / "out", fill("a.txt"), {})
    plain = os.replace

    def fail(source, target):
        if str(source).endswith(".part"):
            raise OSError(5, "Input/output error")
        plain(source, target)

    monkeypatch.setattr(os, "replace", fail)
    with raises(ExportError, file=tmp_path / "out", value="Input/output error"):
        write_folder(tmp_path / "out", fill("b.txt"), {})
    assert listed(tmp_path) == ["out/a.txt", "out/manifest.json"]


@pytest.mark.parametrize(
    ("name", "write"),
    [("a.dsp", write_faust), ("a.glb", write_gltf), ("a.uff", write_universal), ("a.html", write_webpage)],
)
def test_ours_are_known_again_and_what_speaks_of_us_is_not_ours(tmp_path, name, write):
    if name == "a.uff":
        pytest.importorskip("pyuff", reason="needs pip install 'avmsf[uff]'")
    path = tmp_path / name
    for seed in (0, 1):
        write(table(seed=seed), path)
    path.write_text("// my own program, with tables that avmsf 0.7.0 made\n<!-- from avmsf 0.7.0 -->\n")
    with raises(ExportError, file=path, name="--overwrite"):
        write(table(), path)
    write(table(), path, force=True)


def test_what_is_there_already_may_be_written(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"theirs")
    write_file(tmp_path / "a.ply", b"theirs")
    with raises(ExportError, file="a.ply", name="--overwrite"):
        write_file(tmp_path / "a.ply", b"other")
    assert (tmp_path / "a.ply").read_bytes() == b"theirs"


def test_files_and_folders_are_told_apart(tmp_path):
    (tmp_path / "file").write_text("avmsf")
    with raises(ExportError, file=tmp_path / "file", value="file"):
        write_folder(tmp_path / "file", fill("a.txt"), {}, force=True)
    with raises(ExportError, file=tmp_path, value="folder"):
        write_file(tmp_path, b"avmsf", force=True)


@pytest.mark.parametrize("text", ["", "not json", "[]", '{"files": ["a.txt"]}', '{"generator": "other", "files": []}'])
def test_anothers_manifest_is_no_licence(tmp_path, text):
    (tmp_path / "manifest.json").write_text(text)
    with raises(ExportError, file=tmp_path, name="--overwrite"):
        write_folder(tmp_path, fill("a.txt"), {})
