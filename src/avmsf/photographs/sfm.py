"""Cameras of photographs that have none, by structure from motion (COLMAP, through the optional package pycolmap)."""

import contextlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import time
import uuid
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from avmsf._utils.children import end_child, ending_of, start_child
from avmsf._utils.files import unwritable
from avmsf._utils.text import counted, listed
from avmsf.capture.filenames import PICTURE_SUFFIXES, pictures_in
from avmsf.errors import CaptureError, Remark
from avmsf.photographs.images import Picture, PictureSizeError, read_mask, read_picture
from avmsf.photographs.shots import mask_names

CAMERA_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
WORKER = Path(__file__).with_name("sfm_worker.py")
MIN_IMAGES = 3
"""Fewest images with which cameras can be estimated."""
MAX_ALL_PAIRS = 150
"""Images up to which every pair is matched; of more, each with the next ones in the order of their names."""
POLL_SECONDS = 0.2
"""Time between two checks of the worker."""


@dataclass(frozen=True)
class MotionProgress:
    """How far structure from motion is."""

    stage: str
    """features, matches or cameras; starting before the first."""
    done: int
    """Steps of the stage that are done, as far as COLMAP reports them."""
    total: int
    """Steps of the stage; 0 where unknown."""
    seconds: float
    """Time since the start."""


@dataclass(frozen=True)
class EstimatedCameras:
    """What structure from motion found, and where it is saved."""

    model: Path
    """Folder of COLMAP's binary model, `sparse/0` in the output folder."""
    registered: tuple[str, ...]
    """Images that have a camera now, by name, sorted."""
    missing: tuple[str, ...]
    """Images that have none."""
    points: int
    """Points of the scene that were found on the way."""
    error: float
    """Mean distance between points as seen and as computed, pixels: above 1, something is wrong."""


def estimate_cameras(
    images: str | Path,
    output: str | Path,
    *,
    timeout: float = 3600.0,
    seed: int | None = None,
    camera_model: str = "SIMPLE_RADIAL",
    shared_camera: bool = True,
    features: int = 4096,
    longest: int = 1600,
    least: float = 0.5,
    threads: int | None = None,
    progress: Callable[[MotionProgress], None] | None = None,
) -> EstimatedCameras:
    """Find the cameras of a folder's photographs and write them as COLMAP's binary model `sparse/0` in `output`.

    Where `output` is the folder that holds `images/`, `read_views` reads it. What moves with the object counts, so
    masks are used where there are any: alpha channels, or files in `masks/` beside the images. All photographs come
    from one camera with one zoom unless `shared_camera` is false. `features` and `longest` bound the features of an
    image and the pixels of the longer side on which they are sought. One and the same seed (None is 0) gives the same
    cameras to the last bit with `threads=1`, and to about one part in 100,000 with more; None takes all cores.

    The work runs in a process of its own, which ends with this call, whether that returns, raises, or is interrupted;
    `sparse/0` is whole or absent. Frame and scale of the result are arbitrary. Warns with
    CaptureWarning of images that could not be read, that got no camera, or that form a model apart. Raises
    CaptureError where pycolmap is missing, `sparse/0` exists, images differ in size but share a camera, the work takes
    more than `timeout` seconds or crashes, or less than the part `least` of the images gets a camera.
    """
    images, output = Path(images), Path(output)
    _check_job(images, output, camera_model=camera_model, timeout=timeout)
    begun = output / f".sfm.{uuid.uuid4().hex[:8]}"
    try:
        begun.mkdir(parents=True)
        names, lost = _stage_images(images, begun, shared_camera=shared_camera)
        job = {
            "folder": str(begun.resolve()),
            "names": list(names),
            "true_names": names,
            "masks": (begun / "masks").is_dir(),
            "exhaustive": len(names) <= MAX_ALL_PAIRS,
            "seed": 0 if seed is None else seed,
            "camera_model": camera_model,
            "shared_camera": shared_camera,
            "features": features,
            "longest": longest,
            "threads": -1 if threads is None else threads,
        }
        (begun / "job.json").write_text(json.dumps(job), encoding="utf-8")
        _run_worker(begun, timeout=timeout, progress=progress)
        models = json.loads((begun / "result.json").read_text(encoding="utf-8"))
        models.sort(key=lambda model: -len(model["names"]))
        everything = sorted([*names.values(), *lost])
        _refuse_few(models, everything, least=least, images=images)
        (output / "sparse").mkdir(exist_ok=True)
        os.rename(begun / "models" / str(models[0]["number"]), output / "sparse" / "0")
    except OSError as error:
        place = Path(error.filename or output)
        if place.is_relative_to(images) or (not begun.is_relative_to(place) and not place.is_relative_to(output)):
            raise CaptureError.expected("a readable file", error.strerror, file=place) from error
        raise unwritable(output, error, raising=CaptureError) from error
    finally:
        shutil.rmtree(begun, ignore_errors=True)
    registered = tuple(models[0]["names"])
    missing = tuple(name for name in everything if name not in set(registered))
    for remark in _remarks(models, lost, missing):
        warnings.warn(remark.about(images), stacklevel=2)
    return EstimatedCameras(output / "sparse" / "0", registered, missing, models[0]["points"], models[0]["error"])


