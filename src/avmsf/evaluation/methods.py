"""All methods: each fits a renderer to an object's training recordings, or reads its sounds from files.

A sound field is a method as a configuration of the whole pipeline with a name; its ablations and a choice from a grid
are others. Methods that share modes have noise too, as the field has: without it all is silent between modes, and
L1-log is lost.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.device import usable_device
from avmsf.baselines.diffsound.material_fit import DiffSoundConfig
from avmsf.baselines.diffsound.renderer import DiffSound, fit_diffsound
from avmsf.baselines.sonicgauss.published import PublishedSonicGauss, fit_published
from avmsf.baselines.sonicgauss.training import TunedRenderer
from avmsf.capture.audio import read_recording
from avmsf.capture.filenames import files_in
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError, FitError
from avmsf.evaluation.metrics import envelope_distance
from avmsf.evaluation.registry import VisualInput, kind_of, method_entry, resolve
from avmsf.evaluation.simple_methods import MeanGains
from avmsf.evaluation.task import Contacts, Method, Renderer, Sounds, Task
from avmsf.features.feature_field import FeatureField
from avmsf.fem.material import MATERIALS
from avmsf.field.config import FitConfig, GainModelName
from avmsf.field.gains.attention import held_out
from avmsf.field.gains.estimator import estimator_for
from avmsf.field.sound_field import SUPPORTING, SoundField
from avmsf.modal.extraction.extract import FINDERS, Extraction, extract_sounds
from avmsf.modal.extraction.finders import lowest_frequency
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from avmsf.pipeline.config import PRESETS, PipelineConfig
from avmsf.pipeline.fit import fit_gains
from avmsf.pipeline.stages import digest_files, digest_of

_SAME_POSITION_M = 1e-6
"""Distance of one contact from itself after float32, far below that of any two."""
NETWORK = PipelineConfig(gain_model="network")
"""The attention network with the quick settings of the fit."""
_UNINFORMED_RATE = 0.03
"""Adam's step for frequencies (in widths of their modes) and for the logarithms of dampings without extracted modes:
frequencies, dampings and noise have to find where they belong."""
_MAX_FREQUENCY_RATIO = 0.9
"""Highest random frequency over half the sample rate."""
_MIN_QUALITY = 10.0
"""Quality factor, pi f / d, of the fastest random decay."""
_NOISE_RATIO = 0.01
"""Noise beside random modes over the sounds' root mean square: 40 dB down."""


@dataclass(frozen=True)
class FunctionMethod:
    """A method that is a function of the task."""

    name: str
    """Name in tables."""
    fit: Callable[[Task], Renderer] = field(repr=False)
    """Makes the renderer from the task's training recordings. Raises AvmsfError where it cannot."""
    weights: str = ""
    """Digest of the weights that it starts from: results of other weights are not mixed."""
    visual_input: VisualInput = field(default_factory=VisualInput)
    """What is read of the object's points, by the field that it asks for."""


def method_named(name: str) -> Method:
    """Return the method of this name. Raises EvaluationError that lists the known ones, and for a missing path."""
    entry, settings, weights = method_entry(name), dict[str, Any](), ""
    if entry.path:
        given = name.partition(":")[2]
        path = Path(given).expanduser()
        if not given or not (path.is_dir() if entry.is_folder else path.is_file()):
            wanted = f"{entry.path} after `{kind_of(name)}:`"
            raise EvaluationError.expected(wanted, name, file=path if given else None, name="method")
        # However it is written: results of one path are those of one method.
        name, settings = f"{kind_of(name)}:{path}", {"path": path}
    if entry.make:
        made: Method = resolve(entry.make)(name, **entry.settings, **settings)
        return made
    if entry.path:
        weights = digest_of(path)[:16]
    # Of a class method ray would send the code, not the name.
    fit = partial(_fit_with, entry.fit, **entry.settings, **settings)
    return FunctionMethod(name, fit, weights, entry.visual_input)


def _fit_with(function: str | Callable[..., Any], /, task: Task, **settings: Any) -> Renderer:
    made: Renderer = resolve(function)(task, **settings)
    return made


def mean_trained_gains(task: Task) -> MeanGains:
    """Return the trained field of `paper` with the mean of its own gains at the nearest training contacts."""
    field = task.field("paper")
    gains = 1j * field.complex_gains(task.train.contacts)
    trained = Extraction(field.bank, gains.to(torch.complex64), field.residual)
    # The network knows no directions: its gains are of one sign wherever a hammer came from.
    return MeanGains(replace(task.train, directions=None), trained, noise=True, seed=task.seed)


