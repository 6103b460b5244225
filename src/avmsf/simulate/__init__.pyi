from .example import EXAMPLE_FOLDER as EXAMPLE_FOLDER
from .example import example_mesh as example_mesh
from .ground_truth import Truth as Truth
from .ground_truth import read_truth as read_truth
