"""Folders of photographs with cameras, read into views and written from them; and the points that cameras came with."""

import json
import math
import warnings
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avmsf._utils.files import new_folder
from avmsf._utils.text import counted, listed
from avmsf.errors import CaptureError, CaptureWarning
from avmsf.photographs import colmap, nerf_json
from avmsf.photographs.cameras import MIN_VIEWS, Camera, View
from avmsf.photographs.colmap import PLACES, find_model, read_colmap
from avmsf.photographs.images import UnreadableImageError, read_image, read_mask, scale, size_of
from avmsf.photographs.lenses import CameraFile, Lens, Photograph, undistort
from avmsf.photographs.nerf_json import OPENCV_FROM_OPENGL, read_transforms

_NO_CAMERAS = "neither: photographs without cameras need structure from motion first"
Findings = defaultdict[str, list[str]]
"""Names of images, by the keys of `KINDS`."""
KINDS = {
    "transform_matrix": ("pose", "with a scaled rotation, whose scale was removed"),
    "cameras": ("image", "without a camera, not used"),
    "missing images": ("image", "missing or corrupt, not used"),
    "empty masks": ("image", "with an empty mask, not used"),
    "image sizes": ("image", "of another size than the camera, whose intrinsics were scaled"),
    "orientations": ("image", "rotated by the orientation tag to fit the camera"),
    "missing masks": ("mask", "missing or corrupt; the images are used without"),
    "mask sizes": ("mask", "scaled from another size to that of the image"),
}
"""Problems of single images, which are reported together: what they concern, and what became of it."""


