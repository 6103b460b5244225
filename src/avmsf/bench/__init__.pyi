from .baselines import MeanWaveform as MeanWaveform
from .baselines import NearestRecording as NearestRecording
from .evaluation import Scores as Scores
from .evaluation import align_split as align_split
from .evaluation import evaluate as evaluate
from .evaluation import score as score
from .evaluation import split as split
from .renderer import Renderer as Renderer
