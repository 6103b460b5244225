"""Views written as a folder that `read_views` reads back, and any tool that knows transforms.json."""

import json
import os
import shutil
import uuid
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np

from avmsf._utils.files import unwritable
from avmsf.capture.location import check_free
from avmsf.errors import CaptureError
from avmsf.photographs.cameras import View

_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_views(views: Sequence[View], folder: str | Path) -> None:
    """Write `transforms.json`, `images/NAME.png` and, for views that have one, `masks/NAME.png`.

    `read_views` reads back the same pixels, masks and names except for the names' suffixes, and cameras to rounding.
    The folder is complete or absent. Raises CaptureError where it exists and is not empty, where two views would have
    one file, and where it cannot be written.
    """
    folder = Path(folder)
    check_free(folder)
    names = [str(PurePosixPath(view.name).with_suffix(".png")) for view in views]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise CaptureError.expected(
            "views with different names", repeated, got=f"several for {repeated[0]}", file=folder, name=repeated[0]
        )
    begun = folder.with_name(f".{folder.name}.{uuid.uuid4().hex[:8]}")
    try:
        begun.mkdir(parents=True)
        for name, view in zip(names, views, strict=True):
            _write_image(begun / "images" / name, view.image.cpu().numpy()[..., ::-1])
            if view.mask is not None:
                _write_image(begun / "masks" / name, view.mask.cpu().numpy())
        frames = [_frame(name, view) for name, view in zip(names, views, strict=True)]
        (begun / "transforms.json").write_text(json.dumps({"camera_model": "PINHOLE", "frames": frames}, indent=1))
        if folder.exists():
            folder.rmdir()
        os.rename(begun, folder)
    except OSError as error:
        raise unwritable(folder, error, raising=CaptureError) from error
    finally:
        shutil.rmtree(begun, ignore_errors=True)


def _frame(name: str, view: View) -> dict[str, Any]:
    camera = view.camera
    pose = np.linalg.inv(camera.world_to_camera.cpu().numpy()) @ _OPENCV_FROM_OPENGL
    frame = {
        "file_path": f"images/{name}",
        "transform_matrix": pose.tolist(),
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.focal[0],
        "fl_y": camera.focal[1],
        "cx": camera.principal[0],
        "cy": camera.principal[1],
    }
    return frame if view.mask is None else frame | {"mask_path": f"masks/{name}"}


def _write_image(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    # Low compression is several times faster, and these files are read once or twice.
    written, content = cv2.imencode(".png", np.ascontiguousarray(pixels), [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not written:
        raise OSError(f"{path}: the image could not be encoded as PNG")
    path.write_bytes(content.tobytes())
