"""What a user has opened: a field, a capture folder, or a mesh or pictures of which a capture shall be made."""

import filecmp
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from avmsf._utils.files import copy_whole
from avmsf.capture.filenames import SHAPE_SUFFIXES, SPLATS, find_surface_file
from avmsf.capture.settings import TABLE, CaptureSettings, settings_of
from avmsf.capture.table import is_inside
from avmsf.errors import StudioError
from avmsf.gaussians.ply import holds_gaussians
from avmsf.pipeline.config import CACHE, CACHED_FIELD, SURFACE
from avmsf.pipeline.scene import CLOUD
from avmsf.pipeline.views import find_source, find_splats

MAX_MESH_BYTES = 512 << 20
"""Bytes; what a browser shows has far fewer."""
_MATERIALS = re.compile(r"^\s*mtllib\s+(.+?)\s*$", re.MULTILINE)
_TEXTURES = re.compile(r"^\s*map_\w+\s+(?:.*\s)?(\S+)\s*$", re.MULTILINE)


@dataclass(frozen=True)
class Opened:
    """Where everything is that the page shows or writes."""

    name: str
    home: Path
    """Folder that edited fields are saved to."""
    field: Path | None = None
    capture: Path | None = None
    """Folder of recordings, to mark them and to add to them."""
    object: Path | None = None
    """Mesh or Gaussians to show, where they are given and not found in the capture."""

    @property
    def settings(self) -> CaptureSettings:
        """How the capture's files are read."""
        return CaptureSettings() if self.capture is None else settings_of(self.capture)


def open_target(target: Path, *, object: Path | None = None, capture: Path | None = None) -> Opened:
    """Return what a path opens. Raises StudioError for a path without a field, recordings or geometry.

    A mesh is copied as the surface of a capture folder: `capture`, or a folder of the mesh's name next to it. Without
    `capture`, a mesh with a name that captures use (surface.*, splats.ply, point_cloud.ply) opens its own folder.
    """
    if object is not None and not object.is_file():
        raise StudioError.expected("a mesh or Gaussians", file=object, name="object", advice="check --object")
    if capture is not None and target.suffix.lower() not in SHAPE_SUFFIXES and not capture.is_dir():
        raise StudioError.expected("a capture folder", file=capture, name="capture", advice="check --capture")
    if target.is_dir():
        return _open_folder(target, object)
    if not target.is_file():
        wanted = "a field, a capture folder, a folder of images or a mesh"
        raise StudioError.expected(wanted, file=target, name="target", advice="check the path")
    if target.suffix.lower() in SHAPE_SUFFIXES:
        return _open_mesh(target, object, capture)
    home = target.resolve().parent
    if home.name == CACHE:
        home = home.parent
        capture = home if capture is None and (home / TABLE).is_file() else capture
    recordings = None if capture is None else capture.resolve()
    name = target.stem if recordings is None else recordings.name
    return Opened(name, home, target.resolve(), recordings, object)


def find_object(opened: Opened) -> Path | None:
    """Return the file that shows the object: the given one, the capture's mesh, its Gaussians, or those made of it."""
    if opened.object is not None or opened.capture is None:
        return opened.object
    surface = find_surface_file(opened.capture, opened.settings)
    if surface is not None and surface.is_file():
        return surface
    made = opened.capture / CACHE / CLOUD
    return made if made.is_file() else find_splats(opened.capture)


def find_reconstructed(opened: Opened) -> Path | None:
    """Return the mesh, in meters, that was made of the object's views; None without one, and where its own is shown."""
    made = None if opened.capture is None else opened.capture / CACHE / SURFACE
    shown = find_object(opened)
    return None if made is None or not made.is_file() or (shown and not holds_gaussians(shown)) else made


def shows_more(opened: Opened) -> bool:
    """Whether the capture holds pictures of which an object to click can be made, and none was made yet."""
    if opened.capture is None or find_object(opened) is not None:
        return False
    return find_source(opened.capture, opened.settings) is not None


def _open_folder(folder: Path, object: Path | None) -> Opened:
    folder = folder.resolve()
    field = folder / CACHE / CACHED_FIELD
    opened = Opened(folder.name, folder, field if field.is_file() else None, folder, object)
    if not ((folder / TABLE).is_file() or find_object(opened) is not None or shows_more(opened)):
        surfaces = ", ".join(f"surface{suffix}" for suffix in SHAPE_SUFFIXES)
        wanted = f"a capture folder with {TABLE}, images/, a video, {surfaces} or splats.ply"
        raise StudioError.expected(wanted, got="none of these", file=folder, name=TABLE, advice="add one")
    return opened


def _open_mesh(mesh: Path, object: Path | None, capture: Path | None) -> Opened:
    size = mesh.stat().st_size
    if size > MAX_MESH_BYTES:
        wanted, advice = f"a mesh of at most {MAX_MESH_BYTES >> 20} MiB", "reduce it to a hundred thousand triangles"
        raise StudioError.expected(wanted, size, got=f"{size >> 20}", file=mesh, advice=advice)
    if capture is None and (mesh.stem == "surface" or mesh.name in SPLATS):
        return _open_folder(mesh.resolve().parent, object)
    folder = mesh.with_suffix("") if capture is None else capture
    if folder.exists() and not folder.is_dir():
        wanted, advice = "a capture folder or none", "name a folder by --capture"
        raise StudioError.expected(wanted, got="a file", file=folder, name="capture", advice=advice)
    surface = folder / (SPLATS[0] if holds_gaussians(mesh) else f"surface{mesh.suffix.lower()}")
    names = (*(f"surface{suffix}" for suffix in SHAPE_SUFFIXES), *SPLATS)
    others = [folder / name for name in names if (folder / name).is_file()]
    if others and not (surface in others and _same(surface, mesh)):
        wanted, advice = "a capture of this mesh", "open the folder, or name another by --capture"
        raise StudioError.expected(wanted, others[0].name, file=folder, name="capture", advice=advice)
    if not others:
        _copy({**{folder / path.name: path for path in _named_by(mesh)}, surface: mesh})
    return _open_folder(folder, object)


def _named_by(mesh: Path) -> Iterator[Path]:
    """Yield the files that a Wavefront mesh refers to: its materials and their textures."""
    if mesh.suffix.lower() != ".obj":
        return
    for material in _found(mesh.parent, _MATERIALS.findall(mesh.read_text(errors="replace"))):
        yield material
        yield from _found(mesh.parent, _TEXTURES.findall(material.read_text(errors="replace")))


def _found(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """Yield the files of a folder that these are the paths of, or else the last parts of a path, as readers do."""
    for name in names:
        inside = [folder / each for each in (name, Path(name).name) if is_inside(PurePosixPath(each))]
        yield from [path for path in inside if path.is_file()][:1]


def _copy(sources: Mapping[Path, Path]) -> None:
    """Copy files to these paths. Raises StudioError, before anything is written, where others have these names."""
    missing = {path: source for path, source in sources.items() if not (path.exists() or path.is_symlink())}
    for path, source in sources.items():
        if path not in missing and not _same(path, source):
            wanted, advice = f"no file, or the mesh's own {source.name}", "name another folder by --capture"
            raise StudioError.expected(wanted, got="another one", file=path, name="capture", advice=advice)
    for path, source in missing.items():
        copy_whole(source, path, raising=StudioError)


def _same(one: Path, other: Path) -> bool:
    return one.is_file() and (one.samefile(other) or filecmp.cmp(one, other, shallow=False))
