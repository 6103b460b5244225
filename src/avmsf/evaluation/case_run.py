"""An evaluation, and its methods run in one case of an object; what all cases share is made once."""

import hashlib
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.caching import Given, Result, once, source_digest
from avmsf.capture.impacts import Impacts
from avmsf.datasets.dataset import Dataset
from avmsf.evaluation.field_methods import FieldMethod
from avmsf.evaluation.localization import located, write_map
from avmsf.evaluation.modal_metrics import truth_at, truth_from_first_sample, truth_of
from avmsf.evaluation.objects import ObjectInputs, draw_other_recording
from avmsf.evaluation.registry import METRICS, Protocol, table_modules
from avmsf.evaluation.results import ENCODER, CaseRecord, Outcome, ResultsFolder, failure_of, file_word
from avmsf.evaluation.scores import MetricSettings, Values
from avmsf.evaluation.splits import Case, align_split, evenly_spaced
from avmsf.evaluation.stored_sounds import RECORDED, listening_gain, write_sound
from avmsf.evaluation.task import Method, Renderer, Task, expect_renderer, report_of
from avmsf.modal.extraction.extract import extract_once
from avmsf.modal.extraction.finders import HighResolution, ModeFinder


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Data set, protocol, methods and settings of an evaluation."""

    dataset: Dataset
    title: str
    """Name of the dataset in reports; one folder of results has one."""
    protocol: Protocol
    methods: tuple[Method, ...]
    inputs: ObjectInputs
    seed: int = 0
    """Random seed of the methods."""
    metric_settings: MetricSettings = field(default_factory=MetricSettings)
    finder: ModeFinder = field(default_factory=HighResolution)
    """Extraction of modes, once per case."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the features, as plain values."""
    device: str | None = None
    """Device that methods train on, with the same result up to rounding; None for a GPU where there is one."""
    encoder: str | None = None
    """Encoder that `auto` in the settings stands for; None where the settings name it, or no method reads features."""
    time_zero: str | None = None
    """Start of the dataset's sounds, `onset` or `peak`, on which all methods are scored; None for the dataset's own."""
    own_starts: Dataset | None = None
    """The same dataset with its own starts, for fields that are not of the paper's configuration; None where all
    methods are fitted to the sounds that they are scored on."""

    def begin(self, results: ResultsFolder) -> None:
        """Take a folder for this evaluation's results.

        Raises EvaluationError where the folder holds other ones, and where a metric's package is not installed.
        """
        if not self.protocol.locating:
            self.metric_settings.prepare()
        identity = {
            "version": version("avmsf"),
            "source": [source_digest(module) for module in (__name__, *table_modules())],
            "protocol": self.protocol.name,
            "choosing": repr(self.protocol.choosing),
            "dataset": self.title,
            "seed": self.seed,
            "time_zero": self.time_zero,
            "metrics": _plain(self.metric_settings),
            "columns": list(METRICS),
            "modes": _plain(self.finder),
            "settings": dict(self.settings),
        }
        results.begin(identity, {method.name: self._described(method) for method in self.methods})

    def _described(self, method: Method) -> str:
        """Return what tells a method apart from another of its name. Methods that read no features share any folder."""
        read = self.encoder is not None and isinstance(method, FieldMethod) and method.visual_input != "surface"
        return f"{method!r}{ENCODER}{self.encoder}" if read else repr(method)


def _plain(settings: Any) -> dict[str, Any]:
    """Return the values of a dataclass, with the name of its class as `kind`."""
    return {"kind": type(settings).__name__, **asdict(settings)}


MAX_STORED_SOUNDS = 3
"""Test contacts of an experiment whose sounds are stored to be listened to."""


class _Recordings:
    """A case's recordings from one kind of start, aligned when first asked for, and their modes, stored in a file."""

    def __init__(self, impacts: Impacts, case: Case, finder: ModeFinder, path: Path) -> None:
        self.train, self.test = impacts.take(case.train), impacts.take(case.test)
        self.modes = once(lambda: extract_once(self.train, finder, path))

    def align(self) -> None:
        """Give all recordings the starts that the training ones have in common."""
        self.train, self.test = align_split(self.train, self.test, modes=self.modes)


class ObjectData:
    """What all cases of an object share, each made once; so is the error of what cannot be made."""

    def __init__(self, evaluation: Evaluation, identifier: str) -> None:
        """Read an object. Raises AvmsfError, OSError or ValueError where it is damaged."""
        dataset, inputs = evaluation.dataset, evaluation.inputs
        capture = dataset.capture(identifier)
        surface = capture.surface
        self.identifier = identifier
        self.impacts = capture.impacts
        """Recordings on which all methods are scored."""
        self.own_starts = None if evaluation.own_starts is None else evaluation.own_starts.capture(identifier).impacts
        """Where `impacts` start at their peaks, the same recordings with the dataset's own starts, for fields that are
        not of the paper's configuration: from its peak a recording's modes have phases of its own, which hide the
        signs of the gains, and which the truth of all does not have."""
        truth = None if evaluation.time_zero == "peak" else truth_of(dataset, identifier)
        digest = hashlib.sha256(self.impacts.digest().encode())
        for tensor in () if truth is None else (truth.frequency, truth.damping, truth.gains.real, truth.gains.imag):
            digest.update(tensor.contiguous().numpy().tobytes())
        self.digest = digest.hexdigest()
        """Of all that values depend on of the object's recordings and truth."""
        if truth is not None:
            truth = truth_from_first_sample(truth_at(truth, self.impacts.names), self.impacts)
        self.truth, self.facts = truth, dataset.facts(identifier)
        self.vertices = None if surface is None or not len(surface.faces) else surface.vertices
        self.features = once(partial(inputs.features, identifier))
        self.bodies = once(partial(inputs.bodies, identifier))
        self.family = once(partial(inputs.family, identifier))
        self.gaussians = once(partial(inputs.cloud, identifier))
        self.other_recording = once(
            partial(draw_other_recording, dataset, identifier, self.impacts, seed=evaluation.seed)
        )


