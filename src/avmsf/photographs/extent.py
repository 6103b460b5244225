"""Which views have masks, and where their object is and how large."""

import warnings
from collections.abc import Sequence

import numpy as np

from avmsf.errors import CaptureWarning, SceneError
from avmsf.photographs.cameras import View


def masked_views(views: Sequence[View]) -> list[View]:
    """Return the views whose masks show something; a CaptureWarning names those whose masks are empty.

    Raises SceneError for fewer than 3.
    """
    known = [view for view in views if view.mask is not None]
    empty = [view.name for view in known if view.mask is not None and not bool((view.mask > 127).any())]
    if known and len(empty) == len(known):
        wanted, got = "the object in the masks", f"only background in all {len(known)}"
        advice = "check that white is the object, or remove the masks so that the foreground is found"
        raise SceneError.expected(wanted, empty, got=got, name="masks", advice=advice)
    if empty:
        message = f"views whose masks are empty are not used: {', '.join(empty)}"
        warnings.warn(CaptureWarning(message, name="masks", value=empty), stacklevel=3)
    kept = [view for view in known if view.name not in empty]
    if len(kept) < 3:
        wanted, got = "3 or more views with a mask", f"{len(kept)} of {len(views)}"
        advice = "give masks, images with alpha or a plain background, or initial points"
        raise SceneError.expected(wanted, len(kept), got=got, name="views", advice=advice)
    return kept


def no_common_point(views: int) -> SceneError:
    """Return the error of masks of this many views that no point of the object frame lies in."""
    return SceneError.expected(
        "masks with a common volume",
        views,
        got=f"none from {views} views",
        name="masks",
        advice="check that cameras and masks belong together and that the poses have the convention of their file "
        "(shifted or small masks miss thin objects)",
    )


def object_extent(views: Sequence[View]) -> tuple[np.ndarray, float]:
    """Return about where the object's middle is, [3] in the object frame, and how far it reaches from there, meters.

    The middle is the point nearest to the lines of sight through the masks' middles; those that miss it by far have
    little weight (iteratively reweighted least squares).
    """
    positions, directions, sizes = [], [], []
    for view in views:
        assert view.mask is not None
        rows, columns = np.nonzero(view.mask.numpy() > 127)
        camera = view.camera
        pixel = np.array([np.median(columns) + 0.5, np.median(rows) + 0.5])
        ray = np.append((pixel - camera.principal) / camera.focal, 1.0)
        rotation = camera.world_to_camera[:3, :3].numpy()
        directions.append(ray / np.linalg.norm(ray) @ rotation)
        positions.append(camera.position.numpy())
        sizes.append(max(np.ptp(columns) / camera.focal[0], np.ptp(rows) / camera.focal[1]))
    starts, rays = np.stack(positions), np.stack(directions)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    weight = np.ones(len(views))
    for _ in range(10):
        weighted = across * weight[:, None, None]
        # Parallel lines of sight leave one direction open, which the minimum norm solution sets to 0.
        middle = np.linalg.lstsq(weighted.sum(0), np.einsum("vij,vj->i", weighted, starts), rcond=1e-9)[0]
        missed = np.linalg.norm(np.einsum("vij,vj->vi", across, middle - starts), axis=1)
        weight = 1.0 / (missed + 1e-3 * np.median(np.linalg.norm(middle - starts, axis=1)))
    distance = np.abs(np.einsum("vi,vi->v", middle - starts, rays))
    # Half the largest extent, and as much again as the middle of a mask may lie off the object's.
    return middle, float(0.8 * np.quantile(np.array(sizes) * distance, 0.9))
