"""Folders of photographs with cameras, read into views."""

import math
import warnings
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

from avmsf._utils.wording import counted
from avmsf.errors import CaptureError, Remark
from avmsf.photographs.cameras import View
from avmsf.photographs.colmap import PLACES, find_model, read_colmap
from avmsf.photographs.nerf_json import read_transforms
from avmsf.photographs.poses import judge_cameras
from avmsf.photographs.shots import Shot, Shots, listed, without_camera
from avmsf.photographs.single import Findings, read_view

FEWEST = 3


def read_views(
    folder: str | Path,
    *,
    longest: int | None = None,
    max_views: int | None = None,
    meters: float = 1.0,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[View, ...]:
    """Read a folder of photographs with cameras, sorted by name, as undistorted views.

    `folder` holds a `transforms.json` or a COLMAP model (in `sparse/0`, `sparse` or itself, images in `images/`), or is
    the path of a JSON file of that kind; the JSON goes first where both are there. Masks come from the images' alpha
    channel, from the files that the JSON names, or from `masks/`. `longest` is the most pixels of a side; larger images
    are scaled down with their cameras. Of more than `max_views` images, only every second one or fewer are read.
    `meters` is the length of the file's unit. `progress` is called with the number of images done and of all.

    Warns with CaptureWarning of what was not used or was corrected. Raises CaptureError where cameras cannot be read,
    where an image's shape does not fit its camera's, or where fewer than three views remain.
    """
    if longest is not None and longest < 1:
        raise CaptureError(
            f"expected the longest side in pixels, at least 1, got {longest}", name="longest", value=longest
        )
    if not (math.isfinite(meters) and meters > 0):
        raise CaptureError(
            f"expected the length of the cameras' unit in meters, got {meters}", name="meters", value=meters
        )
    base, found = find_shots(Path(folder))
    shots = sorted(found.shots, key=lambda shot: shot.name)
    _refuse_repeated(shots, found.origin)
    findings = Findings(list(found.remarks))
    unused = without_camera(shots, base)
    if unused:
        message = f"{counted(len(unused), 'image')} not used, without a camera: {listed(unused)}"
        findings.remarks.append(Remark(message, name="cameras", value=unused))
    if max_views is not None:
        shots = shots[:: max(1, -(-len(shots) // max_views))]
    views = []
    for done, shot in enumerate(shots, start=1):
        view = read_view(shot, base, longest, meters, findings)
        views += [] if view is None else [view]
        if progress is not None:
            progress(done, len(shots))
    remarks = findings.summary()
    _refuse_few(views, shots, findings, found.origin)
    for remark in remarks + judge_cameras([view.camera for view in views]):
        warnings.warn(remark.about(found.origin), stacklevel=2)
    return tuple(views)


def find_shots(folder: Path) -> tuple[Path, Shots]:
    """Return the folder that paths count from, and the shots of the camera file in it."""
    if folder.suffix.lower() == ".json" and not folder.is_dir():
        if not folder.is_file():
            raise CaptureError(f"{folder}: expected a camera file, got none", file=folder)
        return folder.parent, read_transforms(folder)
    if not folder.is_dir():
        raise CaptureError(f"{folder}: expected a folder, got none", file=folder)
    if (folder / "transforms.json").is_file():
        return folder, read_transforms(folder / "transforms.json")
    model = find_model(folder)
    if model is None:
        others = sorted(path.name for path in folder.glob("*.json"))
        found = (
            f"{listed(others)}; give the path of one of these"
            if others
            else "neither: photographs without cameras need structure from motion first"
        )
        raise CaptureError(
            f"{folder}: expected transforms.json, or COLMAP's cameras and images (.bin or .txt) in "
            f"{', '.join(PLACES)}, got {found}",
            file=folder,
            value=others,
        )
    images = folder / "images"
    return folder, read_colmap(model, images if images.is_dir() else folder)


def _refuse_repeated(shots: Sequence[Shot], origin: Path) -> None:
    names = [shot.name for shot in shots]
    repeated = sorted({one for one, other in pairwise(names) if one == other})
    if repeated:
        raise CaptureError(
            f"{origin}: expected one camera for each image, got several for {listed(repeated)}; remove all but one",
            file=origin,
            name=repeated[0],
            value=repeated,
        )


def _refuse_few(views: Sequence[View], shots: Sequence[Shot], findings: Findings, origin: Path) -> None:
    if len(views) >= FEWEST:
        return
    if shots and len(findings.empty) == len(shots):
        raise CaptureError(
            f"{origin}: expected masks with 255 on the object and 0 elsewhere, got {len(shots)} without an object",
            file=origin,
            name="masks",
            value=0,
        )
    reasons = "".join(f"; {remark.message}" for remark in findings.summary())
    raise CaptureError(
        f"{origin}: expected at least {FEWEST} views, got {len(views)} of {len(shots)} that can be used{reasons}"
        + (f" (expected {shots[0].image} and so on)" if findings.lost else ""),
        file=origin,
        name="views",
        value=len(views),
    )
