from .material import MATERIALS as MATERIALS
from .material import Material as Material