class CaseRun:
    """Runs methods in one case, with modes that are found once and stored in a file."""

    def __init__(
        self, evaluation: Evaluation, data: ObjectData, case: Case, *, folder: Path, number: int, stores_sounds: bool
    ) -> None:
        """Prepare the `number`-th case of an object; with `stores_sounds`, some of its sounds go into `folder`."""
        self.evaluation, self.data, self.case, self.folder = evaluation, data, case, folder
        self.name = f"{data.identifier}/{number:02d}"
        path, finder = folder / "modes" / f"{self.name}.safetensors", evaluation.finder
        self.scored = self.own = _Recordings(data.impacts, case, finder, path)
        if data.own_starts is not None:
            own_path = path.with_name(f"{number:02d} own starts.safetensors")
            self.own = _Recordings(data.own_starts, case, finder, own_path)
        self.truth = None if data.truth is None else truth_at(data.truth, self.scored.test.names)
        self.features = partial(data.features, views=case.views)
        self.stored_rows = evenly_spaced(len(case.test), MAX_STORED_SOUNDS) if stores_sounds else []
        self.shared = 0.0

    def outcome(self, method: Method) -> Outcome:
        """Return what a method comes to; whatever it raises, but for an interruption, is its failure."""
        begun, shared = time.perf_counter(), self.shared
        recordings = self.own if isinstance(method, FieldMethod) and not method.published else self.scored
        try:
            self._shared(self.scored.align)()
            self._shared(recordings.align)()
            renderer = expect_renderer(method.fit(self._task(recordings)))
            fit_seconds = time.perf_counter() - begun - (self.shared - shared)
            begun = time.perf_counter()
            with torch.no_grad():
                sounds = renderer.render(recordings.test.contacts, directions=recordings.test.directions)
            render_seconds = time.perf_counter() - begun
            values, figures, maps = self._values(method, recordings, renderer, sounds)
        except Exception as error:  # A fault in one method must not cost the others their hours.
            return Outcome(self.case.key, method.name, failure=failure_of(error))
        return Outcome(
            self.case.key,
            method.name,
            values,
            figures,
            round(fit_seconds, 4),
            round(render_seconds, 4),
            self._write_sounds(method.name, sounds),
            report_of(renderer),
            maps,
        )

    def described(self, known: CaseRecord) -> CaseRecord:
        """Return the case's record with the recordings' files and with the time of modes and features so far."""
        sounds = known.sounds or self._write_sounds(RECORDED, self.scored.test.sounds)
        seconds, self.shared = known.shared_seconds + self.shared, 0.0
        return replace(known, sounds=sounds, shared_seconds=round(seconds, 4))

    def _values(
        self, method: Method, recordings: _Recordings, renderer: Renderer, sounds: Float[Tensor, "contacts samples"]
    ) -> tuple[Values, dict[str, float | None], dict[str, str]]:
        """Return the metrics, the figures, and the files of contacts' maps by the names of their recordings."""
        if not self.evaluation.protocol.locating:
            loudest = float(self.data.impacts.sounds.abs().max())
            settings = self.evaluation.metric_settings
            return *settings.values(renderer, sounds, self.scored.test, self.truth, loudest=loudest), {}
        points = self._shared(self.features)("surface").points
        published = isinstance(method, FieldMethod) and method.published
        errors, found = located(
            renderer,
            recordings.train,
            recordings.test,
            points,
            vertices=self.data.vertices,
            published=published,
            map_rows=self.stored_rows,
        )
        maps = {}
        for row, each in found.items():
            file = f"maps/{self.name}/{row:03d} {file_word(method.name)}.safetensors"
            write_map(self.folder / file, each, truth=recordings.test.contacts[row])
            maps[recordings.test.names[row]] = file
        return dict(errors), {}, maps

    def _task(self, recordings: _Recordings) -> Task:
        return Task(
            name=self.data.identifier,
            train=recordings.train,
            contacts=self.data.impacts.contacts,
            names=self.data.impacts.names,
            seed=self.evaluation.seed,
            modes=self._shared(recordings.modes),
            features=self._shared(self.features),
            bodies=self._shared(self.data.bodies),
            other_recording=self._shared(self.data.other_recording),
            family=self._shared(self.data.family),
            gaussians=self._shared(partial(self.data.gaussians, self.case.views)),
            material=self.data.facts.material,
            device=self.evaluation.device,
        )

    def _shared(self, make: Callable[Given, Result]) -> Callable[Given, Result]:
        """Return `make`, whose time counts to no method: whichever asks first would seem the slowest."""

        def made(*given: Given.args, **named: Given.kwargs) -> Result:
            begun = time.perf_counter()
            try:
                return make(*given, **named)
            finally:
                self.shared += time.perf_counter() - begun

        return made

    def _write_sounds(self, name: str, sounds: Float[Tensor, "contacts samples"]) -> dict[str, str]:
        """Write the sounds to listen to, and return their files by the names of their recordings."""
        stored, test = {}, self.scored.test
        for row in self.stored_rows:
            file, gain = f"sounds/{self.name}/{row:03d} {file_word(name)}.flac", listening_gain(test.sounds[row])
            write_sound(self.folder / file, sounds[row], sample_rate=test.sample_rate, gain=gain)
            stored[test.names[row]] = file
        return stored
