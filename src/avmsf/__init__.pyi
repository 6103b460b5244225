from . import bench as bench
from . import capture as capture
from . import errors as errors
from . import evaluation as evaluation
from . import export as export
from . import fem as fem
from . import field as field
from . import geometry as geometry
from . import localization as localization
from . import modal as modal
from . import pipeline as pipeline
from . import plotting as plotting
from . import scene as scene
from . import simulate as simulate
from . import studio as studio
from . import tasks as tasks
from .bench.evaluation import evaluate as evaluate
from .capture import Capture as Capture
from .capture import Surface as Surface
from .field.soundfield import SoundField as SoundField
from .localization.locate import locate as locate
from .modal.extraction.extract import extract_modes as extract_modes

__version__: str
