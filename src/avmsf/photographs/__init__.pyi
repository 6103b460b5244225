from .cameras import Camera as Camera
from .cameras import View as View
from .folder import read_views as read_views
from .segmentation import background_color as background_color
from .segmentation import find_foreground as find_foreground
from .sparse import read_sparse_points as read_sparse_points
from .write import write_views as write_views
