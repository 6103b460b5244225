"""What identifies a splatting's checkpoint."""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict

from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.config import SplatConfig
from avmsf.photographs.cameras import View

_VERSION = 1


def fingerprint(views: Sequence[View], cloud: GaussianCloud, config: SplatConfig) -> str:
    """Return a digest of a splatting's views, start and settings."""
    digest = hashlib.sha256(repr((_VERSION, asdict(config))).encode())
    for view in views:
        camera = view.camera
        digest.update(repr((view.name, camera.focal, camera.principal, camera.width, camera.height)).encode())
        for each in (camera.world_to_camera, view.image, view.mask):
            digest.update(b"none" if each is None else each.contiguous().numpy().tobytes())
    for each in (cloud.centers, cloud.rotations, cloud.log_scales, cloud.logit_opacities, cloud.harmonics):
        digest.update(each.contiguous().numpy().tobytes())
    return digest.hexdigest()
