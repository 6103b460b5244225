from .cameras import Camera as Camera
from .cameras import View as View
from .folder import read_sparse_points as read_sparse_points
from .folder import read_views as read_views
from .folder import write_views as write_views
from .segmentation import find_foreground as find_foreground
