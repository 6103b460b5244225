from .example import EXAMPLE_FOLDER as EXAMPLE_FOLDER
from .examplemesh import example_mesh as example_mesh
from .material import MATERIALS as MATERIALS
from .material import Material as Material
from .truth import Truth as Truth
from .truth import read_truth as read_truth
