"""What an interrupted splatting goes on from."""

import hashlib
import io
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from avmsf.capture.cameras import View
from avmsf.errors import SceneError
from avmsf.files import write_whole
from avmsf.scene.gaussians import GaussianCloud
from avmsf.scene.splatconfig import SplatConfig

_VERSION = 1


def fingerprint(views: Sequence[View], cloud: GaussianCloud, config: SplatConfig) -> str:
    """Return what tells this splatting's views, start and settings from any other's."""
    digest = hashlib.sha256(repr((_VERSION, asdict(config))).encode())
    for view in views:
        camera = view.camera
        digest.update(repr((view.name, camera.focal, camera.principal, camera.width, camera.height)).encode())
        for each in (camera.world_to_camera, view.image, view.mask):
            digest.update(b"none" if each is None else each.contiguous().numpy().tobytes())
    for each in (cloud.centers, cloud.rotations, cloud.log_scales, cloud.logit_opacities, cloud.harmonics):
        digest.update(each.contiguous().numpy().tobytes())
    return digest.hexdigest()


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a run's state: tensors, numbers, words and containers of these. Raises `SceneError`."""
    content = io.BytesIO()
    torch.save(state, content)
    write_whole(path, lambda place: place.write_bytes(content.getvalue()), raising=SceneError)


def read_checkpoint(path: Path, *, fingerprint: str) -> dict[str, Any] | None:
    """Return the state at `path`, None where there is none.

    Raises `SceneError` for a file that is no checkpoint, or one of other views or settings, which `fingerprint` tells.
    """
    if not path.exists():
        return None
    try:
        state: dict[str, Any] = torch.load(path, weights_only=True, map_location="cpu")
        found = state["fingerprint"]
    # torch.load raises whatever unpacking raises, in words that advise to trust the file.
    except Exception as error:
        raise SceneError(
            f"{path}: expected a checkpoint of a splatting, found something else or a part of one: delete it or name "
            "another"
        ) from error
    if found != fingerprint:
        raise SceneError(
            f"{path}: this checkpoint belongs to other views or settings, or to another version: delete it to start "
            "anew, or repeat its arguments to go on with it"
        )
    return state
