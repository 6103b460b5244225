from .extraction.extract import Extraction as Extraction
from .extraction.extract import extract_modes as extract_modes
from .extraction.finders import HighResolution as HighResolution
from .extraction.stft import ShortTime as ShortTime
from .modes import ForcePulse as ForcePulse
from .modes import ModalBank as ModalBank
from .residual_noise import Residual as Residual
