"""All methods by name; a method fits a renderer to an object's training recordings."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.device import usable_device
from avmsf.baselines.diffsound.material_fit import DiffSoundConfig
from avmsf.baselines.diffsound.renderer import DiffSound, fit_diffsound
from avmsf.baselines.sonicgauss.published import PublishedSonicGauss, fit_published, folder_digest
from avmsf.baselines.sonicgauss.small import COMMAND, SmallWeights, fit_small
from avmsf.baselines.sonicgauss.training import TunedRenderer
from avmsf.capture.audio import read_recording
from avmsf.errors import CaptureError, EvaluationError
from avmsf.evaluation.field_methods import NETWORK, PAPER_GRID, QUICK_GRID, FieldMethod
from avmsf.evaluation.registry import PUBLISHED, RECORDED, SMALL, expect_method, kind_of
from avmsf.evaluation.simple_methods import (
    MeanGains,
    MeanWaveform,
    NearestRecording,
    RandomImpact,
    SplineGains,
    WhiteNoise,
)
from avmsf.evaluation.task import Method, Renderer, Task, VisualInput
from avmsf.fem.material import MATERIALS
from avmsf.field.config import GainModel
from avmsf.pipeline.config import PRESETS, PipelineConfig


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


@dataclass(frozen=True, eq=False)
class Recorded:
    """Wav files, one a recording of the object, that are looked up by the contact of that recording.

    FOLDER/RECORDING.wav for the recording called RECORDING or RECORDING.wav, whose name may hold folders. Of several
    recordings at one contact the first with a file is used for all. Files are read on demand, so that only those of the
    evaluated contacts are needed.
    """

    folder: Path
    """Holds the object's files."""
    contacts: Float[Tensor, "contacts 3"]
    """Contacts of the object's recordings, meters."""
    names: tuple[str, ...]
    """The recordings' names, row for row."""
    sample_rate: float
    """Samples per second that the files must have, Hz."""
    samples: int
    """Samples that each file must have."""

    def __post_init__(self) -> None:
        if not self.folder.is_dir():
            example = self.path(self.names[0]).name if self.names else "RECORDING.wav"
            raise EvaluationError.expected(
                f"a folder with the object's sounds, such as {example}",
                file=self.folder,
                advice="render them there, or omit the object",
            )

    def path(self, name: str) -> Path:
        """Return where the sound that stands for a recording is expected."""
        return self.folder / (name if name.lower().endswith(".wav") else f"{name}.wav")

    def render(
        self, contacts: Float[Tensor, "contacts 3"], *, directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts samples"]:
        """Return the files' sounds, as they are.

        Raises EvaluationError for a contact without a recording, for a missing file, and for one that is no sound, has
        several different channels or another rate or length.
        """
        sounds = [self._read(self._find(contact)) for contact in contacts]
        return torch.stack(sounds) if sounds else torch.zeros(0, self.samples)

    def _find(self, contact: Float[Tensor, "3"]) -> Path:
        # Contacts that went through float32 are still the same places; a micrometer is far below any two's distance.
        rows = torch.nonzero((self.contacts.double() - contact.double()).norm(dim=1) < 1e-6).flatten().tolist()
        if not rows:
            place = ", ".join(f"{value:g}" for value in contact.tolist())
            raise EvaluationError(
                f"{self.folder}: expected a contact of a recording, got ({place}) m; sounds from files are available "
                "at recorded contacts only",
                file=self.folder,
                name="contacts",
                value=contact.tolist(),
            )
        paths = [self.path(self.names[row]) for row in rows]
        present = [path for path in paths if path.is_file()]
        if not present:
            raise EvaluationError.expected(
                self._wanted, got="no such file", file=paths[0], name=self.names[rows[0]], advice="render it"
            )
        return present[0]

    def _read(self, path: Path) -> Float[Tensor, " samples"]:
        try:
            recording = read_recording(path)
        except CaptureError as error:
            raise EvaluationError(str(error), **{**error.attributes, "file": path}) from error
        found = recording.frames, recording.sample_rate, len(np.unique(recording.channels, axis=0))
        if found != (self.samples, self.sample_rate, 1):
            shown = f"{found[0]} samples at {found[1]:g} Hz in {found[2]} different channels"
            advice = "render it again, from the onset on, and save it as mono"
            raise EvaluationError.expected(self._wanted, found, got=shown, file=path, name="samples", advice=advice)
        return torch.from_numpy(recording.channels[0].copy()).float()

    @property
    def _wanted(self) -> str:
        return f"a mono wav of {self.samples} samples at {self.sample_rate:g} Hz, as the recordings have"


NEIGHBORS = 3
"""Number of nearest recordings that are averaged (the paper's KNN), or all where there are fewer."""


@dataclass(frozen=True)
class Baseline:
    """A method without settings."""

    name: str
    """Name in tables."""
    make: Callable[[Task], Renderer] = field(repr=False)
    """Makes the renderer from the task's training recordings."""
    weights: str = ""
    """Digest of the weights that it starts from: results of other weights are not mixed."""

    def fit(self, task: Task) -> Renderer:
        """Make the renderer. Raises AvmsfError where it cannot."""
        return self.make(task)


@dataclass(frozen=True)
class RecordedMethod:
    """Another system, by its wav files: FOLDER/OBJECT/RECORDING.wav, as `Recorded` reads them."""

    folder: Path
    """Holds a folder of sounds for every object."""

    @property
    def name(self) -> str:
        """`recorded:` and the folder."""
        return f"{RECORDED}{self.folder}"

    def digest(self, name: str) -> str:
        """Return a digest of an object's wavs, which decide its figures."""
        digest, folder = hashlib.sha256(), self.folder / name
        for path in sorted(folder.rglob("*")):
            if path.suffix.lower() == ".wav" and path.is_file():
                digest.update(f"{path.relative_to(folder).as_posix()}\0{path.stat().st_size}\0".encode())
                digest.update(path.read_bytes())
        return digest.hexdigest()

    def fit(self, task: Task) -> Recorded:
        """Find the object's folder. Raises EvaluationError where there is none."""
        return Recorded(
            self.folder / task.name, task.contacts, task.names, task.train.sample_rate, task.train.sounds.shape[1]
        )


def _count(task: Task) -> int:
    return min(NEIGHBORS, len(task.train))


BASELINES = (
    Baseline("white-noise", lambda task: WhiteNoise(task.train, seed=task.seed)),
    Baseline("random-impact", lambda task: RandomImpact(task.other_recording(), task.train.sample_rate)),
    Baseline("nearest", lambda task: NearestRecording(task.train)),
    Baseline("knn3", lambda task: MeanWaveform(task.train, count=_count(task))),
    Baseline("knn3-directions", lambda task: MeanWaveform(task.train, count=_count(task), by_direction=True)),
    Baseline(
        "knn-gains",
        lambda task: MeanGains(task.train, task.modes(), count=_count(task), noise=True, seed=task.seed),
    ),
    Baseline("spline-gains", lambda task: SplineGains(task.train, task.modes(), noise=True, seed=task.seed)),
)
"""The paper's baselines that need nothing but data, then the strong ones that it leaves out. Those that share modes
have noise beside them, as the field has: without it all is silent between modes, and L1-log is lost."""

_PRESET = PRESETS["paper"]


def _paper(name: str, visual_input: VisualInput = "paper", **fit: Any) -> FieldMethod:
    """Return the preset `paper` with one of its two dampings, shared unless `fit` names the other."""
    settings = {"damping": "shared", **fit}
    return FieldMethod(name, replace(_PRESET, fit=replace(_PRESET.fit, **settings)), visual_input, published=True)


def _quick(name: str, visual_input: VisualInput = "visual", **fit: Any) -> FieldMethod:
    """Return the network with the quick settings but for those of `fit`."""
    return FieldMethod(name, replace(NETWORK, fit=replace(NETWORK.fit, **fit)), visual_input)


def _process(name: str, model: GainModel) -> FieldMethod:
    """Return a Gaussian process over all kernel families, or over one."""
    return FieldMethod(name, PipelineConfig(gain_model=model), "surface")


FIELDS = (
    _quick("field"),
    _process("field-auto", "auto"),
    _process("field-elastic", "elastic"),
    _process("field-smooth", "smooth"),
    _process("field-thin-plate", "thin-plate"),
    _quick("field-positions", "positions"),
    _quick("field-unaligned", "unaligned"),
    # All steps end to end take long enough without two trials of dampings beforehand. The noise is
    # trained, as measuring it needs the modes.
    replace(_quick("field-no-initialization", damping="shared", noise_rate=0.1), informed=False),
    _quick("field-no-residual", residual=False),
    # The warm-up moves no damping, so there is nothing to choose between.
    _quick("field-warmup", steps=0, damping="shared"),
    _paper("paper"),
    _paper("paper-positions", "paper-positions"),
    replace(_paper("paper-no-initialization"), informed=False),
    _paper("paper-unaligned", "paper-unaligned"),
    _paper("paper-no-residual", residual=False),
    _paper("paper-per-contact", damping="per-contact"),
    replace(_quick("field-grid"), grid=QUICK_GRID),
    replace(_paper("paper-grid"), grid=PAPER_GRID),
)
"""Configurations of the pipeline by name: the network with quick settings, other gains, ablations, the preset `paper`
and its ablations, and choices from grids."""

SIMULATIONS = (DiffSoundMethod("diffsound"), DiffSoundMethod("diffsound-weighted", weighted=True))
"""Other systems, built from their publications."""

METHODS: dict[str, Method] = {method.name: method for method in (*BASELINES, *SIMULATIONS, *FIELDS)}
"""All methods but those that take a path, in the order of tables."""


def method_named(name: str) -> Method:
    """Return the method of this name. Raises EvaluationError that lists the known ones."""
    if name in METHODS:
        return METHODS[name]
    expect_method(name)
    kind = kind_of(name)
    if kind == kind_of(PUBLISHED):
        folder = _given(name, PUBLISHED, "a folder", "with the published weights")
        return Baseline(f"{PUBLISHED}{folder}", partial(_published_sonicgauss, folder), folder_digest(folder))
    if kind == kind_of(SMALL):
        file = _given(name, SMALL, "a file", f"which this makes: {COMMAND}")
        digest = hashlib.sha256(file.read_bytes()).hexdigest()[:16]
        return Baseline(f"{SMALL}{file}", partial(_small_sonicgauss, file), digest)
    return RecordedMethod(_given(name, RECORDED, "a folder", "with a folder of wav files for every object"))


def _published_sonicgauss(folder: Path, task: Task) -> TunedRenderer:
    """Fine-tune the published architecture and weights, on CUDA where there is a GPU."""
    model = PublishedSonicGauss.load(folder)
    device = usable_device(task.device, raising=EvaluationError)
    return fit_published(model.to(device), task.gaussians(), task.train, seed=task.seed)


def _small_sonicgauss(file: Path, task: Task) -> TunedRenderer:
    """Fine-tune the small generator, trained from scratch on simulated objects."""
    return fit_small(SmallWeights.read(file), task.gaussians(), task.train, seed=task.seed)


def _given(name: str, prefix: str, kind: Literal["a folder", "a file"], use: str) -> Path:
    """Return the path in a method's name. Raises EvaluationError where nothing is there."""
    path = Path(name.removeprefix(prefix)).expanduser()
    if name in (prefix, prefix[:-1]) or not (path.is_dir() if kind == "a folder" else path.is_file()):
        raise EvaluationError(
            f"{name}: expected {kind} after `{prefix}`, {use}, found none",
            file=path if path.name else None,
            name="method",
            value=name,
        )
    return path
