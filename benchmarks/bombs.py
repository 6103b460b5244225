"""Small files that unfold to large ones or claim to be: each once took seconds to minutes, gigabytes, or a traceback.

Each bomb puts one file into a copy of the valid files and returns the family that reads it, and its path.
"""

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import soundfile
from safetensors.torch import load as from_bytes
from safetensors.torch import save as to_bytes

from tests.factories.capture_folder import RATE

Bomb = Callable[[Path], tuple[str, Path]]


def _file(family: str, name: str, content: Callable[[], str | bytes]) -> Bomb:
    """Return a bomb that writes one file."""

    def put(folder: Path) -> tuple[str, Path]:
        made = content()
        (folder / name).write_bytes(made.encode() if isinstance(made, str) else made)
        return family, folder / name

    return put


def _click(height: float) -> Bomb:
    """Return a second of digital silence after one sample."""

    def put(folder: Path) -> tuple[str, Path]:
        samples = np.zeros(RATE)
        samples[0] = height
        soundfile.write(folder / "capture" / "b.wav", samples, RATE, subtype="DOUBLE")
        return "wav", folder / "capture" / "b.wav"

    return put


def _compressed_sound(folder: Path) -> tuple[str, Path]:
    path = folder / "capture" / "b.wav"
    with soundfile.SoundFile(path, "w", 48_000, 8, subtype="PCM_16", format="FLAC") as file:
        # Two hours of silence, a minute at a time.
        for _ in range(120):
            file.write(np.zeros((60 * 48_000, 8), dtype=np.int16))
    return "wav", path


def _misspelt_rows(folder: Path) -> tuple[str, Path]:
    path = folder / "capture" / "impacts.csv"
    for number in range(1000):
        (folder / "capture" / f"recording_{number:04d}.wav").write_bytes(b"")
    rows = [f"recordng_{number:04d}.wav,{number / 1e4},0,0" for number in range(8000)]
    path.write_text("\n".join(["file,x,y,z", *rows]))
    return "csv", path


def _many_rows() -> str:
    return "file,x,y,z\n" + "".join(f"{number}.wav,{number / 1e7},0,0\n" for number in range(300_000))


def _frames(names: Callable[[], list[str]]) -> Bomb:
    """Return a record of cameras with so many pictures."""

    def put(folder: Path) -> tuple[str, Path]:
        path = folder / "transforms" / "transforms.json"
        record = json.loads(path.read_text())
        first = record["frames"][0]
        path.write_text(json.dumps(record | {"frames": [first | {"file_path": name} for name in names()]}))
        return "transforms", path

    return put


def _picture() -> bytes:
    """Return a square PNG of one bit a pixel, all black."""
    side = 30_016

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    row = bytes(1 + (side + 7) // 8)
    data = b"".join(packer.compress(row) for _ in range(side)) + packer.flush()
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def _glb(nodes: int, accessor: dict[str, object], binary: bytes) -> bytes:
    """Return a container with so many nodes of one mesh, whose positions are the accessor's."""
    record = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": list(range(nodes))}],
        "nodes": [{"mesh": 0, "name": f"n{number}"} for number in range(nodes)],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 4}]}],
        "accessors": [{"componentType": 5126, "type": "VEC3", **accessor}],
        "bufferViews": [{"buffer": 0, "byteLength": len(binary)}],
        "buffers": [{"byteLength": len(binary)}],
    }
    text = json.dumps(record).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _many_nodes() -> bytes:
    return _glb(20_000, {"bufferView": 0, "count": 3}, np.eye(3, dtype="<f4").tobytes())


def _wrong_index(index: int) -> Bomb:
    text = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        f"0 0 0\n0.1 0 0\n0 0.1 0\n3 0 1 2\n3 0 1 {index}\n"
    )
    return _file("ply", "surface.ply", lambda: text)


def _field(name: str, value: float) -> Bomb:
    """Return a field whose header says another value."""

    def put(folder: Path) -> tuple[str, Path]:
        path = folder / "mixture.safetensors"
        content = path.read_bytes()
        metadata = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])["__metadata__"]
        record, tensors = json.loads(metadata["avmsf"]) | {name: value}, from_bytes(content)
        if name == "residual":
            tensors["residual.magnitude"][:] = value
            del record[name]
        text = "[" * 100_000 if name == "nested" else json.dumps(record)
        path.write_bytes(to_bytes(tensors, metadata | {"avmsf": text}))
        return "field", path

    return put


BOMBS: dict[str, Bomb] = {
    "click, then digital silence": _click(1.0),
    "peak of 1e200": _click(1e200),
    "peak of 1e-300": _click(1e-300),
    "peak of 1e40": _click(1e40),
    "two hours of 8 channels in a megabyte": _compressed_sound,
    "8000 misspelt names among 1000 files": _misspelt_rows,
    "300,000 rows": _file("csv", "capture/impacts.csv", _many_rows),
    "TOML 3000 levels deep": _file("toml", "capture/capture.toml", lambda: "a = " + "[" * 3000 + "]" * 3000),
    "TOML with a key of 60,000 parts": _file("toml", "capture/capture.toml", lambda: ".".join("a" * 60_000) + " = 1"),
    "JSON 100,000 levels deep": _file("transforms", "transforms/transforms.json", lambda: "[" * 100_000),
    "40,000 missing frames": _frames(lambda: [f"images/none_{number}.png" for number in range(40_000)]),
    "100,000 equal frames": _frames(lambda: ["images/0.png"] * 100_000),
    "picture of 30016 x 30016": _file("pictures", "transforms/images/0.png", _picture),
    "mask of 30016 x 30016": _file("pictures", "transforms/masks/0.png", _picture),
    "glb with 20,000 nodes": _file("glb", "surface.glb", _many_nodes),
    "glb accessor of 1e8 without data": _file("glb", "surface.glb", lambda: _glb(1, {"count": 10**8}, bytes(64))),
    "ply face beyond its vertices": _wrong_index(99),
    "ply face of a negative vertex": _wrong_index(-9),
    "field metadata 100,000 levels deep": _field("nested", 0),
    "field of 1e9 samples": _field("samples", 10**9),
    "field of 1e12 samples": _field("samples", 10**12),
    "field at 1e300 Hz": _field("sample_rate", 1e300),
    "field with noise of 1e38": _field("residual", 1e38),
}
