"""What the page may load and run: its own files, its two libraries, and nothing that a name or a remark brings in."""

import base64
import hashlib
import re

_INLINE = re.compile(r"<script(?![^>]*\bsrc=)[^>]*>(.*?)</script>", re.DOTALL)
_REMOTE = re.compile(r"https://[\w.-]+")
NOTHING = "default-src 'none'; frame-ancestors 'none'"
"""Of all that is no page: whoever opens it as one gets nothing to run."""


def policy_of(page: str) -> str:
    """Return the Content-Security-Policy of the page's HTML, whose inline scripts are known by their content."""
    inline = _INLINE.findall(page)
    known = [f"'sha256-{base64.b64encode(hashlib.sha256(each.encode()).digest()).decode()}'" for each in inline]
    remote = sorted({address for each in inline for address in _REMOTE.findall(each)})
    allowed = {
        "default-src": ["'none'"],
        # Spark computes in WebAssembly.
        "script-src": ["'self'", "'wasm-unsafe-eval'", *known, *remote],
        "style-src": ["'self'"],
        # Spark carries its worker and its WebAssembly within itself, and textures of a mesh become blobs.
        "worker-src": ["'self'", "blob:"],
        "connect-src": ["'self'", "blob:", "data:"],
        "img-src": ["'self'", "blob:", "data:"],
        "media-src": ["'self'", "blob:"],
        "base-uri": ["'none'"],
        "form-action": ["'none'"],
        "frame-ancestors": ["'none'"],
    }
    return "; ".join(" ".join([name, *sources]) for name, sources in allowed.items())
