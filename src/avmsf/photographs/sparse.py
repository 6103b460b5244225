"""The points that structure from motion left beside its cameras."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avmsf.errors import CaptureError
from avmsf.mesh.io import load_parts
from avmsf.photographs.colmap import find_model, read_points
from avmsf.photographs.nerf_json import load_record


def read_sparse_points(
    folder: str | Path, *, meters: float = 1.0
) -> tuple[Float[Tensor, "points 3"], UInt8[Tensor, "points 3"]] | None:
    """Return the points that structure from motion found and their colors; None where there are none.

    Meters, float64. They lie in the frame of `read_views`' cameras: the COLMAP model's own points, or with a
    `transforms.json` the file that it names as `ply_file_path`. Raises CaptureError where such a file cannot be read.
    """
    folder = Path(folder)
    transforms = folder if folder.suffix.lower() == ".json" else folder / "transforms.json"
    if transforms.is_file():
        found = _read_ply(transforms)
    else:
        model = find_model(folder)
        found = None if model is None else read_points(model)
    if found is None:
        return None
    return torch.from_numpy(found[0] * meters), torch.from_numpy(found[1])


def _read_ply(transforms: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the points of the file that transforms.json names, gray where it has no colors."""
    named = load_record(transforms).get("ply_file_path")
    if not isinstance(named, str) or not named:
        return None
    path = transforms.parent / named.replace("\\", "/")
    clouds: list[Any] = load_parts(path)
    if len(clouds) != 1:
        raise CaptureError(
            f"{path} (ply_file_path of {transforms.name}): expected one point cloud, got {len(clouds)} parts",
            file=path,
            name="ply_file_path",
            value=len(clouds),
        )
    points = np.asarray(clouds[0].vertices, dtype=np.float64)
    colors = np.full((len(points), 3), 128, dtype=np.uint8)
    painted = np.asarray(getattr(clouds[0].visual, "vertex_colors", colors))
    if painted.shape[:1] == points.shape[:1]:
        colors = painted[:, :3].astype(np.uint8)
    return (points, colors) if len(points) else None
