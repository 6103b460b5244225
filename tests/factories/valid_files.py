"""Small valid files of every kind that the package reads, to be damaged: all within one folder, in a second."""

import json
import math
import shutil
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import soundfile
import torch
import trimesh
from torch import Tensor

from avmsf.features.feature_field import FeatureField
from avmsf.fem.elastic_modes import elastic_modes
from avmsf.fem.material import NOMINAL
from avmsf.fem.walls import shell
from avmsf.field.config import AttentionShape
from avmsf.field.gains.attention import AttentionGains
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.fitting import MeasuredGains, fit_mixture
from avmsf.field.gains.kernels import Sites, Smooth, ThinPlate, Unstructured
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import save
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.ply import write_splats
from avmsf.mesh import Surface
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual

RATE = 8000
CONTACTS = ((0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1))
SURFACES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")
PICTURE = 32


def write_seeds(folder: Path) -> None:
    """Fill a folder: `capture` with a surface of each format beside it, `transforms`, `colmap`, and fields."""
    write_capture_folder(folder / "capture")
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    colored = trimesh.Trimesh(ball.vertices, ball.faces, vertex_colors=np.full((len(ball.vertices), 4), 200, np.uint8))
    for suffix in SURFACES:
        (folder / f"surface{suffix}").write_bytes(_exported(colored, suffix[1:]))
    text = colored.export(file_type="ply", encoding="ascii")
    (folder / "surface_text.ply").write_bytes(text if isinstance(text, bytes) else str(text).encode())
    _write_views(folder)
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
    rotations = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(40, 1)
    cloud = GaussianCloud(points, rotations, points - 4, points[:, 0], torch.zeros(40, 4, 3))
    write_splats(cloud, folder / "splats.ply")
    _write_fields(folder)


