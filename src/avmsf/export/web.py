"""The studio's page with one field: its data, and a folder for any static host, or a single file.

The data are `manifest.json`, tensors in `field.bin`, the object, its surface, measured impacts. The manifest has the
offset of each tensor in `field.bin`, little endian and row-major: points, normals, frequency, damping, sine, noise, and
cosine unless it is all zero. Dampings and frequencies are float64, because a float32 frequency has a large phase error
after a second; amplitudes are float32. Recorded impacts are float32 wav files in the field's unit.

A single file has the page's modules as data: addresses in its import map, and all other files as base64, which the
modules turn into blobs: a browser does not load other files for a page that was opened from a disk. The libraries three
and spark go with it, spark where Gaussians are shown: no network is needed.

By its Content-Security-Policy a page runs only the scripts that it was written with. One exception: data: addresses,
which a policy cannot distinguish, so that a single file would also run a script element with such an address if a flaw
in the page let data add one. Injected inline scripts and event handlers are blocked there too.
"""

import base64
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from avmsf.capture.audio import wav_bytes
from avmsf.capture.impacts import Impacts
from avmsf.errors import ExportError
from avmsf.export.geometry import ObjectKind, read_object
from avmsf.export.sampled_field import SampledField
from avmsf.export.writing import FORMATS, Written, generator, pack, write_files, write_folder
from avmsf.mesh.surface import Surface

FORMAT = 1
"""Version of this format, increased by every change that older pages cannot read."""
SURFACE = "surface.glb"
"""Name of the surface's file."""
_OBJECTS: dict[ObjectKind, str | None] = {"mesh": "object.glb", "gaussians": "object.ply", "points": None}
"""Name of the object's file."""


@dataclass(frozen=True, eq=False)
class Bundle:
    """A page's data, in memory."""

    manifest: Mapping[str, Any]
    files: Mapping[str, bytes]
    """Contents by relative path, without the manifest."""
    remarks: tuple[str, ...] = ()
    """Notes on what the page leaves out."""


def make_bundle(
    field: SampledField,
    *,
    object: Path | Surface | None = None,
    meters: float = 1.0,
    surface: Path | Surface | None = None,
    strikes: Impacts | None = None,
) -> Bundle:
    """Return a field's bundle, with options as `write_webpage`. Raises `ExportError`."""
    kind, shown, notes = read_object(object, field.extent, meters=meters)
    other, triangles, further_notes = read_object(surface, field.extent)
    content, places = pack(_tensors(field))
    files, name = {"field.bin": content}, _OBJECTS[kind]
    if name is not None:
        files[name] = shown
    if other == "mesh":
        files[SURFACE] = triangles
    records, sounds = _strikes(strikes, field)
    manifest = {
        "format": FORMAT,
        "package": version("avmsf"),
        "name": field.name,
        "sampleRate": field.sample_rate,
        "samples": field.samples,
        "perNewton": field.per_newton,
        "backgroundForce": field.background_force,
        "modes": len(field.frequency),
        "supporting": list(field.supporting),
        "points": len(field),
        "damping": "shared" if field.shared_damping else "perContact",
        "tensors": {name: {"file": "field.bin", **place} for name, place in places.items()},
        "object": {"kind": kind, "file": name},
        "strikes": records,
        "live": None,
        "surface": {"kind": "mesh", "file": SURFACE} if SURFACE in files else None,
    }
    return Bundle(manifest, {**files, **sounds}, notes + further_notes)


def _tensors(field: SampledField) -> dict[str, Shaped[np.ndarray, "..."]]:
    # JavaScript needs offsets that are multiples of the item size: float64 comes first.
    named: dict[str, Shaped[np.ndarray, ...]] = {
        "frequency": field.frequency.numpy(),
        "damping": field.damping.numpy(),
        "points": field.points.float().numpy(),
        "normals": field.normals.numpy(),
        "sine": field.gains.real.numpy(),
        "noise": field.noise.numpy(),
    }
    return {**named, "cosine": field.gains.imag.numpy()} if field.has_phases else named


def _strikes(strikes: Impacts | None, field: SampledField) -> tuple[list[dict[str, Any]], dict[str, bytes]]:
    if strikes is None:
        return [], {}
    if not isinstance(strikes, Impacts):
        raise ExportError.expected(
            "Impacts, such as avmsf.read(folder).impacts", type(strikes).__name__, name="strikes"
        )
    if strikes.sample_rate != field.sample_rate:
        wanted, advice = f"the field's {field.sample_rate:g} Hz", "name the capture that the field was fitted to"
        raise ExportError.expected(wanted, strikes.sample_rate, name="strikes", advice=advice)
    paths = [f"strikes/{row + 1:03d}.wav" for row in range(len(strikes.names))]
    directions = [None] * len(paths) if strikes.directions is None else strikes.directions.tolist()
    values = zip(strikes.names, strikes.contacts.tolist(), directions, paths, strict=True)
    records = [dict(zip(("name", "contact", "direction", "sound"), each, strict=True)) for each in values]
    rate = round(field.sample_rate)
    return records, {path: wav_bytes(sound.numpy(), rate) for path, sound in zip(paths, strikes.sounds, strict=True)}


