"""The sound of real objects: from a few taps to a field that sounds right wherever the object is struck."""

from avmsf.bench.evaluation import evaluate, split
from avmsf.capture import Capture, CaptureSettings, Impacts, Surface, check, read_capture, write_capture
from avmsf.field.config import PAPER, FitConfig
from avmsf.field.fit import fit
from avmsf.field.soundfield import SoundField
from avmsf.modal.bank import ModalBank
from avmsf.modal.extract import HighResolution, ShortTime, extract
from avmsf.modal.extraction import Extraction
from avmsf.modal.residual import Residual
from avmsf.scene.features import FeatureField

__version__ = "0.1.0"
