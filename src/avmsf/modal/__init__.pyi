from .bank import ModalBank as ModalBank
from .extraction.extract import Extraction as Extraction
from .extraction.extract import extract_modes as extract_modes
from .extraction.finders import HighResolution as HighResolution
from .extraction.finders import ShortTime as ShortTime
from .pulse import ForcePulse as ForcePulse
from .residual_noise import Residual as Residual
