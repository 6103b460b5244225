"""Scanned meshes of ObjectFolder Real's objects, wherever their archives were unpacked."""

from pathlib import Path

from avmsf.capture.settings import CaptureSettings
from avmsf.datasets.dataset import Look

FOLDERS = ("mesh_16k", "mesh_64k", "mesh_full")
"""The same scans in three resolutions, preferred in this order: about 16,000 faces are plenty to see where a blow
landed and to render pictures, and are read the fastest."""
_SUFFIXES = (".obj", ".ply", ".glb", ".stl")


def find_mesh(folder: Path, identifier: str) -> Look | None:
    """Return an object's mesh from the dataset's folder, a `mesh` folder in it, or beside it; None where there is none.

    How the archives are laid out inside is not known for certain, so a mesh may be called `<object>.obj`, or be the one
    mesh in a folder `<object>`, however deep.
    """
    for place in mesh_folders(folder):
        flat = [place / f"{identifier}{suffix}" for suffix in _SUFFIXES]
        deep = sorted(path for path in (place / identifier).rglob("*") if path.suffix.lower() in _SUFFIXES)
        for path in (*flat, *deep):
            if path.is_file():
                return Look(path.parent, CaptureSettings(surface=path.name))
    return None


def mesh_folders(folder: Path) -> list[Path]:
    """Return the folders of meshes that there are, the preferred first."""
    places = [folder, folder / "mesh", folder.resolve().parent, folder.resolve().parent / "mesh"]
    return [place / name for name in FOLDERS for place in places if (place / name).is_dir()]
