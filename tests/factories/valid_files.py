"""Small valid files of every kind that the package reads, to be damaged: all within one folder, in a second."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import soundfile
import trimesh

from avmsf.field.store import save
from avmsf.gaussians.ply import write_splats

from .capture_folder import HEADER, RATE, fill
from .capture_folder import ring as ringing
from .clouds import random_cloud
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

SETTINGS = (
    'name = "ball"\nunit = "m"\nseconds = 0.1\nplayback_speed = 1.0\nnormalize = "auto"\nhighpass = 20.0\n'
    "align = true\nregularization = 1e-4\nresponse_channel = 1\n"
)
SURFACES = (".ply", ".obj", ".glb", ".stl", ".off")


def write_seeds(folder: Path) -> None:
    """Fill a folder: `capture` with a surface of each format beside it, `transforms`, `colmap`, and fields."""
    _write_capture(folder / "capture")
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    colored = trimesh.Trimesh(ball.vertices, ball.faces, vertex_colors=np.full((len(ball.vertices), 4), 200, np.uint8))
    for suffix in SURFACES:
        colored.export(folder / f"surface{suffix}")
    colored.export(folder / "surface_text.ply", encoding="ascii")
    embedded: Any = colored.export(file_type="gltf", embed_buffers=True)
    (folder / "surface.gltf").write_bytes(embedded["model.gltf"])
    _write_views(folder)
    write_splats(random_cloud(40, degree=1), folder / "splats.ply")
    for name, gains in (("attention", attention()), ("mixture", elastic())):
        save(sounding(gains), folder / f"{name}.safetensors")


def _write_capture(folder: Path) -> None:
    """Write three recordings of a tenth of a second, their table and settings."""
    rows = ("a.wav,0.1,0,0,0,0,1,1", "b.wav,0,0.1,0,0,0,1,2", "c.wav,0,0,0.1,0,0,1,3")
    sounds: dict[str, Any] = {f"{name}.wav": ringing(0.1, seed=seed) for seed, name in enumerate("abc")}
    fill(folder, header=f"{HEADER},nx,ny,nz,force_newtons", rows=rows, replace=sounds, settings=SETTINGS)
    for name, subtype in (("a.wav", "PCM_16"), ("c.wav", "DOUBLE")):
        soundfile.write(folder / name, sounds[name], RATE, subtype=subtype)


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
    write_colmap_text(folder / "colmap", cameras, names, lens)
    write_colmap_binary(folder / "colmap_binary", cameras, names, lens)
