from .scores import Scores as Scores
from .scores import evaluate as evaluate
from .scores import score as score
from .simple_methods import MeanWaveform as MeanWaveform
from .simple_methods import NearestRecording as NearestRecording
from .splits import align_split as align_split
from .splits import split as split
from .task import Renderer as Renderer
