"""Names, suffixes and default sizes of the export formats. Imports no numerical library."""

from typing import Literal

Format = Literal["web", "gltf", "faust", "avmsf-demo", "wavs", "uff"]
Precision = Literal["float16", "float32"]
Axis = Literal["x", "y", "z"]
MAX_POINTS = 20_000
"""Default number of contacts of a page: 20 MB with 128 modes."""
POINTS: dict[Format, int] = {
    "web": MAX_POINTS,
    "gltf": 2000,
    "faust": 64,
    "avmsf-demo": 10_000,
    "wavs": 16,
    "uff": 1000,
}
"""Default number of contacts of each format, which its tools read quickly."""
PAGE_SUFFIXES = (".html", ".htm")
"""Suffixes of a page in one file."""
GLTF_SUFFIXES = (".glb",)
FAUST_SUFFIXES = (".dsp", ".lib")
UNIVERSAL_SUFFIXES = (".uff", ".unv")