def _check_job(images: Path, output: Path, *, camera_model: str, timeout: float) -> None:
    if importlib.util.find_spec("pycolmap") is None:
        raise CaptureError(
            "expected the package pycolmap for photographs without cameras, got none: pip install 'avmsf[sfm]'",
            name="pycolmap",
        )
    if camera_model not in CAMERA_MODELS:
        raise CaptureError.expected(f"one of {', '.join(CAMERA_MODELS)}", camera_model, name="camera_model")
    if not timeout > 0:
        raise CaptureError(f"timeout: expected a time above 0 s, got {timeout:g} s", name="timeout", value=timeout)
    if not images.is_dir():
        raise CaptureError(f"{images}: expected a folder of photographs, got none", file=images)
    if (output / "sparse" / "0").exists():
        raise CaptureError.expected(
            "no cameras", got="existing ones", file=output / "sparse" / "0", advice="remove it to estimate them again"
        )


def _stage_images(images: Path, begun: Path, *, shared_camera: bool) -> tuple[dict[str, str], list[str]]:
    """Put links to the images and their masks where COLMAP expects them.

    Returns the images' names there with their true ones, and the names of those that cannot be read. Raises
    CaptureError for too few images, and for images of different sizes from one camera.
    """
    found = pictures_in(images, deep=True)
    names, lost, sizes = {}, [], {}
    for path in found:
        name = path.relative_to(images).as_posix()
        try:
            picture = read_picture(path)
        except PictureSizeError:
            raise
        except CaptureError:
            lost.append(name)
            continue
        staged = _stage_image(path, picture, name, begun)
        names[staged], sizes[name] = name, picture.size
        _stage_mask(images, picture, name, begun / "masks" / f"{staged}.png")
    if len(names) < MIN_IMAGES:
        raise CaptureError(
            f"{images}: expected at least {MIN_IMAGES} photographs ({', '.join(PICTURE_SUFFIXES)}), got {len(names)}"
            + (f" and {len(lost)} that cannot be read: {listed(lost, most=8)}" if lost else ""),
            file=images,
            name="photographs",
            value=len(names),
        )
    kinds = sorted(set(sizes.values()), key=list(sizes.values()).count)
    if shared_camera and len(kinds) > 1:
        odd = [name for name, size in sizes.items() if size != kinds[-1]]
        raise CaptureError(
            f"{images}: expected photographs of one size, got most of {kinds[-1][0]} x {kinds[-1][1]} pixels, but not "
            f"{listed(odd, most=8)}; give photographs of one camera in one orientation, or set shared_camera=False",
            file=images,
            name="shared_camera",
            value=odd,
        )
    return names, lost


def _stage_image(path: Path, picture: Picture, name: str, begun: Path) -> str:
    """Put one image in the job's folder and return its name there."""
    if path.suffix.lower() == ".webp":
        name += ".png"
    staged = begun / "images" / name
    staged.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() == ".webp":
        cv2.imwrite(str(staged), picture.color[..., ::-1])
        return name
    try:
        staged.symlink_to(path.resolve())
    except OSError:  # file systems without links
        shutil.copyfile(path, staged)
    return name


def _stage_mask(images: Path, picture: Picture, name: str, staged: Path) -> None:
    """Write the image's mask, where it has one, as COLMAP reads it."""
    path = next((place for place in mask_names(name, images.parent) if place.is_file()), None)
    mask = picture.mask if picture.mask is not None or path is None else read_mask(path)
    if mask is None:
        return
    if mask.shape[::-1] != picture.size:
        mask = cv2.resize(mask, picture.size, interpolation=cv2.INTER_NEAREST)
    staged.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(staged), np.where(mask >= 128, 255, 0).astype(np.uint8))


