from .config import DistillationConfig as DistillationConfig
from .config import GuidedEditConfig as GuidedEditConfig
from .distillation import DecoderDistillation as DecoderDistillation
from .guided import edit_towards as edit_towards
from .material import change_material as change_material
from .modal_edit import adjust_modes as adjust_modes
from .reference import Reference as Reference
from .stable_audio import StableAudio as StableAudio
