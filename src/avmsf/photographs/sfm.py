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

import cv2
import numpy as np

from avmsf._utils.files import temporary_path, unwritable
from avmsf._utils.processes import child_process, ending_of
from avmsf._utils.text import counted, listed
from avmsf.capture.filenames import PICTURE_SUFFIXES, pictures_in
from avmsf.errors import CaptureError, CaptureWarning
from avmsf.photographs.cameras import MIN_VIEWS
from avmsf.photographs.folder import mask_paths
from avmsf.photographs.images import UnreadableImageError, read_image, read_mask, size_of

WORKER = Path(__file__).with_name("sfm_worker.py")


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
    if importlib.util.find_spec("pycolmap") is None:
        advice = "pip install 'avmsf[sfm]'"
        raise CaptureError.expected("the package for photographs without cameras", name="pycolmap", advice=advice)
    if not timeout > 0:
        raise CaptureError.expected("a time above 0 s", timeout, name="timeout")
    if not images.is_dir():
        raise CaptureError.expected("a folder of photographs", file=images)
    if model.exists():
        advice = "remove it to estimate them again"
        raise CaptureError.expected("no cameras", got="existing ones", file=model, advice=advice)
    try:
        begun.mkdir(parents=True)
        names, unreadable = _stage_images(images, begun)
        job = {"names": names, "seed": seed or 0, "features": features, "threads": threads}
        (begun / "job.json").write_text(json.dumps(job), encoding="utf-8")
        groups = _run_worker(begun, timeout=timeout)
        remarks = _check_groups(list(groups.values()), unreadable, sorted([*names.values(), *unreadable]), images)
        model.parent.mkdir(exist_ok=True)
        os.rename(begun / "models" / next(iter(groups)), model)
    except OSError as error:
        raise unwritable(output, error, raising=CaptureError) from error
    finally:
        shutil.rmtree(begun, ignore_errors=True)
    for remark in remarks:
        warnings.warn(remark.about(images), stacklevel=2)
    return model


def _stage_images(images: Path, begun: Path) -> tuple[dict[str, str], list[str]]:
    """Put images and masks where COLMAP expects them; return their names by those there, and the unreadable ones."""
    names, unreadable, sizes = {}, [], {}
    for path in pictures_in(images, deep=True):
        name = path.relative_to(images).as_posix()
        try:
            pixels = read_image(path)
        except UnreadableImageError:
            unreadable.append(name)
            continue
        # COLMAP reads no WebP.
        staged = f"{name}.png" if path.suffix.lower() == ".webp" else name
        names[staged], sizes[name] = name, size_of(pixels)
        _stage_image(path, pixels, begun / "images" / staged)
        _stage_mask(images, pixels, name, begun / "masks" / f"{staged}.png")
    if len(names) < MIN_VIEWS:
        unread = f" and {len(unreadable)} that cannot be read: {listed(unreadable, most=8)}" if unreadable else ""
        wanted, got = f"at least {MIN_VIEWS} photographs ({', '.join(PICTURE_SUFFIXES)})", f"{len(names)}{unread}"
        raise CaptureError.expected(wanted, len(names), got=got, file=images, name="photographs")
    usual = max(sizes.values(), key=list(sizes.values()).count)
    odd = [name for name, size in sizes.items() if size != usual]
    if odd:
        got = f"most of {usual[0]} x {usual[1]} pixels, but not {listed(odd, most=8)}"
        wanted, advice = "photographs of one size", "give photographs of one camera in one orientation"
        raise CaptureError.expected(wanted, odd, got=got, file=images, name="sizes", advice=advice)
    return names, unreadable


def _stage_image(path: Path, pixels: np.ndarray, staged: Path) -> None:
    """Link or write one image under the name that it is given."""
    staged.parent.mkdir(parents=True, exist_ok=True)
    if staged.suffix != path.suffix:
        cv2.imwrite(str(staged), pixels[..., 2::-1])
        return
    try:
        staged.symlink_to(path.resolve())
    except OSError:  # file systems without links
        shutil.copyfile(path, staged)


