"""Methods other than fields; a method fits a renderer to an object's training recordings.

Those that share modes have noise too, as the field has: without it all is silent between modes, and L1-log is
lost.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from avmsf._utils.device import usable_device
from avmsf.baselines.diffsound.material_fit import DiffSoundConfig
from avmsf.baselines.diffsound.renderer import DiffSound, fit_diffsound
from avmsf.baselines.sonicgauss.published import PublishedSonicGauss, fit_published, folder_digest
from avmsf.baselines.sonicgauss.small import SmallWeights, fit_small
from avmsf.baselines.sonicgauss.training import TunedRenderer
from avmsf.errors import EvaluationError
from avmsf.evaluation.registry import kind_of, method_entry, resolve
from avmsf.evaluation.simple_methods import (
    MeanGains,
    MeanWaveform,
    NearestRecording,
    RandomImpact,
    SplineGains,
    WhiteNoise,
)
from avmsf.evaluation.task import Method, Renderer, Task
from avmsf.fem.material import MATERIALS

NEIGHBORS = 3
"""Number of nearest recordings that are averaged (the paper's KNN), or all where there are fewer."""


@dataclass(frozen=True)
class FunctionMethod:
    """A method that is a function of the task."""

    name: str
    """Name in tables."""
    fit: Callable[[Task], Renderer] = field(repr=False)
    """Makes the renderer from the task's training recordings. Raises AvmsfError where it cannot."""
    weights: str = ""
    """Digest of the weights that it starts from: results of other weights are not mixed."""


def method_named(name: str) -> Method:
    """Return the method of this name. Raises EvaluationError that lists the known ones, and for a missing path."""
    entry, settings = method_entry(name), {}
    if entry.path:
        given = name.partition(":")[2]
        path = Path(given).expanduser()
        if not given or not (path.is_dir() if entry.is_folder else path.is_file()):
            wanted = f"{entry.path} after `{kind_of(name)}:`"
            raise EvaluationError.expected(wanted, name, file=path if given else None, name="method")
        # However it is written: results of one path are those of one method.
        name, settings = f"{kind_of(name)}:{path}", {"path": path}
    made: Method
    if entry.make:
        made = resolve(entry.make)(name, **entry.settings, **settings)
    else:
        made = FunctionMethod(name, partial(resolve(entry.fit), **entry.settings))
    return made


def white_noise(task: Task) -> WhiteNoise:
    """Return noise as loud as the training recordings (the paper's White Noise)."""
    return WhiteNoise(task.train, seed=task.seed)


def random_impact(task: Task) -> RandomImpact:
    """Return a recording of another object (the paper's Random Impact)."""
    return RandomImpact(task.other_recording(), task.train.sample_rate)


def nearest_recording(task: Task) -> NearestRecording:
    """Return the nearest training recording."""
    return NearestRecording(task.train)


def mean_waveform(task: Task, *, by_direction: bool = False) -> MeanWaveform:
    """Return the mean of the nearest training recordings (the paper's KNN)."""
    return MeanWaveform(task.train, min(NEIGHBORS, len(task.train)), by_direction)


def mean_gains(task: Task) -> MeanGains:
    """Return the shared modes with the mean of the nearest recordings' gains."""
    count = min(NEIGHBORS, len(task.train))
    return MeanGains(task.train, task.modes(), count=count, noise=True, seed=task.seed)


def spline_gains(task: Task) -> SplineGains:
    """Return the shared modes with gains by splines over the contacts."""
    return SplineGains(task.train, task.modes(), noise=True, seed=task.seed)


def diffsound(task: Task, *, weighted: bool = False, config: DiffSoundConfig | None = None) -> DiffSound:
    """Fit the material of a simulation, from the dataset's material where it is in the table.

    With `weighted` each mode has a weight of its own, fitted to the training recordings. Raises AvmsfError where the
    object has no body, or its recordings no modes.
    """
    config = config or DiffSoundConfig()
    if task.material in MATERIALS:
        config = replace(config, material=task.material)
    return fit_diffsound(task.train, task.family(), task.modes(), config, weighted=weighted)


def sonicgauss(name: str, path: Path) -> FunctionMethod:
    """Return the published architecture and weights in a folder, fine-tuned, on CUDA where there is a GPU."""

    def fit(task: Task) -> TunedRenderer:
        model = PublishedSonicGauss.load(path).to(usable_device(task.device, raising=EvaluationError))
        return fit_published(model, task.gaussians(), task.train, seed=task.seed)

    return FunctionMethod(name, fit, folder_digest(path))


def sonicgauss_small(name: str, path: Path) -> FunctionMethod:
    """Return the small generator of a file, trained from scratch on simulated objects, fine-tuned."""

    def fit(task: Task) -> TunedRenderer:
        return fit_small(SmallWeights.read(path), task.gaussians(), task.train, seed=task.seed)

    return FunctionMethod(name, fit, hashlib.sha256(path.read_bytes()).hexdigest()[:16])
