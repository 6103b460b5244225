"""The page as a folder and as one file, without a browser; `tests/studio` opens both."""

import base64
import json
import re
from dataclasses import replace
from pathlib import Path

from avmsf.errors import ExportError
from avmsf.export.bundle import make_bundle
from avmsf.export.web import page_files, single_file, write_webpage
from factories.raising import raises
from factories.struck_table import struck_table

PAGE = {
    "index.html": b"""<head><title>studio</title><link rel="stylesheet" href="page/style.css">
<script type="importmap">{"imports": {"three": "./page/vendor/three.js",
"three/addons/a.js": "./page/vendor/three.js"}}</script>
<script type="module" src="page/main.js"></script></head>""",
    "page/style.css": b"p { color: red }",
    "page/main.js": b"""import { a } from "./a.js";\nconst b = await import( './b.js' );\nimport "three";\n""",
    "page/a.js": b"export const a = new URL('./a.js', import.meta.url);",
    "page/b.js": b'export * from "./a.js";',
    "page/bank.js": b"",
    "page/vendor/three.js": b"export const scene = 1;",
}


def imports_of(html: str) -> dict[str, str]:
    return json.loads(re.search(r'<script type="importmap">(.*?)</script>', html)[1])["imports"]


def source_of(url: str) -> str:
    return base64.b64decode(url.removeprefix("data:text/javascript;base64,")).decode()


def test_one_file_holds_all_that_lay_beside_the_page() -> None:
    bundle = make_bundle(struck_table(shared=True))
    html = single_file(bundle, PAGE)
    imports = imports_of(html)
    assert source_of(imports["three"]) == "export const scene = 1;"
    # Two names of one file are one module.
    assert source_of(imports["three/addons/a.js"]) == 'export * from "three";'
    assert source_of(imports["avmsf/main.js"]) == (
        """import { a } from "avmsf/a.js";\nconst b = await import( 'avmsf/b.js' );\nimport "three";\n"""
    )
    assert source_of(imports["avmsf/b.js"]) == 'export * from "avmsf/a.js";'
    # An address is no import.
    assert source_of(imports["avmsf/a.js"]) == PAGE["page/a.js"].decode()
    assert "<style>\np { color: red }</style>" in html
    assert 'import "avmsf/main.js";' in html
    assert "page/" not in re.sub(r"avmsfInlined = .*", "", html)
    inlined = json.loads(re.search(r"avmsfInlined = (.*?);</script>", html)[1])
    assert json.loads(base64.b64decode(inlined["manifest.json"]["base64"])) == bundle.manifest
    assert base64.b64decode(inlined["field.bin"]["base64"]) == bundle.files["field.bin"]


def test_both_forms_are_written_whole_and_kept_from_others(tmp_path: Path) -> None:
    table = replace(struck_table(shared=True), name="Tom & <Ann>")
    written = write_webpage(table, tmp_path / "site")
    found = {str(path.relative_to(tmp_path / "site")) for path in (tmp_path / "site").rglob("*") if path.is_file()}
    assert found == {*page_files(), "field.bin", "manifest.json"} - {"page/vendor/spark.min.js"}
    assert set(written.sizes) == {tmp_path / "site" / name for name in found}
    single = tmp_path / "ball.html"
    assert write_webpage(table, single).sizes == {single: single.stat().st_size}
    for page in (single, tmp_path / "site" / "index.html"):
        assert re.findall(r"<title>(.*?)</title>", page.read_text()) == ["Tom &amp; &lt;Ann&gt;"]
    torn = {**PAGE, "index.html": b"<title></title><p>"}
    with raises(ExportError, file="index.html", name="import map", value=0):
        single_file(make_bundle(table), torn)
    other = tmp_path / "mine.html"
    other.write_text("mine")
    with raises(ExportError, file=other, name="--overwrite"):
        write_webpage(table, other)
    assert other.read_text() == "mine"
