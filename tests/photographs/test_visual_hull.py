"""Votes of views on the cells of grids, against a camera's own projection."""

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from avmsf.photographs.visual_hull import Grid, project_votes
from factories.views_folder import HEIGHT, WIDTH, ring


@pytest.mark.parametrize("linear", [False, True])
def test_votes_are_the_images_values_where_a_camera_projects_the_cells(linear: bool) -> None:
    cameras, generator = ring(3), np.random.default_rng(0)
    images = [generator.random((HEIGHT, WIDTH)) for _ in cameras]
    # Some of its cells are beyond the images and some behind the cameras, which are 2 m from its middle.
    grid = Grid(np.array([-2.513, -1.487, -1.031]), 0.2317, (22, 14, 9))
    cells = np.sort(generator.choice(22 * 14 * 9, 1500, replace=False))
    votes = np.zeros((2, 3, len(cells)))

    def keep(part: slice, view: int, values: np.ndarray, depths: np.ndarray) -> None:
        votes[:, view, part] = values, depths

    project_votes(grid, cells, cameras, images, keep, linear=linear)
    centers = grid.centers(np.stack(np.unravel_index(cells, grid.shape), axis=1))
    for camera, image, values, depths in zip(cameras, images, *votes, strict=True):
        pixels, depth = (each.numpy() for each in camera.project(torch.from_numpy(centers)))
        assert depths == pytest.approx(depth)
        seen = ((pixels >= 0) & (pixels < [WIDTH, HEIGHT])).all(axis=1)
        assert np.array_equal(np.isnan(values), ~seen)
        assert 100 < seen.sum() < len(cells) - 100
        assert (depth < 0).any()
        rows, columns = pixels[seen, 1], pixels[seen, 0]
        if linear:
            expected = map_coordinates(image, [rows - 0.5, columns - 0.5], order=1, mode="nearest")
        else:
            expected = image[rows.astype(int), columns.astype(int)]
        # At the last row and column weights are a thousandth short.
        assert values[seen] == pytest.approx(expected, abs=2e-3)
