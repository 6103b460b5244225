"""SonicGauss as methods of `evaluate`: the published weights, and small ones trained from scratch."""

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

from avmsf._utils.device import usable_device
from avmsf.baselines.sonicgauss.published import PublishedSizes, PublishedSonicGauss, folder_digest
from avmsf.baselines.sonicgauss.published_renderer import EPOCHS, PublishedRenderer, fit_published
from avmsf.baselines.sonicgauss.small import SmallWeights
from avmsf.baselines.sonicgauss.small_renderer import TUNING, SmallRenderer, fit_small
from avmsf.baselines.sonicgauss.tuning import TrainingConfig
from avmsf.errors import EvaluationError
from avmsf.evaluation.names import PUBLISHED, SMALL
from avmsf.evaluation.task import Task


@dataclass(frozen=True)
class SonicGaussMethod:
    """The published architecture and weights, fine-tuned to each object, on CUDA where there is a GPU."""

    folder: Path
    """Holds the published files."""
    sizes: PublishedSizes = field(default_factory=PublishedSizes)
    epochs: int = EPOCHS

    @property
    def name(self) -> str:
        """`sonicgauss:` and the folder."""
        return f"{PUBLISHED}{self.folder}"

    def __repr__(self) -> str:
        # Results of other weights are not mixed.
        return f"SonicGaussMethod(weights {folder_digest(self.folder)}, {self.sizes}, {self.epochs})"

    def fit(self, task: Task) -> PublishedRenderer:
        """Fine-tune. Raises AvmsfError for weights of another model, and for an object without Gaussians."""
        model = PublishedSonicGauss.load(self.folder, self.sizes)
        device = usable_device(task.device, raising=EvaluationError)
        return fit_published(model.to(device), task.gaussians(), task.train, epochs=self.epochs, seed=task.seed)


@dataclass(frozen=True)
class SmallSonicGaussMethod:
    """The small generator, trained from scratch on simulated objects, fine-tuned to each object."""

    file: Path
    """Weights that `python -m benchmarks baselines --parts sonicgauss-training` made."""
    config: TrainingConfig = TUNING

    @property
    def name(self) -> str:
        """`sonicgauss-small:` and the file."""
        return f"{SMALL}{self.file}"

    def __repr__(self) -> str:
        digest = hashlib.sha256(self.file.read_bytes()).hexdigest()[:16]
        return f"SmallSonicGaussMethod(weights {digest}, {self.config})"

    def fit(self, task: Task) -> SmallRenderer:
        """Fine-tune. Raises AvmsfError for a file of something else, and for an object without Gaussians."""
        return fit_small(SmallWeights.read(self.file), task.gaussians(), task.train, self.config, seed=task.seed)
