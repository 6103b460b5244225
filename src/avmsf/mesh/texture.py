"""Colors looked up in texture images, smaller copies of which serve where a pixel spans many texels."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8


class TextureAtlas:
    """Images that repeat without end, each with copies of half, a quarter, ... of its size."""

    def __init__(self, images: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> None:
        self.levels = [_halvings(image) for image in images]
        self.sizes = np.array([image.shape[1::-1] for image in images], dtype=np.float64)

    def sample(
        self,
        places: Float[np.ndarray, "samples 2"],
        materials: Int[np.ndarray, " samples"],
        *,
        spans: Float[np.ndarray, " samples"],
    ) -> Float[np.ndarray, "samples 3"]:
        """Return the colors, 0 to 1, at places u (right) and v (up), by bilinear interpolation between texels.

        `spans` says how many texels of the full image lie side by side under a sample; the copy is read in which that
        is between one and two.
        """
        colors = np.empty((len(places), 3), dtype=np.float32)
        for material, levels in enumerate(self.levels):
            if len(self.levels) == 1:
                chosen: np.ndarray | slice = slice(None)
            else:
                chosen = np.flatnonzero(materials == material)
            if levels[0].shape[:2] == (1, 1):
                colors[chosen] = levels[0][0, 0]
                continue
            level = np.log2(np.maximum(spans[chosen], 1.0)).astype(np.intp)
            level = np.minimum(level, len(levels) - 1)
            own, found = places[chosen], np.empty((len(level), 3), dtype=np.float32)
            for number in np.unique(level):
                here = level == number
                found[here] = _bilinear(levels[number], own[here])
            colors[chosen] = found
        return colors / np.float32(255)


def _halvings(image: UInt8[np.ndarray, "height width 3"]) -> list[UInt8[np.ndarray, "_ _ 3"]]:
    levels = [image]
    while max(levels[-1].shape[:2]) > 1:
        height, width = levels[-1].shape[:2]
        half = (max(width // 2, 1), max(height // 2, 1))
        levels.append(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA))
    return levels


def _bilinear(
    image: UInt8[np.ndarray, "height width 3"], places: Float[np.ndarray, "samples 2"]
) -> Float[np.ndarray, "samples 3"]:
    height, width = image.shape[:2]
    # A texel's color belongs to its center, half a texel from its edges; rows run down while v runs up.
    across, down = places[:, 0] * width - 0.5, (1 - places[:, 1]) * height - 0.5
    left, top = np.floor(across), np.floor(down)
    right_part, low_part = (across - left).astype(np.float32), (down - top).astype(np.float32)
    columns = (left.astype(np.intp) % width, (left.astype(np.intp) + 1) % width)
    rows = (top.astype(np.intp) % height, (top.astype(np.intp) + 1) % height)
    color = np.zeros((len(places), 3), dtype=np.float32)
    flat = image.reshape(-1, 3)
    for row, down_part in zip(rows, (1 - low_part, low_part), strict=True):
        for column, across_part in zip(columns, (1 - right_part, right_part), strict=True):
            color += flat[row * width + column] * (down_part * across_part)[:, None]
    return color