def read_views(
    folder: str | Path, *, longest: int | None = None, max_views: int | None = None, meters: float = 1.0
) -> tuple[View, ...]:
    """Read a folder of photographs with cameras, sorted by name, as undistorted views.

    `folder` holds a `transforms.json` or a COLMAP model (in `sparse/0`, `sparse` or itself, images in `images/`), or is
    the path of a JSON file of that kind; the JSON goes first where both are there. Masks come from the images' alpha
    channel, from the files that the JSON names, or from `masks/`. `longest` is the most pixels of a side; larger images
    are scaled down with their cameras. Of more than `max_views` images, only every second one or fewer are read.
    `meters` is the length of the file's unit.

    Warns with CaptureWarning of what was not used or was corrected. Raises CaptureError where cameras cannot be read,
    where an image's shape does not fit its camera's, or where fewer than three views remain.
    """
    if longest is not None and longest < 1:
        raise CaptureError.expected("at least 1 pixel", longest, name="longest")
    if max_views is not None and max_views < 1:
        raise CaptureError.expected("at least 1 view", max_views, name="max_views")
    if not (math.isfinite(meters) and meters > 0):
        raise CaptureError.expected("the length of the cameras' unit in meters", meters, name="meters")
    cameras = read_camera_file(Path(folder))
    photographs = sorted(cameras.photographs, key=lambda each: each.name)
    repeated = sorted({one.name for one, other in pairwise(photographs) if one.name == other.name})
    if repeated:
        wanted, got, advice = "one camera for each image", f"several for {listed(repeated)}", "remove all but one"
        raise CaptureError.expected(wanted, repeated, got=got, file=cameras.path, name=repeated[0], advice=advice)
    findings = Findings(list, transform_matrix=list(cameras.scaled), cameras=cameras.without_camera())
    if max_views is not None:
        photographs = photographs[:: max(1, -(-len(photographs) // max_views))]
    read = (_read_view(each, cameras.folder, longest, meters, findings) for each in photographs)
    views = [view for view in read if view is not None]
    if photographs and len(findings["empty masks"]) == len(photographs):
        wanted, got = "masks with 255 on the object and 0 elsewhere", f"{len(photographs)} without an object"
        raise CaptureError.expected(wanted, 0, got=got, file=cameras.path, name="masks")
    remarks = [
        CaptureWarning(f"{counted(len(names), thing)} {message}: {listed(names)}", name=kind, value=names)
        for kind, (thing, message) in KINDS.items()
        if (names := findings[kind])
    ]
    if len(views) < MIN_VIEWS:
        reasons = "".join(f"; {remark}" for remark in remarks)
        place = f" (expected {photographs[0].image} and so on)" if findings["missing images"] else ""
        got = f"{len(views)} of {len(photographs)} that can be used{reasons}{place}"
        raise CaptureError.expected(f"at least {MIN_VIEWS} views", len(views), got=got, file=cameras.path, name="views")
    for remark in remarks + check_cameras([view.camera for view in views]):
        warnings.warn(remark.about(cameras.path), stacklevel=2)
    return tuple(views)


def read_camera_file(folder: Path) -> CameraFile:
    """Return what the camera file in a folder names, or the JSON file given in its place.

    Raises CaptureError where there is none.
    """
    if folder.suffix.lower() == ".json" and not folder.is_dir():
        if not folder.is_file():
            raise CaptureError.expected("a camera file", file=folder)
        return read_transforms(folder)
    if not folder.is_dir():
        raise CaptureError.expected("a folder", file=folder)
    if (folder / "transforms.json").is_file():
        return read_transforms(folder / "transforms.json")
    model = find_model(folder)
    if model is not None:
        return read_colmap(model, folder)
    others = sorted(path.name for path in folder.glob("*.json"))
    got = f"{listed(others)}; give the path of one of these" if others else _NO_CAMERAS
    wanted = f"transforms.json, or COLMAP's cameras and images (.bin or .txt) in {', '.join(PLACES)}"
    raise CaptureError.expected(wanted, others, got=got, file=folder)


def mask_paths(name: str, folder: Path) -> list[Path]:
    """Return the paths where the mask of the photograph of this name may be, the likeliest first."""
    path = PurePosixPath(name)
    return [folder / "masks" / path.with_suffix(".png"), folder / "masks" / f"{path}.png"]


def _read_view(
    photograph: Photograph, folder: Path, longest: int | None, meters: float, findings: Findings
) -> View | None:
    """Read one photograph and its mask into a pinhole's view; None, and a finding, where there is nothing to see."""
    try:
        pixels = read_image(photograph.image)
    except UnreadableImageError:
        findings["missing images"].append(photograph.name)
        return None
    pixels, lens = _with_lens(photograph, pixels, findings)
    pixels, camera = undistort(_with_mask(photograph, folder, pixels, findings), lens)
    if longest is not None and max(size_of(pixels)) > longest:
        width, height = (max(1, round(side * longest / max(size_of(pixels)))) for side in size_of(pixels))
        pixels, camera = scale(pixels, width, height), camera.resized(width, height)
    mask = torch.from_numpy(np.ascontiguousarray(pixels[..., 3])) if pixels.shape[2] == 4 else None
    if mask is not None and not mask.any():
        findings["empty masks"].append(photograph.name)
        return None
    pose = photograph.world_to_camera.clone()
    pose[:3, 3] *= meters
    image = torch.from_numpy(np.ascontiguousarray(pixels[..., :3]))
    return View(photograph.name, image, replace(camera, world_to_camera=pose), mask)


def _with_lens(
    photograph: Photograph, pixels: UInt8[np.ndarray, "height width channels"], findings: Findings
) -> tuple[UInt8[np.ndarray, "height width channels"], Lens]:
    """Return image and lens of one size; raises CaptureError where their shapes differ."""
    lens = photograph.lens_of(*size_of(pixels))
    size = (lens.width, lens.height)
    if pixels.shape[2] == 3 and size_of(pixels) != size:
        upright = read_image(photograph.image, upright=True)
        if size_of(upright) != size_of(pixels) and _same_shape(size_of(upright), size):
            pixels = upright
            findings["orientations"].append(photograph.name)
    if size_of(pixels) == size:
        return pixels, lens
    advice = "give the images of which the cameras were estimated, not cropped or rotated"
    _check_shape(size_of(pixels), size, f"its camera's ({lens.origin})", photograph.image, "image", advice)
    findings["image sizes"].append(f"{photograph.name} ({_shown(size_of(pixels))} instead of {_shown(size)})")
    return pixels, lens.resized(*size_of(pixels))


def _with_mask(
    photograph: Photograph, folder: Path, pixels: UInt8[np.ndarray, "height width channels"], findings: Findings
) -> UInt8[np.ndarray, "height width masked_channels"]:
    """Return the image with the mask that lies in a file, where it has none of its own."""
    named = [] if photograph.mask is None else [photograph.mask]
    paths = [path for path in (*named, *mask_paths(photograph.name, folder)) if path.is_file()] or named
    if pixels.shape[2] == 4 or not paths:
        return pixels
    try:
        mask = read_mask(paths[0])
    except UnreadableImageError:
        findings["missing masks"].append(photograph.name)
        return pixels
    size = size_of(pixels)
    _check_shape(size_of(mask), size, "its image's", paths[0], "mask", "make the mask of this image")
    if size_of(mask) != size:
        findings["mask sizes"].append(f"{photograph.name} ({_shown(size_of(mask))} for {_shown(size)})")
    return np.dstack([pixels, scale(mask, *size)])


def _check_shape(found: tuple[int, int], size: tuple[int, int], whose: str, path: Path, name: str, advice: str) -> None:
    if not _same_shape(found, size):
        wanted = f"the shape {_shown(size)}, {whose}"
        raise CaptureError.expected(wanted, list(found), got=_shown(found), file=path, name=name, advice=advice)


def _shown(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"


def _same_shape(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes are one image at two scales, up to a pixel of rounding in the smaller."""
    small, large = sorted((one, other))
    factor = large[0] / small[0]
    return abs(large[1] / factor - small[1]) <= 1


def check_cameras(cameras: Sequence[Camera]) -> list[CaptureWarning]:
    """Return remarks on the positions and axes of the cameras together."""
    positions = np.array([camera.position.tolist() for camera in cameras])
    axes = np.array([camera.world_to_camera[2, :3].tolist() for camera in cameras])
    spread = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())
    if spread <= 1e-6 * float(np.linalg.norm(positions, axis=1).max()) + 1e-12:
        position = np.round(positions[0], 6).tolist()
        message = f"expected cameras at several positions, got all {len(cameras)} at {position}; check the camera file"
        return [CaptureWarning(message, name="positions", value=position)]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] < 1e-4 * len(axes):
        # Parallel axes meet nowhere.
        return []
    center = np.linalg.solve(total, np.einsum("ijk,ik->j", across, positions))
    behind = int((np.einsum("ij,ij->i", axes, center - positions) < 0).sum())
    if behind <= len(cameras) / 2:
        return []
    message = (
        f"{behind} of {len(cameras)} cameras point away from the point where their axes meet, "
        f"{np.round(center, 4).tolist()}: the axes are probably OpenCV's where OpenGL's are expected or the other way "
        "round, or the poses are inverted"
    )
    return [CaptureWarning(message, name="axes", value=behind)]


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
        found = nerf_json.read_points(transforms)
    else:
        model = find_model(folder)
        found = None if model is None else colmap.read_points(model)
    if found is None:
        return None
    return torch.from_numpy(found[0] * meters), torch.from_numpy(found[1])


def write_views(views: Sequence[View], folder: str | Path, *, replace: bool = False) -> None:
    """Write `transforms.json`, `images/NAME.png` and, for views that have one, `masks/NAME.png`.

    `read_views` reads back the same pixels, masks and names except for the names' suffixes, and cameras to rounding.
    The folder is complete or as it was; with `replace` all that was in it is deleted then. Raises CaptureError where it
    exists and is not empty without that, where two views would have one file, and where it cannot be written.
    """
    folder, names = Path(folder), _file_names(views)
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        wanted, got = "views with different names", f"several for {repeated[0]}"
        raise CaptureError.expected(wanted, repeated, got=got, file=folder, name=repeated[0])
    with new_folder(folder, raising=CaptureError, replace=replace) as begun:
        write_frames(views, begun)


def write_frames(views: Sequence[View], folder: Path) -> None:
    """Write what `write_views` does, of views of different names, into a folder that is there. Raises OSError."""
    frames = []
    for name, view in zip(_file_names(views), views, strict=True):
        camera = view.camera
        pose = np.linalg.inv(camera.world_to_camera.cpu().numpy()) @ OPENCV_FROM_OPENGL
        frame = {"file_path": f"images/{name}", "transform_matrix": pose.tolist()}
        frame |= {"w": camera.width, "h": camera.height, "fl_x": camera.focal[0], "fl_y": camera.focal[1]}
        frame |= {"cx": camera.principal[0], "cy": camera.principal[1]}
        _write_image(folder / "images" / name, view.image.cpu().numpy()[..., ::-1])
        if view.mask is not None:
            frame["mask_path"] = f"masks/{name}"
            _write_image(folder / "masks" / name, view.mask.cpu().numpy())
        frames.append(frame)
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "PINHOLE", "frames": frames}, indent=1))


def _file_names(views: Sequence[View]) -> list[str]:
    return [str(PurePosixPath(view.name).with_suffix(".png")) for view in views]


def _write_image(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    # Low compression is several times faster, and these files are read once or twice.
    written, content = cv2.imencode(".png", np.ascontiguousarray(pixels), [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not written:
        raise OSError(f"{path}: the image could not be encoded as PNG")
    path.write_bytes(content.tobytes())