def diffsound(
    task: Task, *, weighted: bool = False, learned_residual: bool = False, config: DiffSoundConfig | None = None
) -> DiffSound:
    """Fit the material of a simulation, from the dataset's material where it is in the table.

    With `weighted` each mode has a weight of its own, fitted to the training recordings. With `learned_residual` its
    noise is that which the field `paper` has learned, as in the paper, where otherwise it is measured. Raises
    AvmsfError where the object has no body, or its recordings no modes.
    """
    config = config or DiffSoundConfig()
    if task.material in MATERIALS:
        config = replace(config, material=task.material)
    found = fit_diffsound(task.train, task.family(), task.modes(), config, weighted=weighted)
    return replace(found, noise=task.field("paper").noise()) if learned_residual else found


def sonicgauss(task: Task, *, path: Path) -> TunedRenderer:
    """Fine-tune the published architecture and weights in a folder, on CUDA where there is a GPU."""
    model = PublishedSonicGauss.load(path).to(usable_device(task.device, raising=EvaluationError))
    return fit_published(model, task.gaussians(), task.train, seed=task.seed)


@dataclass(frozen=True)
class RecordedMethod:
    """Another system, by its wav files: FOLDER/OBJECT/RECORDING.wav, as `Recorded` reads them."""

    name: str
    """`recorded:` and the folder."""
    path: Path
    """Holds a folder of sounds for every object."""

    def digest(self, name: str) -> str:
        """Return a digest of an object's wavs, which decide its figures."""
        folder = self.path / name
        return digest_files([each for each in files_in(folder) if each.suffix.lower() == ".wav"], root=folder)

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

        Raises EvaluationError for a contact without a recording, for a missing file, and for one that has several
        different channels or another rate or length; CaptureError for one that is no sound.
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
        recording = read_recording(path)
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


Grid = Mapping[str, Sequence[Any]]
"""Values of the settings that a choice is made of; names with blanks between them share one."""
_DAMPINGS = ("shared", "per-contact")
PAPER_GRID: Grid = {
    "clusters": (128, 256, 512),
    "learning_rate warmup_rate correction_rate noise_rate": (1e-2, 5e-3, 1e-3),
    "steps": (5000, 10000, 20000),
    "early_weight": (0.5, 1.0, 2.0),
    "damping": _DAMPINGS,
}
"""The paper's lists (supplement, training setup), with one rate of Adam for all parameters: 162 fits an object, to run
where there is time for them. On a whole object's recordings a step is an epoch."""
QUICK_GRID: Grid = {"clusters": (8, 16, 32), "learning_rate": (3e-3, 1e-3), "damping": _DAMPINGS}
"""What of it matters at the quick recipe's sizes: 12 fits an object."""


def candidates(grid: Grid, base: FitConfig) -> list[FitConfig]:
    """Return `base` with every combination of a grid's values, the last setting changing fastest."""
    chosen = (zip(grid, values, strict=True) for values in itertools.product(*grid.values()))
    return [replace(base, **{name: value for names, value in each for name in names.split()}) for each in chosen]


