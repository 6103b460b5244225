"""Methods other than fields: each fits a renderer to an object's training recordings, or reads its sounds from files.

Those that share modes have noise too, as the field has: without it all is silent between modes, and L1-log is
lost.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.device import usable_device
from avmsf.baselines.diffsound.material_fit import DiffSoundConfig
from avmsf.baselines.diffsound.renderer import DiffSound, fit_diffsound
from avmsf.baselines.sonicgauss.published import PublishedSonicGauss, fit_published, folder_digest
from avmsf.baselines.sonicgauss.small import SmallWeights, fit_small
from avmsf.baselines.sonicgauss.training import TunedRenderer
from avmsf.capture.audio import read_recording
from avmsf.errors import CaptureError, EvaluationError
from avmsf.evaluation.registry import kind_of, method_entry, resolve
from avmsf.evaluation.simple_methods import (
    MeanGains,
    MeanWaveform,
    NearestRecording,
    RandomImpact,
    SplineGains,
    WhiteNoise,
)
from avmsf.evaluation.task import Contacts, Method, Renderer, Sounds, Task
from avmsf.fem.material import MATERIALS

NEIGHBORS = 3
"""Number of nearest recordings that are averaged (the paper's KNN), or all where there are fewer."""
_SAME_POSITION_M = 1e-6
"""Distance of one contact from itself after float32, far below that of any two."""


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
    if not entry.make:
        return FunctionMethod(name, partial(resolve(entry.fit), **entry.settings))
    made: Method = resolve(entry.make)(name, **entry.settings, **settings)
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


@dataclass(frozen=True)
class RecordedMethod:
    """Another system, by its wav files: FOLDER/OBJECT/RECORDING.wav, as `Recorded` reads them."""

    name: str
    """`recorded:` and the folder."""
    path: Path
    """Holds a folder of sounds for every object."""

    def digest(self, name: str) -> str:
        """Return a digest of an object's wavs, which decide its figures."""
        digest, folder = hashlib.sha256(), self.path / name
        for file in sorted(folder.rglob("*")):
            if file.suffix.lower() == ".wav" and file.is_file():
                digest.update(f"{file.relative_to(folder).as_posix()}\0{file.stat().st_size}\0".encode())
                digest.update(file.read_bytes())
        return digest.hexdigest()

    def fit(self, task: Task) -> "Recorded":
        """Find the object's folder. Raises EvaluationError where there is none."""
        return Recorded(task, self.path / task.name)


@dataclass(frozen=True, eq=False)
class Recorded:
    """Wav files, one a recording of the object, that are looked up by the contact of that recording.

    FOLDER/RECORDING.wav for the recording called RECORDING or RECORDING.wav, whose name may hold folders. Of several
    recordings at one contact the first with a file is used for all. Files are read on demand, so that only those of the
    evaluated contacts are needed.
    """

    task: Task
    """Has the contacts and names of the object's recordings, and the sample rate and length that files must have."""
    folder: Path
    """Holds the object's files."""

    def __post_init__(self) -> None:
        if not self.folder.is_dir():
            wanted = f"a folder with the object's sounds, such as {self._path(self.task.names[0]).name}"
            advice = "render them there, or omit the object"
            raise EvaluationError.expected(wanted, file=self.folder, advice=advice)

    @property
    def sample_rate(self) -> float:
        """Samples per second, Hz."""
        return self.task.train.sample_rate

    def render(self, contacts: Contacts, *, directions: Contacts | None = None) -> Sounds:
        """Return the files' sounds, as they are.

        Raises EvaluationError for a contact without a recording, for a missing file, and for one that is no sound, has
        several different channels or another rate or length.
        """
        sounds = [self._read(self._find(contact)) for contact in contacts]
        return torch.stack(sounds) if sounds else self.task.train.sounds[:0].float()

    def _path(self, name: str) -> Path:
        return self.folder / (name if name.lower().endswith(".wav") else f"{name}.wav")

    def _find(self, contact: Float[Tensor, "3"]) -> Path:
        near = (self.task.contacts.double() - contact.double()).norm(dim=1) < _SAME_POSITION_M
        names = [self.task.names[row] for row in torch.nonzero(near).flatten().tolist()]
        if not names:
            wanted = "a contact of a recording, at which alone sounds from files are available"
            position = contact.tolist()
            got = f"({', '.join(f'{value:g}' for value in position)}) m"
            raise EvaluationError.expected(wanted, position, got=got, file=self.folder, name="contacts")
        paths = [self._path(name) for name in names]
        for path in paths:
            if path.is_file():
                return path
        raise EvaluationError.expected(
            self._wanted, got="no such file", file=paths[0], name=names[0], advice="render it"
        )

    def _read(self, path: Path) -> Float[Tensor, " samples"]:
        try:
            recording = read_recording(path)
        except CaptureError as error:
            raise EvaluationError(str(error), **{**error.attributes, "file": path}) from error
        found = recording.frames, recording.sample_rate, len(np.unique(recording.channels, axis=0))
        if found != (self.task.train.sounds.shape[1], self.sample_rate, 1):
            shown = f"{found[0]} samples at {found[1]:g} Hz in {found[2]} different channels"
            advice = "render it again, from the onset on, and save it as mono"
            raise EvaluationError.expected(self._wanted, found, got=shown, file=path, name="samples", advice=advice)
        return torch.from_numpy(recording.channels[0].copy()).float()

    @property
    def _wanted(self) -> str:
        samples = self.task.train.sounds.shape[1]
        return f"a mono wav of {samples} samples at {self.sample_rate:g} Hz, as the recordings have"