IMPORT_MAP = re.compile(r'(<script type="importmap"[^>]*>)(.*?)(</script>)', re.DOTALL)
"""The import map, which has the addresses of three and spark."""
_SPARK = "page/vendor/spark.min.js"
"""Draws Gaussians alone, and has 2.7 MB."""
_TITLE = re.compile(r"<title>[^<]*</title>")
_STYLE = re.compile(r'<link\b[^>]*\bhref="(?:\./)?page/(\w+\.css)"[^>]*>')
_START = re.compile(r'<script type="module" src="(?:\./)?page/(\w+\.js)"[^>]*></script>')
_IMPORTED = re.compile(r"""(\bfrom\s*|\bimport\s*\(\s*|\bimport\s+)(["'])\./(\w+\.js)\2""")
MEDIA_TYPES = {
    ".aif": "audio/aiff",
    ".aiff": "audio/aiff",
    ".bin": "application/octet-stream",
    ".css": "text/css",
    ".flac": "audio/flac",
    ".glb": "model/gltf-binary",
    ".js": "text/javascript",
    ".json": "application/json",
    ".mjs": "text/javascript",
    ".mp3": "audio/mpeg",
    ".ogg": "audio/ogg",
    ".ply": "application/octet-stream",
    ".wasm": "application/wasm",
    ".wav": "audio/wav",
}
"""Media types of the page's files by suffix; no other files are included or served."""


def write_webpage(
    field: SampledField,
    output: str | Path,
    *,
    object: Path | Surface | None = None,
    meters: float = 1.0,
    surface: Path | Surface | None = None,
    strikes: Impacts | None = None,
    overwrite: bool = False,
) -> Written:
    """Write a page that plays the field: one file if `output` ends in .html, otherwise a folder.

    `object` is the geometry to show: a mesh with coordinates in units of `meters`, Gaussians, or by default the
    contacts. `surface`, in meters, is an alternative to switch to, such as the surface of the field's body. `strikes`
    are recorded impacts for comparison, as `avmsf.read(folder).impacts`. What exists is replaced only with `overwrite`.
    Raises `ExportError`.
    """
    output = Path(output)
    bundle = make_bundle(field, object=object, meters=meters, surface=surface, strikes=strikes)
    if output.suffix.lower() in FORMATS["web"].suffixes:
        return Written(write_files({output: single_file(bundle).encode()}, overwrite=overwrite), bundle.remarks)
    content = {**_needed(page_files(), bundle), **bundle.files}
    html = _titled(content["index.html"].decode(), bundle)
    content["index.html"] = with_policy(html, directives_of(html)).encode()
    return Written(write_folder(output, content, bundle.manifest, overwrite=overwrite), bundle.remarks)


def page_files() -> dict[str, bytes]:
    """Return the files of the studio's page by relative path: index.html, and all others below page/."""
    folder = files("avmsf") / "studio" / "page"
    served = (".js", ".css", ".LICENSE")
    paths = [(f"page/{each.name}", each) for each in folder.iterdir() if each.is_file()]
    paths += [(f"page/vendor/{each.name}", each) for each in (folder / "vendor").iterdir()]
    names = {name: each.read_bytes() for name, each in sorted(paths) if name.endswith(served)}
    return {"index.html": (folder / "index.html").read_bytes(), **names}


def _needed(page: Mapping[str, bytes], bundle: Bundle) -> dict[str, bytes]:
    """Return the page's files without spark where it has nothing to draw."""
    gaussians = bundle.manifest["object"]["kind"] == "gaussians"
    return {name: each for name, each in page.items() if gaussians or name != _SPARK}


def single_file(bundle: Bundle, page: Mapping[str, bytes] | None = None) -> str:
    """Return the page with bundle, styles and modules in one file. `page` is by default that of `page_files`."""
    page = _needed(page_files() if page is None else page, bundle)
    html = _titled(page["index.html"].decode(), bundle)
    html = _once(IMPORT_MAP, html, lambda found: found[1] + _carrying(found[2], page) + found[3], "import map")
    html = _STYLE.sub(lambda found: f"<style>\n{page[f'page/{found[1]}'].decode()}</style>", html)
    carried = {"manifest.json": json.dumps(bundle.manifest).encode(), "page/bank.js": page["page/bank.js"]}
    inlined = {name: _carried(name, content) for name, content in {**carried, **bundle.files}.items()}
    data = f"<script>globalThis.avmsfInlined = {json.dumps(inlined)};</script>\n"
    html = html.replace("<!doctype html>\n", f"<!doctype html>\n<!-- {generator()} -->\n", 1)
    begin = '<script type="module">import "avmsf/{}";</script>'
    html = _once(_START, html, lambda found: data + begin.format(found[1]), "script that starts the page")
    return with_policy(html, directives_of(html, single=True))


