"""Small files that unfold to large ones or claim to be: each once took seconds to minutes, gigabytes, or a traceback.

Each bomb puts one file into a copy of the seeds and returns the family that reads it, and its path.
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

from tests.factories.valid_files import RATE

Bomb = Callable[[Path], tuple[str, Path]]


def _sound(samples: np.ndarray) -> Bomb:
    def put(folder: Path) -> tuple[str, Path]:
        soundfile.write(folder / "capture" / "1.wav", samples, RATE, subtype="DOUBLE")
        return "wav", folder / "capture" / "1.wav"

    return put


def _click(height: float = 1.0) -> np.ndarray:
    samples = np.zeros(RATE)
    samples[0] = height
    return samples


def _compressed_sound(folder: Path) -> tuple[str, Path]:
    path = folder / "capture" / "1.wav"
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


def _many_rows(folder: Path) -> tuple[str, Path]:
    path = folder / "capture" / "impacts.csv"
    path.write_text("file,x,y,z\n" + "".join(f"{number}.wav,{number / 1e7},0,0\n" for number in range(300_000)))
    return "csv", path


def _nested(name: str, family: str, text: str) -> Bomb:
    def put(folder: Path) -> tuple[str, Path]:
        (folder / name).write_text(text)
        return family, folder / name

    return put


def _frames(count: int, *, equal: bool) -> Bomb:
    def put(folder: Path) -> tuple[str, Path]:
        path = folder / "transforms" / "transforms.json"
        record = json.loads(path.read_text())
        first = record["frames"][0]
        names = ["images/0.png" if equal else f"images/none_{number}.png" for number in range(count)]
        path.write_text(json.dumps(record | {"frames": [first | {"file_path": name} for name in names]}))
        return "transforms", path

    return put


def _picture(name: str, side: int) -> Bomb:
    """Return a square PNG of one bit a pixel, all black."""

    def put(folder: Path) -> tuple[str, Path]:
        def chunk(kind: bytes, data: bytes) -> bytes:
            return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

        packer = zlib.compressobj(9)
        row = bytes(1 + (side + 7) // 8)
        data = b"".join(packer.compress(row) for _ in range(side)) + packer.flush()
        header = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0))
        path = folder / "transforms" / name
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", data) + chunk(b"IEND", b""))
        return "pictures", path

    return put


def _surface(suffix: str, content: Callable[[], bytes]) -> Bomb:
    def put(folder: Path) -> tuple[str, Path]:
        (folder / f"surface{suffix}").write_bytes(content())
        return suffix[1:], folder / f"surface{suffix}"

    return put


def _glb(record: dict[str, object], binary: bytes = bytes(64)) -> bytes:
    text = json.dumps({"asset": {"version": "2.0"}, "scene": 0, **record}).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _many_nodes() -> bytes:
    corners = np.eye(3, dtype="<f4").tobytes()
    accessor = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
    return _glb(
        {
            "scenes": [{"nodes": list(range(20_000))}],
            "nodes": [{"mesh": 0, "name": f"n{number}"} for number in range(20_000)],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 4}]}],
            "accessors": [accessor],
            "bufferViews": [{"buffer": 0, "byteLength": len(corners)}],
            "buffers": [{"byteLength": len(corners)}],
        },
        corners,
    )


def _empty_accessor() -> bytes:
    return _glb(
        {
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 4}]}],
            "accessors": [{"componentType": 5126, "count": 100_000_000, "type": "VEC3"}],
            "buffers": [{"byteLength": 64}],
        }
    )


def _wrong_index(index: int) -> Callable[[], bytes]:
    return lambda: (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        f"0 0 0\n0.1 0 0\n0 0.1 0\n3 0 1 2\n3 0 1 {index}\n"
    ).encode()


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


_TOML = "a = " + "[" * 3000 + "]" * 3000
BOMBS: dict[str, Bomb] = {
    "click, then digital silence": _sound(_click()),
    "peak of 1e200": _sound(_click(1e200)),
    "peak of 1e-300": _sound(_click(1e-300)),
    "peak of 1e40": _sound(_click(1e40)),
    "two hours of 8 channels in a megabyte": _compressed_sound,
    "8000 misspelt names among 1000 files": _misspelt_rows,
    "300,000 rows": _many_rows,
    "TOML 3000 levels deep": _nested("capture/capture.toml", "toml", _TOML),
    "TOML with a key of 60,000 parts": _nested("capture/capture.toml", "toml", ".".join("a" * 60_000) + " = 1"),
    "JSON 100,000 levels deep": _nested("transforms/transforms.json", "transforms", "[" * 100_000),
    "40,000 missing frames": _frames(40_000, equal=False),
    "100,000 equal frames": _frames(100_000, equal=True),
    "picture of 30016 x 30016": _picture("images/0.png", 30_016),
    "mask of 30016 x 30016": _picture("masks/0.png", 30_016),
    "glb with 20,000 nodes": _surface(".glb", _many_nodes),
    "glb accessor of 1e8 without data": _surface(".glb", _empty_accessor),
    "ply face beyond its vertices": _surface(".ply", _wrong_index(99)),
    "ply face of a negative vertex": _surface(".ply", _wrong_index(-9)),
    "field metadata 100,000 levels deep": _field("nested", 0),
    "field of 1e9 samples": _field("samples", 10**9),
    "field of 1e12 samples": _field("samples", 10**12),
    "field at 1e300 Hz": _field("sample_rate", 1e300),
    "field with noise of 1e38": _field("residual", 1e38),
}