def _stage_mask(images: Path, pixels: np.ndarray, name: str, staged: Path) -> None:
    """Write the image's mask, where it has one, as COLMAP reads it."""
    path = next((path for path in mask_paths(name, images.parent) if path.is_file()), None)
    if pixels.shape[2] == 3 and path is None:
        return
    mask = pixels[..., 3] if path is None or pixels.shape[2] == 4 else read_mask(path)
    if size_of(mask) != size_of(pixels):
        mask = cv2.resize(mask, size_of(pixels), interpolation=cv2.INTER_NEAREST)
    staged.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(staged), np.where(mask >= 128, 255, 0).astype(np.uint8))


def _run_worker(begun: Path, *, timeout: float) -> dict[str, list[str]]:
    """Return the images of each of the worker's models, the largest first; raises CaptureError where it fails."""
    log, result = begun / "worker.log", begun / "result.json"
    # -P keeps this folder, whose modules have common names, from where the worker looks for libraries.
    command = [sys.executable, "-P", str(WORKER), str(begun / "job.json")]
    try:
        with open(log, "wb") as output, child_process(command, stdout=output, stderr=output) as worker:
            worker.wait(timeout)
    except OSError as error:
        wanted = "a process for structure from motion"
        raise CaptureError.expected(wanted, error.strerror, name="starting") from error
    except subprocess.TimeoutExpired as error:
        wanted, stage = f"structure from motion within {timeout:g} s", _stage_and_lines(log)[0]
        advice = "increase timeout, or give fewer or smaller photographs"
        raise CaptureError.expected(wanted, timeout, got="no result", name=stage, advice=advice) from error
    if worker.returncode != 0 or not result.is_file():
        (stage, lines), ending = _stage_and_lines(log), ending_of(worker.returncode)
        advice = "where memory ran out, give smaller photographs; " if ending == "SIGKILL" else ""
        advice += f"its last output:\n{lines}"
        wanted = "structure from motion to end without an error"
        raise CaptureError.expected(wanted, ending, got=ending, name=stage, advice=advice)
    registered: dict[str, list[str]] = json.loads(result.read_text(encoding="utf-8"))
    return dict(sorted(registered.items(), key=lambda model: -len(model[1])))


def _stage_and_lines(log: Path) -> tuple[str, str]:
    """Return the stage that the worker came to, and its last lines."""
    lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    stages = [line.removeprefix("stage ") for line in lines if line.startswith("stage ")]
    output = [f"  {line[:200]}" for line in lines if not line.startswith("stage ")]
    return stages[-1] if stages else "starting", "\n".join(output[-6:])


def _check_groups(
    groups: Sequence[Sequence[str]], unreadable: Sequence[str], everything: Sequence[str], images: Path
) -> list[CaptureWarning]:
    """Return remarks on the images without a camera in the first and largest group; raise CaptureError for too many."""
    largest = set(groups[0]) if groups else set()
    if len(largest) < max(MIN_VIEWS, 0.5 * len(everything)):
        lacking = [name for name in everything if name not in largest]
        apart = f" in {len(groups)} groups that could not be joined" if len(groups) > 1 else ""
        got = f"{len(largest)} of {len(everything)}{apart}, none for {listed(lacking)}"
        advice = "take sharp photographs 10 to 15 degrees apart, with a patterned, fixed ground in view"
        wanted = "cameras of most photographs"
        raise CaptureError.expected(wanted, lacking, got=got, file=images, name="cameras", advice=advice)
    # Groups overlap: an image may belong to several that could not be joined.
    others = [rest for group in groups[1:] if (rest := [name for name in group if name not in largest])]
    named = largest.union(unreadable, *others)
    unseen = [name for name in everything if name not in named]
    split = f"the photographs form {len(groups)} groups that could not be joined; only the largest, of {len(largest)}"
    lost = "; ".join(listed(names, most=8) for names in others)
    unread = f"{counted(len(unreadable), 'image')} not used, as they cannot be read: {listed(unreadable, most=8)}"
    alone = f"no camera was found for {counted(len(unseen), 'image')}: {listed(unseen, most=8)}"
    remarks = [
        CaptureWarning(unread, name="unreadable images", value=unreadable),
        CaptureWarning(f"{split} images, is used, without {lost}", name="groups", value=others),
        CaptureWarning(alone, name="cameras", value=unseen),
    ]
    return [remark for remark in remarks if remark.value]
