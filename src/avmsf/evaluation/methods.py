"""All methods by name; a method fits a renderer to an object's training recordings."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from avmsf.baselines.diffsound.renderer import DiffSound
from avmsf.baselines.sonicgauss.small import COMMAND
from avmsf.baselines.sonicgauss.tuning import TunedRenderer
from avmsf.errors import EvaluationError
from avmsf.evaluation.diffsound_method import DiffSoundMethod
from avmsf.evaluation.field_methods import NETWORK, FieldMethod, UninformedField
from avmsf.evaluation.grid_field import PAPER_GRID, QUICK_GRID, GridField
from avmsf.evaluation.interpolation import SplineGains
from avmsf.evaluation.names import PUBLISHED, RECORDED, SMALL, expect_method
from avmsf.evaluation.recorded import Recorded
from avmsf.evaluation.renderer import Renderer
from avmsf.evaluation.simple_methods import MeanGains, MeanWaveform, NearestRecording, RandomImpact, WhiteNoise
from avmsf.evaluation.sonicgauss_method import SmallSonicGaussMethod, SonicGaussMethod
from avmsf.evaluation.task import Look, Method, Task
from avmsf.field.config import GainModel
from avmsf.field.sound_field import SoundField
from avmsf.pipeline.config import PRESETS, PipelineConfig

NEIGHBORS = 3
"""Number of nearest recordings that are averaged (the paper's KNN), or all where there are fewer."""


@dataclass(frozen=True)
class Baseline:
    """A method without training."""

    name: str
    """Name in tables."""
    make: Callable[[Task], Renderer] = field(repr=False)
    """Makes the renderer from the task's training recordings."""

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


def _white_noise(task: Task) -> WhiteNoise:
    return WhiteNoise(task.train, seed=task.seed)


def _random_impact(task: Task) -> RandomImpact:
    return RandomImpact(task.stranger(), task.train.sample_rate)


def _nearest(task: Task) -> NearestRecording:
    return NearestRecording(task.train)


def _mean_waveform(task: Task) -> MeanWaveform:
    return MeanWaveform(task.train, count=_count(task))


def _directed_mean_waveform(task: Task) -> MeanWaveform:
    return MeanWaveform(task.train, count=_count(task), by_direction=True)


def _mean_gains(task: Task) -> MeanGains:
    return MeanGains(task.train, task.modes(), count=_count(task), noise=True, seed=task.seed)


def _spline_gains(task: Task) -> SplineGains:
    return SplineGains(task.train, task.modes(), noise=True, seed=task.seed)


BASELINES = (
    Baseline("white-noise", _white_noise),
    Baseline("random-impact", _random_impact),
    Baseline("nearest", _nearest),
    Baseline("knn3", _mean_waveform),
    Baseline("knn3-directions", _directed_mean_waveform),
    Baseline("knn-gains", _mean_gains),
    Baseline("spline-gains", _spline_gains),
)
"""The paper's baselines that need nothing but data, then the strong ones that it leaves out. Those that share modes
have noise beside them, as the field has: without it all is silent between modes, and L1-log is lost."""

_PRESET = PRESETS["paper"]


def _paper(name: str, look: Look = "paper", **fit: Any) -> FieldMethod:
    """Return the preset `paper` with one of its two dampings, shared unless `fit` names the other."""
    settings = {"damping": "shared", **fit}
    return FieldMethod(name, replace(_PRESET, fit=replace(_PRESET.fit, **settings)), look, published=True)


def _quick(name: str, look: Look = "visual", **fit: Any) -> FieldMethod:
    """Return the network with the quick settings but for those of `fit`."""
    return FieldMethod(name, replace(NETWORK, fit=replace(NETWORK.fit, **fit)), look)


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
    UninformedField(_quick("field-no-initialization", damping="shared", noise_rate=0.1)),
    _quick("field-no-residual", residual=False),
    # The warm-up moves no damping, so there is nothing to choose between.
    _quick("field-warmup", steps=0, damping="shared"),
    _paper("paper"),
    _paper("paper-positions", "paper-positions"),
    UninformedField(_paper("paper-no-initialization")),
    _paper("paper-unaligned", "paper-unaligned"),
    _paper("paper-no-residual", residual=False),
    _paper("paper-per-contact", damping="per-contact"),
    GridField(_quick("field-grid"), QUICK_GRID),
    GridField(_paper("paper-grid"), PAPER_GRID),
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
    if name.partition(":")[0] == PUBLISHED[:-1]:
        return SonicGaussMethod(_given(name, PUBLISHED, "a folder", "with the published weights"))
    if name.partition(":")[0] == SMALL[:-1]:
        return SmallSonicGaussMethod(_given(name, SMALL, "a file", f"which this makes: {COMMAND}"))
    return RecordedMethod(_given(name, RECORDED, "a folder", "with a folder of wav files for every object"))


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


def report_of(renderer: Renderer) -> dict[str, Any]:
    """Return what a method chose on its way to a renderer, as plain values; empty where it had no choice."""
    if isinstance(renderer, SoundField):
        return renderer.origin.report
    if isinstance(renderer, TunedRenderer):
        return dict(renderer.report)
    if isinstance(renderer, SplineGains | DiffSound):
        return renderer.report
    if isinstance(renderer, MeanGains | MeanWaveform):
        return {"neighbors": renderer.count}
    return {}