def _titled(html: str, bundle: Bundle) -> str:
    """Return the page with the object's name as its title, which is shown until the page's script runs."""
    title = f"<title>{escape(bundle.manifest['name'] or 'Sound field')}</title>"
    return _once(_TITLE, html, lambda found: title, "title")


def _carrying(words: str, page: Mapping[str, bytes]) -> str:
    """Return the import map with the page's modules and libraries as data: addresses, each once."""
    scripts = {name: each.decode() for name, each in page.items() if name.endswith(".js")}
    imports, first = dict[str, str](), dict[str, str]()
    for specifier, address in json.loads(words)["imports"].items():
        path = address.removeprefix("./")
        if path in first:
            imports[specifier] = _data_url(f'export * from "{first[path]}";')
        elif path in scripts:
            first[path], imports[specifier] = specifier, _data_url(scripts[path])
    for name, each in scripts.items():
        if name.count("/") == 1:
            # A data: address has no base for relative imports.
            imports[f"avmsf/{Path(name).name}"] = _data_url(_IMPORTED.sub(r"\1\2avmsf/\3\2", each))
    return json.dumps({"imports": imports})


def _data_url(source: str) -> str:
    return f"data:text/javascript;base64,{base64.b64encode(source.encode()).decode()}"


def _carried(name: str, content: bytes) -> dict[str, str]:
    return {"type": MEDIA_TYPES[Path(name).suffix], "base64": base64.b64encode(content).decode()}


def _once(pattern: re.Pattern[str], text: str, change: Any, what: str) -> str:
    changed, count = pattern.subn(change, text)
    if count != 1:
        raise ExportError.expected(f"one {what}", count, file="index.html", name=what, advice="install avmsf again")
    return changed


_INLINE_SCRIPT = re.compile(r"<script(?![^>]*\bsrc=)[^>]*>(.*?)</script>", re.DOTALL)
_INLINE_STYLE = re.compile(r"<style[^>]*>(.*?)</style>", re.DOTALL)
_REMOTE = re.compile(r"https://[\w.-]+")
_HEAD = re.compile(r'(<head>\s*)?<meta charset="[^"]*"\s*/?>|<head>')


def directives_of(page: str, *, single: bool = False) -> dict[str, str]:
    """Return what the studio's page may load, whose inline scripts and styles are known by their content.

    A page that is `single` carries its modules and its audio worklet as data: addresses.
    """
    scripts = _INLINE_SCRIPT.findall(page)
    remote = sorted({address for each in scripts for address in _REMOTE.findall(each)})
    own = ["'self'", "'wasm-unsafe-eval'", *(["data:"] if single else [])]
    return {
        "default-src": "'none'",
        # Spark computes in WebAssembly.
        "script-src": " ".join([*own, *_hashes(scripts), *remote]),
        "style-src": " ".join(["'self'", *_hashes(_INLINE_STYLE.findall(page))]),
        # Spark carries its worker and its WebAssembly within itself, and textures of a mesh become blobs.
        "worker-src": "'self' blob:",
        **dict.fromkeys(("connect-src", "img-src"), "'self' blob: data:"),
        "media-src": "'self' blob:",
        **dict.fromkeys(("base-uri", "form-action"), "'none'"),
    }


def report_directives(page: str) -> dict[str, str]:
    """Return what a report may load: its own script and style, and the pictures and sounds that it carries."""
    return {
        "default-src": "'none'",
        "script-src": " ".join(_hashes(_INLINE_SCRIPT.findall(page))),
        "style-src": " ".join(_hashes(_INLINE_STYLE.findall(page))),
        **dict.fromkeys(("img-src", "media-src"), "data:"),
        **dict.fromkeys(("base-uri", "form-action"), "'none'"),
    }


def policy_text(directives: Mapping[str, str]) -> str:
    """Return directives as a header or a meta element has them."""
    return "; ".join(f"{name} {sources}" for name, sources in directives.items())


def with_policy(page: str, directives: Mapping[str, str]) -> str:
    """Return the page with its policy at the beginning of its head. Raises ExportError for a page without a head."""
    meta = f'<meta http-equiv="Content-Security-Policy" content="{escape(policy_text(directives))}">'
    changed, count = _HEAD.subn(lambda found: f"{found[0]}\n{meta}", page, count=1)
    if not count:
        raise ExportError.expected("a head", file="index.html", name="head", advice="install avmsf again")
    return changed


def _hashes(contents: Sequence[str]) -> list[str]:
    return [f"'sha256-{base64.b64encode(hashlib.sha256(each.encode()).digest()).decode()}'" for each in contents]
