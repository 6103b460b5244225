"""Folders in the layouts of published datasets, with their names, types, shapes and quirks, as the tests need them."""

import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import soundfile
import trimesh

RATE = 48_000
FRAMES = 288_000
ONSET = 48_000
ROWS = 3000
AUDIO_CONTACTS = ("0", "1", "2", "10")


@cache
def transfer(seed: int) -> np.ndarray:
    """Return the sound of a newton at 0 dB of gain, as a fraction of full scale, from the blow on."""
    generator = np.random.default_rng(seed)
    time = np.arange(FRAMES - ONSET) / RATE
    modes = np.exp(-6 * time)[:, None] * np.sin(2 * np.pi * np.array([700.0, 1900.0, 4100.0]) * time[:, None])
    return 0.02 * modes @ generator.uniform(0.4, 1.0, 3)


def place(identifier: str, contact: str) -> np.ndarray:
    """Return a contact on a sphere of 0.1 m, by the numbers of object and contact."""
    direction = np.random.default_rng([int(identifier), int(contact)]).standard_normal(3)
    return 0.1 * direction / np.linalg.norm(direction)


def write_strike(folder: Path, *, newtons: float = 5.0, gain: float = 18.0, pad: int = 1, seed: int = 0) -> None:
    """Write one contact of the raw layout: both wavs, and both notes with Windows line ends."""
    folder.mkdir(parents=True, exist_ok=True)
    sound = np.zeros(FRAMES)
    sound[ONSET:] = transfer(seed) * newtons * 10 ** ((gain - 20 * pad) / 20)
    sound[: ONSET - 100] += 1e-4 * np.random.default_rng(1000 + seed).standard_normal(ONSET - 100)
    force = np.zeros(FRAMES)
    # The first sample of the rise above a tenth of the peak is the onset.
    force[ONSET : ONSET + 24] = 0.05 * newtons * np.sin(np.pi * (np.arange(24) + 1) / 25)
    assert max(np.abs(sound).max(), np.abs(force).max()) < 1  # more would wrap round
    for name, samples in (("mic.wav", sound), ("Force.wav", force)):
        soundfile.write(folder / name, np.rint(samples * 32767).astype(np.int16), RATE, subtype="PCM_16")
    (folder / "metadata.yaml").write_bytes(f"gain:\r\n- 12\r\n- {gain:g}\r\npad:\r\n- 1\r\n- {pad}\r\n".encode())
    (folder / "striking_force.yaml").write_bytes(f"- striking_force_newtons: {newtons!r}\r\n".encode())


def write_raw(folder: Path, objects: Mapping[str, Sequence[str]], *, contacts: bool = True) -> Path:
    """Write objects of the raw layout, each impact of another force and gain, and perhaps a list of the contacts."""
    for identifier, names in objects.items():
        for order, contact in enumerate(names):
            path, gain = folder / identifier / "audio" / contact, 6.0 if order == 2 else 18.0 - 6 * (order % 2)
            write_strike(path, newtons=2.0 + order, gain=gain, pad=int(order != 2), seed=int(contact))
    if contacts:
        write_contacts(folder, objects)
    return folder


def write_contacts(folder: Path, objects: Mapping[str, Sequence[str]], *, lines: bool = True) -> Path:
    """Write the contacts as one of SonicGauss's lists, an object a line or all in one array."""
    path = folder / "objectfolder_real_train.json"
    rows = [record for identifier, names in objects.items() for record in records(identifier, names)]
    path.write_text("\n".join(map(json.dumps, rows)) if lines else json.dumps(rows))
    return path


def records(identifier: str, names: Sequence[str]) -> list[dict[str, object]]:
    """Return contacts as SonicGauss's lists have them."""
    base = f"datas/OF_Real/ObjectFolderResults/{identifier}"
    sounds = [f"{base}/audio/{identifier}_{contact}_3sec_48000hz.wav" for contact in names]
    places = [place(identifier, contact).tolist() for contact in names]
    shared = {"ply_file": f"{base}/model.ply", "duration": 3.0}
    return [{"location": sound, "contact": at, **shared} for sound, at in zip(sounds, places, strict=True)]


def write_mesh(path: Path, *, radius: float = 0.1, middle: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    """Write a sphere."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    mesh.apply_translation(middle)
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(path)
    return mesh


def microphones() -> np.ndarray:
    """Return where 600 microphones stand: angle > distance > microphone, a vertical row of 15 on an arm that turns."""
    turns, reaches = np.deg2rad(np.arange(0, 181, 20)), np.array([0.23, 0.563, 0.897, 1.23])
    turn, reach, height = np.meshgrid(turns, reaches, np.linspace(-0.91, 0.91, 15), indexing="ij")
    spot = (reach - 0.04345j) * np.exp(1j * turn)
    return np.stack([spot.real, spot.imag, height], axis=-1).reshape(-1, 3)


def write_realimpact(folder: Path, name: str) -> Path:
    """Write an object of RealImpact, each row's sound a decay as high as the row's number, over 3000, plus one."""
    home = folder / name / "preprocessed"
    mesh = write_mesh(home / "transformed.obj", radius=0.08, middle=(0.013, 0.047, 0.21))
    vertices = np.array([5, 77, 190, 333, 601])
    listeners = np.tile(microphones(), (5, 1))
    np.save(home / "vertexID.npy", np.repeat(vertices, 600).astype(np.int64))
    np.save(home / "vertexXYZ.npy", np.repeat(np.asarray(mesh.vertices)[vertices], 600, axis=0))
    np.save(home / "listenerXYZ.npy", listeners)
    sounds = np.lib.format.open_memmap(home / "deconvolved_0db.npy", mode="w+", dtype=np.float32, shape=(ROWS, 2400))
    time = np.arange(2400)
    # Sound takes a while to arrive: the first samples, which belong to the response, are faint.
    shape = np.where(time < 40, 0.01, 1) * np.exp(-time / 400) * (-1.0) ** time
    sounds[:] = (1 + np.arange(ROWS)[:, None] / ROWS) * shape
    sounds.flush()
    return home
