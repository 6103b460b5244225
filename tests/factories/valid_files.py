"""Small valid files of every kind that the package reads, to be damaged: all within one folder, in a second."""

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import soundfile
import torch
import trimesh

from avmsf.field.store import save
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.ply import write_splats

from .made_fields import attention, elastic, sounding
from .views_folder import (
    HEIGHT,
    WIDTH,
    frames,
    ring,
    write_colmap_binary,
    write_colmap_text,
    write_image,
    write_transforms,
)

RATE = 8000
CONTACTS = ((0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1))
SURFACES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")


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
    for name, gains in (("attention", attention()), ("mixture", elastic())):
        save(sounding(gains), folder / f"{name}.safetensors")


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
    names, cameras = ["0.png", "1.jpg", "2.webp", "3.png"], ring(4)
    mask = cv2.circle(np.zeros((HEIGHT, WIDTH), np.uint8), (WIDTH // 2, HEIGHT // 2), HEIGHT // 4, 255, -1)
    for place in ("transforms", "colmap", "colmap_binary"):
        for name in names:
            write_image(folder / place / "images" / name)
            write_image(folder / place / "masks" / f"{name[0]}.png", mask)
    rows = [row | {"file_path": f"images/{name}"} for row, name in zip(frames(cameras), names, strict=True)]
    settings = {"camera_model": "OPENCV", "k1": 0.01, "ply_file_path": "../surface.ply"}
    write_transforms(folder / "transforms", rows, images=False, **settings)
    lens = ("OPENCV", (40.0, 40.0, 16.0, 16.0, 0.01, 0.0, 0.0, 0.0))
    write_colmap_text(folder / "colmap" / "sparse" / "0", cameras, names, lens)
    write_colmap_binary(folder / "colmap_binary" / "sparse" / "0", cameras, names, lens)
