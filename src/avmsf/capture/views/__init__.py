"""Photographs with cameras: read from folders, undistorted, with masks of the object on a plain background."""

from avmsf.capture.views.foreground import background_color, find_foreground
from avmsf.capture.views.read import read_views
from avmsf.capture.views.sparse import read_sparse_points

__all__ = ["background_color", "find_foreground", "read_sparse_points", "read_views"]