def _run_worker(begun: Path, *, timeout: float, progress: Callable[[MotionProgress], None] | None) -> None:
    """Run the worker to its end; raises CaptureError where it fails or takes too long."""
    log = begun / "worker.log"
    start = time.monotonic()
    # -P keeps this folder, whose modules have common names, from where the worker looks for libraries.
    command = [sys.executable, "-P", str(WORKER), str(begun / "job.json")]
    with open(log, "wb") as output:
        try:
            worker = start_child(command, stdout=output, stderr=subprocess.STDOUT)
        except OSError as error:
            raise CaptureError.expected(
                "a process for structure from motion", error.strerror, name="starting"
            ) from error
        try:
            while worker.poll() is None:
                seconds = time.monotonic() - start
                if seconds > timeout:
                    stage = _progress(log, seconds).stage
                    raise CaptureError(
                        f"expected structure from motion within {timeout:g} s, got no result in the stage {stage}; "
                        "increase timeout, or give fewer or smaller photographs",
                        name=stage,
                        value=timeout,
                    )
                if progress is not None:
                    progress(_progress(log, seconds))
                with contextlib.suppress(subprocess.TimeoutExpired):
                    worker.wait(POLL_SECONDS)
        finally:
            end_child(worker)
    if worker.returncode != 0 or not (begun / "result.json").is_file():
        stage, ending = _progress(log, 0.0).stage, ending_of(worker.returncode)
        advice = "where memory ran out, lower `features` or `longest`; " if ending == "SIGKILL" else ""
        raise CaptureError.expected(
            "structure from motion to end without an error",
            ending,
            got=f"{ending} in the stage {stage}",
            name=stage,
            advice=f"{advice}its last output:\n{_last_lines(log)}",
        )


def _progress(log: Path, seconds: float) -> MotionProgress:
    text = log.read_text(encoding="utf-8", errors="replace")
    stage, _, rest = text.rpartition("stage ")[2].partition("\n")
    steps = re.findall(r"\[(\d+)/(\d+)", rest)
    done, total = (int(number) for number in steps[-1]) if steps else (0, 0)
    return MotionProgress(stage if "stage " in text else "starting", done, total, seconds)


def _last_lines(log: Path, count: int = 6) -> str:
    text = log.read_text(encoding="utf-8", errors="replace")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("stage ")]
    return "\n".join(f"  {line[:200]}" for line in lines[-count:])


def _refuse_few(models: Sequence[dict[str, Any]], everything: Sequence[str], *, least: float, images: Path) -> None:
    registered = models[0]["names"] if models else []
    if len(registered) >= max(MIN_IMAGES, least * len(everything)):
        return
    lacking = [name for name in everything if name not in registered]
    apart = f" in {len(models)} groups that could not be joined" if len(models) > 1 else ""
    raise CaptureError(
        f"{images}: expected cameras of most photographs, got {len(registered)} of {len(everything)}{apart}, none "
        f"for {listed(lacking)}; take sharp photographs 10 to 15 degrees apart, with a patterned, fixed ground in view",
        file=images,
        name="cameras",
        value=lacking,
    )


def _remarks(models: Sequence[dict[str, Any]], lost: Sequence[str], missing: Sequence[str]) -> list[Remark]:
    remarks = []
    if lost:
        message = f"{counted(len(lost), 'image')} not used, as they cannot be read: {listed(lost, most=8)}"
        remarks.append(Remark(message, name="unreadable images", value=lost))
    # Groups overlap: an image may belong to several that could not be joined.
    kept = set(models[0]["names"])
    others = [[name for name in model["names"] if name not in kept] for model in models[1:]]
    others = [names for names in others if names]
    if others:
        groups = "; ".join(listed(names, most=8) for names in others)
        message = (
            f"the photographs form {len(models)} groups that could not be joined; only the largest, of {len(kept)} "
            f"images, is used, without {groups}"
        )
        remarks.append(Remark(message, name="groups", value=others))
    apart = {name for names in others for name in names}
    unseen = [name for name in missing if name not in apart and name not in lost]
    if unseen:
        message = f"no camera was found for {counted(len(unseen), 'image')}: {listed(unseen, most=8)}"
        remarks.append(Remark(message, name="cameras", value=unseen))
    return remarks
