import pathlib

from . import baselines as baselines
from . import capture as capture
from . import datasets as datasets
from . import editing as editing
from . import errors as errors
from . import evaluation as evaluation
from . import export as export
from . import features as features
from . import fem as fem
from . import field as field
from . import gaussians as gaussians
from . import localization as localization
from . import mesh as mesh
from . import modal as modal
from . import photographs as photographs
from . import pipeline as pipeline
from . import plotting as plotting
from . import reconstruction as reconstruction
from . import simulate as simulate
from . import studio as studio
from . import symmetry as symmetry
from .capture import Capture as Capture
from .editing.material import edit as edit
from .evaluation.scores import evaluate as evaluate
from .evaluation.splits import split as split
from .export.write import write as write
from .field.next_contacts import suggest as suggest
from .field.sound_field import SoundField as SoundField
from .field.store import load as load
from .localization.locate import locate as locate
from .mesh import Surface as Surface
from .modal.extraction.extract import extract_modes as extract_modes
from .pipeline.fit import fit as fit

__version__: str

def read(folder: str | pathlib.Path, settings: capture.CaptureSettings | None = None) -> Capture: ...
