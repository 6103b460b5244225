"""A plate in closed form and its page: a folder to be served, a browser of its own, and answers for the server."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import trimesh

from avmsf.capture.impacts import Impacts
from avmsf.export.sampled_field import SampledField
from avmsf.export.web import make_bundle
from avmsf.export.writing import write_folder
from avmsf.gaussians.ply import write_splats
from avmsf.gaussians.start_points import StartPoints, starting_cloud
from avmsf.studio.server import PAGE
from served import blow

if TYPE_CHECKING:
    from playwright.sync_api import Page, Route

SIDES = (0.24, 0.16, 0.02)
LARGER = 1.1
"""Size of the plate's reconstructed surface over its own, so that it is seen which of them is shown."""
WAVES = ((1, 0), (0, 1), (1, 1), (2, 0), (2, 1), (3, 1))
"""Half waves along and across the plate, one pair a mode."""
ACROSS, ALONG = 21, 31
"""Contacts on each of both large faces."""
RATE = 16_000.0
FIELD_ABILITIES = ["locate", "edit", "save", "like"]
LIVE = {"revision": 1, "undo": False, "abilities": FIELD_ABILITIES, "mode": "field", "rows": [0, 1, 2, 3, 4, 5]}
LIVE |= {"materials": ["ceramic", "glass", "wood", "iron", "steel"], "oldMaterial": "Present material"}
Open = Callable[..., "Page"]


def plate_table() -> SampledField:
    """Return a plate struck on a regular grid: cosines whose pitches are 400 Hz apart, all in sine phase."""
    x, y = torch.meshgrid(
        torch.linspace(-0.5, 0.5, ALONG) * SIDES[0], torch.linspace(-0.5, 0.5, ACROSS) * SIDES[1], indexing="ij"
    )
    face = torch.stack([x.flatten(), y.flatten(), torch.full((ALONG * ACROSS,), SIDES[2] / 2)], dim=1)
    points = torch.cat([face, face * torch.tensor([1.0, 1.0, -1.0])])
    normals = torch.zeros_like(points)
    normals[:, 2] = points[:, 2].sign()
    order = torch.arange(1, len(WAVES) + 1, dtype=torch.float64)
    shapes = plate_shapes(points) / order.float() + 0j
    return SampledField(points, normals, 400.0 * order, 4.0 * order, shapes, torch.zeros(8000), RATE, name="Plate")


def plate_shapes(points: torch.Tensor) -> torch.Tensor:
    """Return each mode's shape, at most 1."""
    along, across = (points[:, axis] / SIDES[axis] + 0.5 for axis in (0, 1))
    return torch.stack([(math.pi * a * along).cos() * (math.pi * b * across).cos() for a, b in WAVES], dim=1)


def plate_strikes(table: SampledField) -> Impacts:
    """Return recordings of blows at some contacts, which are the model's own sounds."""
    rows = torch.tensor([100, 500])
    return Impacts(table.points[rows].double(), table.render(rows), table.sample_rate, ("100.wav", "500.wav"))


def plate_object(kind: str, folder: Path) -> Path | None:
    """Write what shows the plate: a mesh of twelve triangles, a surface `LARGER` than that, Gaussians, or nothing."""
    if kind == "points":
        return None
    path = folder / f"{kind}.ply"
    if kind in ("mesh", "surface"):
        trimesh.creation.box([side * (1 if kind == "mesh" else LARGER) for side in SIDES]).export(path)
        return path
    points = plate_table().points
    normals = torch.zeros_like(points)
    normals[:, 2] = points[:, 2].sign()
    start = StartPoints(points, torch.full_like(points, 0.6), normals)
    write_splats(starting_cloud(start, degree=0, scale=1.0, opacity=0.95, flatness=0.2), path)
    return path


def lay_out(folder: Path, table: SampledField, *, live: bool, **bundle: Any) -> Path:
    """Write the page with a field, and if `live` with what a server would tell of itself."""
    made = make_bundle(table, **bundle)
    write_folder(folder, made.files, {**made.manifest, "live": LIVE if live else None})
    shutil.copy(PAGE / "index.html", folder)
    shutil.copytree(PAGE, folder / "page")
    return folder


def on_screen(page: "Page", place: Any) -> tuple[float, float]:
    where = page.evaluate("(place) => window.avmsf.project(place)", [float(value) for value in place])
    return where["x"], where["y"]


def words_on(page: "Page", kind: str = ".word") -> str:
    return " ".join(page.locator(f"#words {kind}").all_inner_texts())


def upload(name: str = "blow.wav", content: bytes | None = None) -> Any:
    return {"name": name, "mimeType": "audio/wav", "buffer": blow() if content is None else content}


def answer(route: "Route", content: Any, status: int = 200) -> None:
    route.fulfill(status=status, content_type="application/json", body=json.dumps(content))
