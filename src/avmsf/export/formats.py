"""The formats that a field is written in, and what their files are called: imports nothing that computes."""

from typing import Literal

Format = Literal["web", "gltf", "faust", "avmsf-demo", "wavs", "uff"]
Precision = Literal["float16", "float32"]
Axis = Literal["x", "y", "z"]
MOST_POINTS = 20_000
"""Contacts that a page gets unless more are asked for: 128 modes at each are 20 MB."""
POINTS: dict[Format, int] = {
    "web": MOST_POINTS,
    "gltf": 2000,
    "faust": 64,
    "avmsf-demo": 10_000,
    "wavs": 16,
    "uff": 1000,
}
"""Contacts that are written by default: as many as the format's tools read without effort."""
PAGE_SUFFIXES = (".html", ".htm")
"""Endings of a page in one file."""
GLTF_SUFFIXES = (".glb",)
FAUST_SUFFIXES = (".dsp", ".lib")
UNIVERSAL_SUFFIXES = (".uff", ".unv")
