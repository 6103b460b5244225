from .simple_methods import MeanWaveform as MeanWaveform
from .simple_methods import NearestRecording as NearestRecording
from .splits import Scores as Scores
from .splits import align_split as align_split
from .splits import evaluate as evaluate
from .splits import score as score
from .splits import split as split
from .task import Renderer as Renderer