def write_capture_folder(folder: Path) -> None:
    """Write three recordings of a tenth of a second, their table and settings."""
    folder.mkdir(parents=True)
    rows = ["file,x,y,z,nx,ny,nz,force_newtons"]
    times = np.arange(RATE // 10) / RATE
    for number, contact in enumerate(CONTACTS):
        sound = 0.4 * np.exp(-40 * times) * np.sin(2 * math.pi * (400 + 150 * number) * times)
        noise = 1e-4 * np.random.default_rng(number).standard_normal(len(times))
        subtype = ("PCM_16", "FLOAT", "DOUBLE")[number]
        soundfile.write(folder / f"{number}.wav", sound + noise, RATE, subtype=subtype)
        rows.append(f"{number}.wav,{','.join(map(str, contact))},0,0,1,{number + 1}")
    (folder / "impacts.csv").write_text("\n".join([*rows, ""]))
    (folder / "capture.toml").write_text(
        'name = "ball"\nunit = "m"\nseconds = 0.1\nplayback_speed = 1.0\nnormalize = "auto"\nhighpass = 20.0\n'
        "align = true\nregularization = 1e-4\nresponse_channel = 1\n"
    )


def _exported(mesh: trimesh.Trimesh, kind: str) -> bytes:
    # The buffers of a glTF are files of their own otherwise.
    options: dict[str, Any] = {"embed_buffers": True} if kind == "gltf" else {}
    content = mesh.export(file_type=kind, **options)
    if isinstance(content, dict):
        (content,) = content.values()
    return content if isinstance(content, bytes) else str(content).encode()


def _write_views(folder: Path) -> None:
    """Write four photographs with masks and cameras, in the layouts of nerfstudio and of COLMAP, text and binary."""
    picture = np.full((PICTURE, PICTURE, 3), 20, np.uint8)
    cv2.circle(picture, (PICTURE // 2, PICTURE // 2), PICTURE // 4, (40, 200, 90), -1)
    mask = np.where(picture[..., 1] > 100, 255, 0).astype(np.uint8)
    frames, lines = [], []
    for number, suffix in enumerate((".png", ".jpg", ".webp", ".png")):
        angle = number * math.pi / 2
        pose = np.eye(4)
        cosine, sine = math.cos(angle), math.sin(angle)
        pose[:3, :3] = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
        pose[:3, 3] = 0.5 * pose[:3, 2]
        for place in ("transforms", "colmap"):
            for kind, pixels in (("images", picture), ("masks", mask)):
                path = folder / place / kind / f"{number}{suffix if kind == 'images' else '.png'}"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(cv2.imencode(path.suffix, pixels)[1].tobytes())
        frames.append({"file_path": f"images/{number}{suffix}", "transform_matrix": pose.tolist()})
        turn = (math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0)
        lines += [f"{number + 1} {' '.join(map(str, turn))} 0 0 0.5 1 {number}{suffix}", "1.5 2.5 -1"]
    camera = {"fl_x": 40.0, "fl_y": 40.0, "cx": 16.0, "cy": 16.0, "w": PICTURE, "h": PICTURE, "k1": 0.01}
    record = {"camera_model": "OPENCV", **camera, "ply_file_path": "../surface.ply", "frames": frames}
    (folder / "transforms" / "transforms.json").write_text(json.dumps(record))
    sparse = folder / "colmap" / "sparse" / "0"
    sparse.mkdir(parents=True)
    (sparse / "cameras.txt").write_text(f"1 OPENCV {PICTURE} {PICTURE} 40 40 16 16 0.01 0 0 0\n")
    (sparse / "images.txt").write_text("\n".join([*lines, ""]))
    (sparse / "points3D.txt").write_text("1 0.1 0 0 200 100 50 0.5 1 0\n2 0 0.1 0 200 100 50 0.5 2 0\n")
    _write_binary_model(folder / "colmap", folder / "colmap_binary")


def _write_binary_model(text: Path, binary: Path) -> None:
    """Write the same model in COLMAP's binary form."""
    shutil.copytree(text, binary)
    sparse = binary / "sparse" / "0"
    cameras = struct.pack("<QIiQQ8d", 1, 1, 4, PICTURE, PICTURE, 40, 40, 16, 16, 0.01, 0, 0, 0)
    images = struct.pack("<Q", 4)
    for row, line in enumerate((sparse / "images.txt").read_text().splitlines()[::2]):
        *numbers, _, name = line.split()
        images += struct.pack("<I7dI", row + 1, *map(float, numbers[1:]), 1) + name.encode() + b"\0"
        images += struct.pack("<Q2dQ", 1, 1.5, 2.5, 2**64 - 1)
    points = struct.pack("<QQ3d3BdQII", 1, 1, 0.1, 0, 0, 200, 100, 50, 0.5, 1, 1, 0)
    for name, content in (("cameras", cameras), ("images", images), ("points3D", points)):
        (sparse / f"{name}.txt").unlink()
        (sparse / f"{name}.bin").write_bytes(content)


def _write_fields(folder: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(60, 3, dtype=torch.float64, generator=generator) / 5
    bank = ModalBank(
        torch.tensor([400.0, 900.0, 1500.0], dtype=torch.float64), torch.tensor([20.0, 30.0, 50.0], dtype=torch.float64)
    )
    shape = AttentionShape(4, 1, 4, 6, 1, feature_scale=4.0)
    network = AttentionGains(
        FeatureField.from_points(points), gain_scale=torch.ones(3), shape=shape, generator=generator
    )
    mixture = mixture_gains(points[:12], bank, points.float())
    for name, gains in (("attention", network.eval().requires_grad_(False)), ("mixture", mixture)):
        residual = Residual(torch.full((17,), 1e-3))
        phase = torch.zeros(3, dtype=torch.float64)
        save(SoundField(bank, gains, phase, residual, 8000.0, 800, Origin("ball")), folder / f"{name}.safetensors")


def mixture_gains(contacts: Tensor, bank: ModalBank, points: Tensor) -> MixtureGains:
    """Return a gain model of every family, with a sheet of 0.2 m as the body."""
    size = float((points.amax(0) - points.amin(0)).norm())
    sites = Sites(contacts, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand(len(contacts), 3))
    corners = 0.2 * torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    sheet = shell(Surface(corners, torch.tensor([[0, 1, 2], [0, 2, 3]])), thickness=0.004, detail=0.5)
    body = Elastic(sites, size, elastic_modes(sheet, NOMINAL, count=5))
    families = [*(each(sites, size) for each in (Unstructured, Smooth, ThinPlate)), body]
    # The body's own gains, or its family would be left out.
    values = body.modes.gains(sites.points, sites.directions)[:, : len(bank)].to(torch.complex128)
    variance = torch.full((len(bank),), 1e-4, dtype=torch.float64)
    measured = MeasuredGains(values, variance, bank.frequency, bank.damping)
    return fit_mixture(families, measured, points, directional=True)
