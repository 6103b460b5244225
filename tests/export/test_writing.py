"""Exports are whole or absent, and the page is a folder or one file; tests/studio opens both."""

import json
import os
import re
from dataclasses import replace
from pathlib import Path

from avmsf.errors import ExportError
from avmsf.export.web import make_bundle, page_files, single_file, write_webpage
from avmsf.export.writing import Written, write_files, write_folder
from factories.made_tables import struck_table
from factories.raising import raises


def named(*names):
    return {name: name.encode() for name in names}


def listed(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_a_folder_lists_its_files_and_their_sizes(tmp_path):
    (tmp_path / "out").mkdir()  # An empty folder is free.
    sizes = write_folder(tmp_path / "out", named("b.txt", "in/a.txt"), {"name": "x"})
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["files"] == ["b.txt", "in/a.txt", "manifest.json"]
    assert manifest["name"] == "x"
    assert manifest["generator"].startswith("avmsf ")
    assert Written(sizes).size == sum(path.stat().st_size for path in (tmp_path / "out").rglob("*") if path.is_file())


def test_an_export_is_replaced_only_if_asked_and_nothing_else_is(tmp_path):
    write_folder(tmp_path / "out", named("a.txt", "in/c.txt"), {})
    with raises(ExportError, file=tmp_path / "out", name="--overwrite"):
        write_folder(tmp_path / "out", named("b.txt"), {})
    write_folder(tmp_path / "out", named("b.txt"), {}, overwrite=True)
    assert listed(tmp_path) == ["out/b.txt", "out/manifest.json"]
    (tmp_path / "out" / "notes.txt").write_text("mine")
    with raises(ExportError, file=tmp_path / "out", name="--overwrite", value=["notes.txt"]):
        write_folder(tmp_path / "out", named("a.txt"), {}, overwrite=True)
    (tmp_path / "out" / "manifest.json").write_text('{"files": ["b.txt", "manifest.json", "notes.txt"]}')
    with raises(ExportError, file=tmp_path / "out", value=["b.txt", "manifest.json", "notes.txt"]):
        write_folder(tmp_path / "out", named("a.txt"), {}, overwrite=True)
    assert listed(tmp_path) == ["out/b.txt", "out/manifest.json", "out/notes.txt"]


def test_a_folder_behind_a_link_is_written_to_and_the_link_stays(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    sizes = write_folder(tmp_path / "link", named("a.txt"), {})
    assert set(sizes) == {tmp_path / "link" / name for name in ("a.txt", "manifest.json")}
    assert (tmp_path / "link").is_symlink()
    assert sorted(os.listdir(tmp_path)) == ["link", "real"]
    assert listed(tmp_path / "real") == ["a.txt", "manifest.json"]


def test_a_file_that_exists_is_replaced_only_if_asked(tmp_path):
    write_files({tmp_path / "a.ply": b"ours"})
    with raises(ExportError, file="a.ply", name="--overwrite"):
        write_files({tmp_path / "b.ply": b"", tmp_path / "a.ply": b"other"})
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("a.ply", b"ours")]
    write_files({tmp_path / "a.ply": b"other"}, overwrite=True)
    assert (tmp_path / "a.ply").read_bytes() == b"other"


def test_files_and_folders_are_told_apart(tmp_path):
    (tmp_path / "file").write_text("avmsf")
    with raises(ExportError, file=tmp_path / "file", value="file"):
        write_folder(tmp_path / "file", named("a.txt"), {}, overwrite=True)
    with raises(ExportError, file=tmp_path, value="folder"):
        write_files({tmp_path: b"avmsf"}, overwrite=True)


def test_both_forms_are_written_whole(tmp_path: Path) -> None:
    table = replace(struck_table(shared=True), name="Tom & <Ann>")
    written = write_webpage(table, tmp_path / "site")
    found = {str(path.relative_to(tmp_path / "site")) for path in (tmp_path / "site").rglob("*") if path.is_file()}
    assert found == {*page_files(), "field.bin", "manifest.json"} - {"page/vendor/spark.min.js"}
    assert set(written.sizes) == {tmp_path / "site" / name for name in found}
    single = tmp_path / "ball.html"
    assert write_webpage(table, single).sizes == {single: single.stat().st_size}
    for page in (single, tmp_path / "site" / "index.html"):
        assert re.findall(r"<title>(.*?)</title>", page.read_text()) == ["Tom &amp; &lt;Ann&gt;"]
    torn = {"index.html": b"<title></title><p>"}
    with raises(ExportError, file="index.html", name="import map", value=0):
        single_file(make_bundle(table), torn)
