import avmsf.config as _config

from .bodies import candidate_bodies as candidate_bodies
from .fitting import fit_capture as fit_capture
from .guess import guess_field as guess_field

PRESETS = _config.PRESETS
BodyConfig = _config.BodyConfig
PipelineConfig = _config.PipelineConfig
