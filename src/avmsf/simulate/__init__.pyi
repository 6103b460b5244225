from .ground_truth import Truth as Truth
from .ground_truth import read_truth as read_truth
from .recipe import EXAMPLE_FOLDER as EXAMPLE_FOLDER
from .simulation_folder import example_mesh as example_mesh
