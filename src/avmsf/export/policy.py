"""Content-Security-Policy of pages: a page runs only the scripts that it was written with.

One exception: a page in a single file has its modules as data: addresses, which a policy cannot distinguish from
others. It would also run a script element with such an address if a flaw in the page let data add one. Injected inline
scripts and event handlers are blocked there too.
"""

import base64
import hashlib
import re
from collections.abc import Mapping, Sequence
from html import escape

from avmsf.errors import ExportError

_SCRIPT = re.compile(r"<script(?![^>]*\bsrc=)[^>]*>(.*?)</script>", re.DOTALL)
_STYLE = re.compile(r"<style[^>]*>(.*?)</style>", re.DOTALL)
_REMOTE = re.compile(r"https://[\w.-]+")
_HEAD = re.compile(r'(<head>\s*)?<meta charset="[^"]*"\s*/?>|<head>')


def directives_of(page: str, *, single: bool = False) -> dict[str, list[str]]:
    """Return what the studio's page may load, whose inline scripts and styles are known by their content.

    A page that is `single` carries its modules and its audio worklet as data: addresses.
    """
    scripts = _SCRIPT.findall(page)
    remote = sorted({address for each in scripts for address in _REMOTE.findall(each)})
    carried = ["data:"] if single else []
    return {
        "default-src": ["'none'"],
        # Spark computes in WebAssembly.
        "script-src": ["'self'", "'wasm-unsafe-eval'", *carried, *_hashes(scripts), *remote],
        "style-src": ["'self'", *_hashes(_STYLE.findall(page))],
        # Spark carries its worker and its WebAssembly within itself, and textures of a mesh become blobs.
        "worker-src": ["'self'", "blob:"],
        "connect-src": ["'self'", "blob:", "data:"],
        "img-src": ["'self'", "blob:", "data:"],
        "media-src": ["'self'", "blob:"],
        "base-uri": ["'none'"],
        "form-action": ["'none'"],
    }


def report_directives(page: str) -> dict[str, list[str]]:
    """Return what a report may load: its own script and style, and the pictures and sounds that it carries."""
    return {
        "default-src": ["'none'"],
        "script-src": _hashes(_SCRIPT.findall(page)),
        "style-src": _hashes(_STYLE.findall(page)),
        "img-src": ["data:"],
        "media-src": ["data:"],
        "base-uri": ["'none'"],
        "form-action": ["'none'"],
    }


def policy_text(directives: Mapping[str, Sequence[str]]) -> str:
    """Return directives as a header or a meta element has them."""
    return "; ".join(" ".join([name, *sources]) for name, sources in directives.items())


def with_policy(page: str, directives: Mapping[str, Sequence[str]]) -> str:
    """Return the page with its policy at the beginning of its head. Raises ExportError for a page without a head."""
    meta = f'<meta http-equiv="Content-Security-Policy" content="{escape(policy_text(directives))}">'
    changed, count = _HEAD.subn(lambda found: f"{found[0]}\n{meta}", page, count=1)
    if not count:
        raise ExportError("index.html: expected a head, got none; install avmsf again", file="index.html", name="head")
    return changed


def _hashes(contents: Sequence[str]) -> list[str]:
    return [f"'sha256-{base64.b64encode(hashlib.sha256(each.encode()).digest()).decode()}'" for each in contents]
