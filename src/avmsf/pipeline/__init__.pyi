from .bodies import candidate_bodies as candidate_bodies
from .bodies import guess_field as guess_field
from .config import PRESETS as PRESETS
from .config import BodyConfig as BodyConfig
from .config import PipelineConfig as PipelineConfig
