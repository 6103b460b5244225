from .find import find_symmetries as find_symmetries
from .symmetries import Symmetries as Symmetries
