"""Cameras of photographs that have none, by structure from motion (COLMAP, through the optional package pycolmap)."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from avmsf._utils.files import temporary_path, unwritable
from avmsf._utils.processes import end_child, ending_of, start_child
from avmsf._utils.text import counted, listed
from avmsf.capture.filenames import PICTURE_SUFFIXES, pictures_in
from avmsf.errors import CaptureError, Remark
from avmsf.photographs.images import Picture, PictureSizeError, read_mask, read_picture
from avmsf.photographs.shots import mask_names

WORKER = Path(__file__).with_name("sfm_worker.py")
MIN_IMAGES = 3
"""Fewest images with which cameras can be estimated."""
MIN_REGISTERED = 0.5
"""Part of the images that must get a camera."""
MAX_ALL_PAIRS = 150
"""Images up to which every pair is matched; of more, each with the next ones in the order of their names."""


def estimate_cameras(
    images: str | Path,
    output: str | Path,
    *,
    timeout: float = 3600.0,
    seed: int | None = None,
    features: int = 4096,
    threads: int = -1,
) -> Path:
    """Find the cameras of a folder's photographs, write them as COLMAP's binary model, and return its path.

    It is `sparse/0` in `output`; where that is the folder that holds `images/`, `read_views` reads it. What moves with
    the object counts, so masks are used where there are any: alpha channels, or files in `masks/` beside the images.
    All photographs come from one camera with one zoom. `features` bounds the features of an image. One and the same
    seed (None is 0) gives the same cameras to the last bit with `threads=1`, and to about one part in 100,000 with
    more; -1 takes all cores.

    The work runs in a process of its own, which ends with this call, whether that returns, raises, or is interrupted;
    `sparse/0` is whole or absent. Frame and scale of the result are arbitrary. Warns with CaptureWarning of images that
    could not be read, that got no camera, or that form a model apart. Raises CaptureError where pycolmap is missing,
    `sparse/0` exists, images differ in size, the work takes more than `timeout` seconds or crashes, or less than half
    of the images get a camera.
    """
    images, output = Path(images), Path(output)
    model, begun = output / "sparse" / "0", temporary_path(output / "sfm")
    _check_job(images, model, timeout=timeout)
    try:
        begun.mkdir(parents=True)
        names, lost = _stage_images(images, begun)
        job = {
            "folder": str(begun.resolve()),
            "names": list(names),
            "true_names": names,
            "masks": (begun / "masks").is_dir(),
            "exhaustive": len(names) <= MAX_ALL_PAIRS,
            "seed": seed or 0,
            "features": features,
            "threads": threads,
        }
        (begun / "job.json").write_text(json.dumps(job), encoding="utf-8")
        found = _run_worker(begun, timeout=timeout)
        everything = sorted([*names.values(), *lost])
        _refuse_few(found, everything, images=images)
        model.parent.mkdir(exist_ok=True)
        os.rename(begun / "models" / str(found[0]["number"]), model)
    except OSError as error:
        if error.filename is not None and Path(error.filename).is_relative_to(images):
            raise CaptureError.expected("a readable file", error.strerror, file=error.filename) from error
        raise unwritable(output, error, raising=CaptureError) from error
    finally:
        shutil.rmtree(begun, ignore_errors=True)
    for remark in _remarks(found, lost, everything):
        warnings.warn(remark.about(images), stacklevel=2)
    return model


def _check_job(images: Path, model: Path, *, timeout: float) -> None:
    if importlib.util.find_spec("pycolmap") is None:
        raise CaptureError.expected(
            "the package for photographs without cameras", name="pycolmap", advice="pip install 'avmsf[sfm]'"
        )
    if not timeout > 0:
        raise CaptureError.expected("a time above 0 s", timeout, name="timeout")
    if not images.is_dir():
        raise CaptureError.expected("a folder of photographs", file=images)
    if model.exists():
        advice = "remove it to estimate them again"
        raise CaptureError.expected("no cameras", got="existing ones", file=model, advice=advice)


def _stage_images(images: Path, begun: Path) -> tuple[dict[str, str], list[str]]:
    """Put links to the images and their masks where COLMAP expects them.

    Returns the images' names there with their true ones, and the names of those that cannot be read. Raises
    CaptureError for too few images, and for images of different sizes.
    """
    names, lost, sizes = {}, [], {}
    for path in pictures_in(images, deep=True):
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
        unread = f" and {len(lost)} that cannot be read: {listed(lost, most=8)}" if lost else ""
        wanted, got = f"at least {MIN_IMAGES} photographs ({', '.join(PICTURE_SUFFIXES)})", f"{len(names)}{unread}"
        raise CaptureError.expected(wanted, len(names), got=got, file=images, name="photographs")
    usual = max(sizes.values(), key=list(sizes.values()).count)
    odd = [name for name, size in sizes.items() if size != usual]
    if odd:
        got = f"most of {usual[0]} x {usual[1]} pixels, but not {listed(odd, most=8)}"
        wanted, advice = "photographs of one size", "give photographs of one camera in one orientation"
        raise CaptureError.expected(wanted, odd, got=got, file=images, name="sizes", advice=advice)
    return names, lost


def _stage_image(path: Path, picture: Picture, name: str, begun: Path) -> str:
    """Put one image in the job's folder and return its name there."""
    webp = path.suffix.lower() == ".webp"
    name += ".png" if webp else ""
    staged = begun / "images" / name
    staged.parent.mkdir(parents=True, exist_ok=True)
    if webp:
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