@dataclass(frozen=True)
class FieldMethod:
    """A field fitted as a configuration of the pipeline says, with the evaluation's seed and device.

    Unless `informed` it has no modal initialization (the paper's row "w/o init"): it starts from `random_modes`, as
    many as the extraction has, and is trained end to end for as many steps as the configuration takes in all.

    With a `grid`, its settings are chosen on the quarter of the training positions that farthest-point sampling takes
    last: every candidate is fitted to the others and scored there by ENV (paper, supplement), and the best, of equals
    the first, is fitted to all training contacts. With fewer than six positions the configuration's own settings are
    taken. Modes are those of all training contacts.
    """

    name: str
    """What tables call it."""
    pipeline: PipelineConfig = NETWORK
    """Settings of all stages."""
    visual_input: VisualInput = field(default_factory=partial(VisualInput, "visual"))
    """What is read of the object's points."""
    published: bool = False
    """Whether modes are found as `pipeline` says, in place of those that all methods share, and recordings are located
    by the cosine distance of gains as it is published."""
    informed: bool = True
    """Whether it starts from extracted modes."""
    grid: Grid | None = None
    """Settings to choose from."""

    def fit(self, task: Task) -> SoundField:
        """Fit the field, whose report has what was chosen. Raises AvmsfError where a stage cannot be made."""
        features, config, report = task.features(self.visual_input), self.pipeline.fit, dict[str, Any]()
        if self.published:
            finder = FINDERS[self.pipeline.extraction](modes=self.pipeline.modes)
            modes = extract_sounds(task.train.sounds, sample_rate=task.train.sample_rate, method=finder)
        else:
            modes = task.modes()
        if self.grid is not None:
            config, report["grid"] = self._choose(self.grid, task, features, modes)
        if not self.informed:
            count, bins = len(modes.bank), len(modes.residual.magnitude)
            generator = torch.Generator().manual_seed(task.seed)
            modes = random_modes(task.train, modes=count, bins=bins, generator=generator)
            # Poles that were drawn say nothing of which of the trained ones are modes.
            report[SUPPORTING] = []
            steps = config.warmup_steps + config.steps
            config = replace(config, warmup_steps=0, steps=steps, correction_rate=_UNINFORMED_RATE)
        found = self._fitted(task, task.train, features, modes, config)
        return replace(found, origin=replace(found.origin, report={**found.origin.report, **report}))

    def _fitted(
        self, task: Task, train: Impacts, features: FeatureField, modes: Extraction, config: FitConfig
    ) -> SoundField:
        """Fit the field to some of a task's recordings, in whose modes they are rows."""
        # An object of few points has no more regions than points.
        clusters = min(config.clusters, len(torch.unique(features.points, dim=0)))
        gains = estimator_for(self.pipeline.gain_model, task.bodies, task.symmetries)
        fitted = replace(config, clusters=clusters, seed=task.seed)
        pipeline = replace(self.pipeline, fit=fitted, device=task.device)
        return fit_gains(train, features, modes, pipeline, gains, name=task.name, settings=task.settings)

    def _choose(
        self, grid: Grid, task: Task, features: FeatureField, modes: Extraction
    ) -> tuple[FitConfig, dict[str, Any]]:
        """Return the best settings of a grid, and the report of the choice."""
        base, train = self.pipeline.fit, task.train
        rows = held_out(train.contacts, base.validation)
        if not rows:
            return base, {"validated": False}
        learnt, held = [row for row in range(len(train)) if row not in rows], train.take(rows)
        configs, errors = candidates(grid, base), []
        for config in configs:
            trial = self._fitted(task, train.take(learnt), features, modes.take(learnt), config)
            sounds = trial.render(held.contacts, directions=held.directions)
            errors.append(float(envelope_distance(sounds, held.sounds, sample_rate=held.sample_rate).mean()))
        chosen = configs[min(range(len(configs)), key=errors.__getitem__)]
        return chosen, {
            "validated": True,
            "validation_contacts": list(held.names),
            "validation_envelope": errors,
            "chosen": {name: getattr(chosen, name) for names in grid for name in names.split()},
        }


def field_method(
    name: str,
    visual_input: VisualInput,
    *,
    model: GainModelName = "network",
    published: bool = False,
    informed: bool = True,
    grid: bool = False,
    **fit: Any,
) -> FieldMethod:
    """Return a field with the quick settings, or those of the preset `paper`, but for those of `fit`.

    `published` has one of the preset's two dampings, shared unless `fit` names the other.
    """
    base, choice = (PRESETS["paper"], PAPER_GRID) if published else (replace(NETWORK, gain_model=model), QUICK_GRID)
    settings = {"damping": "shared", **fit} if published else fit
    pipeline = replace(base, fit=replace(base.fit, **settings))
    return FieldMethod(name, pipeline, visual_input, published, informed, choice if grid else None)


def random_modes(train: Impacts, *, modes: int, bins: int, generator: torch.Generator) -> Extraction:
    """Return modes drawn at random in place of extracted ones, with flat noise of `bins` bands.

    Frequencies are spread evenly over their logarithm, from the lowest that the sounds' length allows (17 Hz in 3 s) to
    nine tenths of half the sample rate; dampings likewise, from a fall by one neper over the whole sound to a quality
    factor of 10. All gains are equal, and the modes have the energy of the mean sound, which with the rate and the
    length is all that is taken from `train`. Raises FitError for too short recordings.
    """
    rate, samples = train.sample_rate, train.sounds.shape[1]
    lowest, highest = lowest_frequency(samples, rate), _MAX_FREQUENCY_RATIO * rate / 2
    if lowest >= highest:
        got, advice = f"{samples} samples", "use more seconds after the onset"
        raise FitError.expected("longer recordings", samples, got=got, name="train", advice=advice)
    chance = torch.rand(2, modes, dtype=torch.float64, generator=generator)
    frequency = torch.sort(lowest * (highest / lowest) ** chance[0]).values
    slowest = rate / samples
    fastest = torch.clamp(math.pi * frequency / _MIN_QUALITY, min=slowest)
    damping = slowest * (fastest / slowest) ** chance[1]
    power = float(train.sounds.double().square().mean())
    # A mode of gain one has the energy 1 / (4 d) over time, and so the mean power 1 / (4 d) over the duration.
    gain = math.sqrt(power * train.duration / float((1 / (4 * damping)).sum()))
    gains = torch.full((len(train), modes), gain) + 0j
    residual = Residual(torch.full((bins,), _NOISE_RATIO * math.sqrt(power)))
    return Extraction(ModalBank(frequency, damping), gains, residual)
