"""DiffSound as a method of `evaluate`."""

from dataclasses import dataclass, field, replace

from avmsf.baselines.diffsound.material_fit import DiffSoundConfig
from avmsf.baselines.diffsound.renderer import DiffSound, fit_diffsound
from avmsf.evaluation.task import Task
from avmsf.fem.material import MATERIALS


@dataclass(frozen=True)
class DiffSoundMethod:
    """A simulation whose material is fitted to the training recordings, from the dataset's material where it is known.

    A material that is not in the table, such as metal, counts as not known.
    """

    name: str
    """What tables call it."""
    weighted: bool = False
    """Whether each mode has a weight of its own, fitted to the training recordings."""
    config: DiffSoundConfig = field(default_factory=DiffSoundConfig)

    def fit(self, task: Task) -> DiffSound:
        """Fit the material. Raises AvmsfError where the object has no body, or its recordings no modes."""
        known = task.material if task.material in MATERIALS else None
        config = self.config if known is None else replace(self.config, material=known)
        return fit_diffsound(task.train, task.family(), task.modes(), config, weighted=self.weighted)