def _run_worker(begun: Path, *, timeout: float) -> list[dict[str, Any]]:
    """Return the worker's models, the largest first; raises CaptureError where it fails or takes too long."""
    log, result = begun / "worker.log", begun / "result.json"
    # -P keeps this folder, whose modules have common names, from where the worker looks for libraries.
    command = [sys.executable, "-P", str(WORKER), str(begun / "job.json")]
    with open(log, "wb") as output:
        try:
            worker = start_child(command, stdout=output, stderr=subprocess.STDOUT)
        except OSError as error:
            wanted = "a process for structure from motion"
            raise CaptureError.expected(wanted, error.strerror, name="starting") from error
        try:
            worker.wait(timeout)
        except subprocess.TimeoutExpired as error:
            wanted, stage = f"structure from motion within {timeout:g} s", _stage_and_lines(log)[0]
            advice = "increase timeout, or give fewer or smaller photographs"
            raise CaptureError.expected(wanted, timeout, got="no result", name=stage, advice=advice) from error
        finally:
            end_child(worker)
    if worker.returncode != 0 or not result.is_file():
        (stage, lines), ending = _stage_and_lines(log), ending_of(worker.returncode)
        advice = "where memory ran out, give smaller photographs; " if ending == "SIGKILL" else ""
        wanted = "structure from motion to end without an error"
        advice += f"its last output:\n{lines}"
        raise CaptureError.expected(wanted, ending, got=ending, name=stage, advice=advice)
    models = json.loads(result.read_text(encoding="utf-8"))
    return sorted(models, key=lambda model: -len(model["names"]))


def _stage_and_lines(log: Path, count: int = 6) -> tuple[str, str]:
    """Return the stage that the worker came to, and its last lines."""
    stage, lines = "starting", list[str]()
    for line in filter(str.strip, log.read_text(encoding="utf-8", errors="replace").splitlines()):
        if line.startswith("stage "):
            stage = line.removeprefix("stage ")
        else:
            lines.append(f"  {line[:200]}")
    return stage, "\n".join(lines[-count:])


def _refuse_few(models: Sequence[dict[str, Any]], everything: Sequence[str], *, images: Path) -> None:
    registered = models[0]["names"] if models else []
    if len(registered) >= max(MIN_IMAGES, MIN_REGISTERED * len(everything)):
        return
    lacking = [name for name in everything if name not in registered]
    apart = f" in {len(models)} groups that could not be joined" if len(models) > 1 else ""
    got = f"{len(registered)} of {len(everything)}{apart}, none for {listed(lacking)}"
    advice = "take sharp photographs 10 to 15 degrees apart, with a patterned, fixed ground in view"
    wanted = "cameras of most photographs"
    raise CaptureError.expected(wanted, lacking, got=got, file=images, name="cameras", advice=advice)


def _remarks(models: Sequence[dict[str, Any]], lost: Sequence[str], everything: Sequence[str]) -> list[Remark]:
    """Return a remark each on images that cannot be read, that form groups apart, and that got no camera."""
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
    named = kept.union(lost, *others)
    unseen = [name for name in everything if name not in named]
    if unseen:
        message = f"no camera was found for {counted(len(unseen), 'image')}: {listed(unseen, most=8)}"
        remarks.append(Remark(message, name="cameras", value=unseen))
    return remarks
