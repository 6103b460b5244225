"""Running an evaluation: all methods in all cases of one object after the other, or of several at a time.

Each result is stored at once; what has results already is not computed again.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.caching import Given, Result, content_digest, once
from avmsf._utils.device import one_thread
from avmsf._utils.parallel import run_tasks, workers_at
from avmsf._utils.processes import write_lock
from avmsf.capture import Capture
from avmsf.errors import AvmsfError, EvaluationError, WorkerError
from avmsf.evaluation.editing import EditTask, Generated, score_edit
from avmsf.evaluation.localization import located, write_map
from avmsf.evaluation.methods import FieldMethod, RecordedMethod, method_named
from avmsf.evaluation.modal_metrics import truth_at, truth_from_first_sample, truth_of
from avmsf.evaluation.objects import draw_other_recording
from avmsf.evaluation.plan import Evaluation
from avmsf.evaluation.registry import METRICS, MetricEntry, VisualInput
from avmsf.evaluation.results import (
    RECORDED,
    CaseRecord,
    ObjectRecord,
    Outcome,
    ResultsFolder,
    failure_of,
    file_word,
    listening_gain,
    write_flac,
)
from avmsf.evaluation.scores import Values, metric_values
from avmsf.evaluation.splits import Case, align_split, evenly_spaced
from avmsf.evaluation.task import Method, Renderer, Task, expect_renderer, report_of
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load
from avmsf.modal.extraction.extract import extract_once
from avmsf.modal.extraction.finders import ModeFinder
from avmsf.modal.spectra import resampled, with_length

MAX_STORED_SOUNDS = 3
"""Test contacts of an experiment whose sounds are stored to be listened to."""
Progress = Callable[[str, int, int], None]
"""Gets what has begun or ended, the number of finished objects, and of all."""


class ObjectData:
    """What all cases of an object share, each made once; so is the error of what cannot be made."""

    def __init__(self, evaluation: Evaluation, identifier: str) -> None:
        """Read an object. Raises AvmsfError, OSError or ValueError where it is damaged."""
        inputs, dataset = evaluation.inputs, evaluation.inputs.dataset
        capture = dataset.capture(identifier)
        surface = capture.surface
        self.identifier, self.facts = identifier, dataset.facts(identifier)
        self.impacts = capture.impacts
        """Recordings on which all methods are scored."""
        self.capture = capture
        self.own_starts = None if evaluation.own_starts is None else evaluation.own_starts.capture(identifier)
        """Where `impacts` start at their peaks, the same recordings with the dataset's own starts, for fields that are
        not of the paper's configuration: from its peak a recording's modes have phases of its own, which hide the
        signs of the gains, and which the truth of all does not have."""
        truth = None if capture.settings.from_peaks else truth_of(capture)
        known = () if truth is None else (truth.frequency, truth.damping, truth.gains)
        shape = () if surface is None else (surface.vertices, surface.faces)
        settings = replace(capture.settings, name=None)
        self.digest = content_digest(self.impacts.digest(), *known, *shape, settings)
        """Of all that values depend on of the object's recordings, truth, mesh and settings."""
        if truth is not None:
            truth = truth_from_first_sample(truth_at(truth, self.impacts.names), self.impacts)
        self.truth = truth
        self.vertices = None if surface is None or not len(surface.faces) else surface.vertices
        self.features = once(partial(inputs.features, identifier))
        self.bodies = once(partial(inputs.bodies, identifier))
        self.symmetries = once(partial(inputs.symmetries, identifier))
        self.family = once(partial(inputs.family, identifier))
        self.gaussians = once(partial(inputs.cloud, identifier))
        self.other_recording = once(partial(draw_other_recording, dataset, identifier, self.impacts, seed=inputs.seed))


class _Recordings:
    """A case's recordings from one kind of start, aligned when first asked for, and their modes, stored in a file."""

    def __init__(self, capture: Capture, case: Case, finder: ModeFinder, path: Path) -> None:
        self.settings = capture.settings
        self.train, self.test = capture.impacts.take(case.train), capture.impacts.take(case.test)
        self.modes = once(lambda: extract_once(self.train, finder, path))

    def align(self) -> None:
        """Give all recordings the starts that the training ones have in common."""
        self.train, self.test = align_split(self.train, self.test, modes=self.modes)


class CaseRun:
    """Runs methods in one case, with modes that are found once and stored in a file."""

    def __init__(
        self, evaluation: Evaluation, data: ObjectData, case: Case, *, folder: Path, number: int, stores_sounds: bool
    ) -> None:
        """Prepare the `number`-th case of an object; with `stores_sounds`, some of its sounds go into `folder`."""
        self.evaluation, self.data, self.case, self.folder = evaluation, data, case, folder
        self.name = f"{data.identifier}/{number:02d}"
        path, finder, edits = folder / "modes" / f"{self.name}.safetensors", evaluation.finder, evaluation.edits
        if edits is not None:
            path = edits.modes_file(data.identifier)
        self.scored = self.own = _Recordings(data.capture, case, finder, path)
        if data.own_starts is not None:
            own_path = path.with_name(f"{number:02d} own starts.safetensors")
            self.own = _Recordings(data.own_starts, case, finder, own_path)
        self.truth = None if data.truth is None else truth_at(data.truth, self.scored.test.names)
        self.stored_rows = evenly_spaced(len(case.test), MAX_STORED_SOUNDS) if stores_sounds else []
        self.shared = 0.0
        """Seconds of modes and features, which count to no method: whichever asks first would seem the slowest."""
        self.fields: dict[str, tuple[Renderer, float]] = {}
        """Fitted fields, which other methods may start from, and the seconds that each took."""

    def outcome(self, method: Method) -> Outcome:
        """Return what a method comes to; whatever it raises, but for an interruption, is its failure."""
        edits = self.evaluation.edits
        fitting = method if edits is None else edits.field_method
        published = isinstance(fitting, FieldMethod) and fitting.published
        recordings = self._recordings(fitting)
        try:
            task = self._aligned_task(recordings)
            if edits is not None:
                field = self._shared(self._stored_field)(edits.field_method, task)
                task = edits.task(task, self.case, field)
            renderer, fit_seconds = self._fitted(method, task)
            begun = time.perf_counter()
            with torch.no_grad():
                sounds = renderer.render(recordings.test.contacts, directions=recordings.test.directions)
            render_seconds = time.perf_counter() - begun
            if recordings is not self.scored:
                # From its peak on a short file holds less than from its onset on.
                sounds = with_length(sounds, self.scored.test.sounds.shape[1])
            maps, report = dict[str, str](), report_of(renderer)
            figures: Mapping[str, float | None] = {}
            if isinstance(task, EditTask) and isinstance(renderer, SoundField | Generated):
                values, figures, report = score_edit(renderer, sounds, recordings.test.contacts, task)
            elif self.evaluation.protocol.scoring == "contacts":
                values, maps = self._located(method.name, recordings, renderer, published)
            else:
                loudest = float(self.data.impacts.sounds.abs().max())
                settings, test = self.evaluation.metric_settings, self.scored.test
                values, figures = metric_values(settings, renderer, sounds, test, self.truth, loudest=loudest)
        except Exception as error:  # A fault in one method must not cost the others their hours.
            return Outcome(self.case.key, method.name, failure=failure_of(error))
        return Outcome(
            self.case.key,
            method.name,
            values,
            figures,
            round(fit_seconds, 4),
            round(render_seconds, 4),
            self._write_sounds(method.name, sounds, renderer.sample_rate),
            report,
            maps,
        )

    def _recordings(self, method: Method) -> "_Recordings":
        return self.own if isinstance(method, FieldMethod) and not method.published else self.scored

    def _fitted(self, method: Method, task: Task) -> tuple[Renderer, float]:
        """Return a method's renderer and the seconds of its fit, without those of what methods share."""
        if method.name in self.fields:
            return self.fields[method.name]
        begun, shared = time.perf_counter(), self.shared
        renderer = expect_renderer(method.fit(task))
        found = renderer, time.perf_counter() - begun - (self.shared - shared)
        if isinstance(method, FieldMethod):
            self.fields[method.name] = found
        return found

    def _field(self, name: str) -> SoundField:
        method = method_named(name)
        renderer, _ = self._fitted(method, self._aligned_task(self._recordings(method)))
        assert isinstance(renderer, SoundField)
        return renderer

    def described(self, known: CaseRecord) -> CaseRecord:
        """Return the case's record with the recordings' files and with the time of modes and features so far."""
        sounds = known.sounds or self._write_sounds(RECORDED, self.scored.test.sounds, self.scored.test.sample_rate)
        seconds, self.shared = known.shared_seconds + self.shared, 0.0
        return replace(known, sounds=sounds, shared_seconds=round(seconds, 4))

    def _stored_field(self, method: FieldMethod, task: Task) -> SoundField:
        """Return the field of an object's recordings, which is fitted once for all edits."""
        path = self.folder / "fields" / self.data.identifier / f"{self.data.digest[:16]}.safetensors"
        if not path.exists():
            method.fit(task).save(path)
        return load(path)

    def _located(
        self, name: str, recordings: _Recordings, renderer: Renderer, published: bool
    ) -> tuple[Values, dict[str, str]]:
        """Return the errors of located contacts, and the files of contacts' maps by the names of their recordings."""
        points = self._shared(self.data.features)(VisualInput(), self.case.views).points
        train, test, rows = recordings.train, recordings.test, self.stored_rows
        errors, found = located(
            renderer, train, test, points, vertices=self.data.vertices, published=published, map_rows=rows
        )
        maps = {}
        for row, each in found.items():
            file = f"maps/{self.name}/{row:03d} {file_word(name)}.safetensors"
            write_map(self.folder / file, each, truth=test.contacts[row])
            maps[test.names[row]] = file
        return dict(errors), maps

    def _aligned_task(self, recordings: _Recordings) -> Task:
        for each in (self.scored, recordings):
            self._shared(each.align)()
        data, views = self.data, self.case.views
        return Task(
            name=data.identifier,
            train=recordings.train,
            contacts=data.impacts.contacts,
            names=data.impacts.names,
            seed=self.evaluation.inputs.seed,
            modes=self._shared(recordings.modes),
            features=self._shared(lambda visual_input: data.features(visual_input, views)),
            bodies=self._shared(data.bodies),
            symmetries=self._shared(lambda: data.symmetries(views)),
            settings=recordings.settings,
            other_recording=self._shared(data.other_recording),
            family=self._shared(data.family),
            gaussians=self._shared(lambda: data.gaussians(views)),
            field=self._shared(self._field),
            material=data.facts.material,
            device=self.evaluation.inputs.device,
        )

    def _shared(self, make: Callable[Given, Result]) -> Callable[Given, Result]:
        """Return `make`, whose time is added to `shared`."""

        def made(*given: Given.args, **named: Given.kwargs) -> Result:
            begun, before = time.perf_counter(), self.shared
            try:
                return make(*given, **named)
            finally:  # without what shared steps within have added
                self.shared = before + time.perf_counter() - begun

        return made

    def _write_sounds(self, name: str, sounds: Float[Tensor, "contacts samples"], sample_rate: float) -> dict[str, str]:
        """Write the sounds to listen to, at the recordings' rate, and return their files by the recordings' names."""
        stored, test = {}, self.scored.test
        rows = resampled(sounds[self.stored_rows], sample_rate=sample_rate, wanted=test.sample_rate)
        for row, sound in zip(self.stored_rows, rows, strict=True):
            file, gain = f"sounds/{self.name}/{row:03d} {file_word(name)}.flac", listening_gain(test.sounds[row])
            write_flac(self.folder / file, sound, sample_rate=test.sample_rate, gain=gain)
            stored[test.names[row]] = file
        return stored


def run_object(
    evaluation: Evaluation, identifier: str, results: ResultsFolder, log: Callable[[str], None] = lambda message: None
) -> None:
    """Evaluate all methods on one object, on one thread, except those with stored results.

    Failures of an object or a method are stored as their results. `log` is called with a message for each method that
    begins. Raises EvaluationError where stored results are of other recordings.
    """
    with one_thread():
        record = results.read(identifier) or ObjectRecord(identifier)
        try:
            data = ObjectData(evaluation, identifier)
            cases = evaluation.protocol.split(data.impacts)
            if evaluation.edits is not None:
                cases = evaluation.edits.cases(identifier, *cases)
        except (AvmsfError, OSError, ValueError) as error:  # A damaged object must not cost the others their hours.
            results.write(replace(record, failure=failure_of(error)))
            return
        record = _begun(record, data, cases, evaluation.title, results)
        results.write(record)
        firsts = {case.label: case.key for case in reversed(cases)}
        for number, case in enumerate(cases, 1):
            stores_sounds = firsts[case.label] == case.key
            run = CaseRun(evaluation, data, case, folder=results.path, number=number, stores_sounds=stores_sounds)
            for method in evaluation.methods:
                digest = method.digest(identifier) if isinstance(method, RecordedMethod) else ""
                if record.done(case.key, method.name, digest):
                    continue
                log(f"{identifier}: {case.key}, {method.name}")
                outcome = replace(run.outcome(method), digest=digest)
                described = tuple(run.described(each) if each.key == case.key else each for each in record.cases)
                record = replace(record, cases=described).adding(outcome)
                results.write(record)


def _begun(
    record: ObjectRecord, data: ObjectData, cases: Sequence[Case], title: str, results: ResultsFolder
) -> ObjectRecord:
    """Return an object's record with its cases and all else that is known; refuse values of other recordings."""
    if record.digest != data.digest and all(each.failure is not None for each in record.outcomes):
        record = ObjectRecord(record.identifier)
    if record.digest not in ("", data.digest):
        wanted = f"results of the recordings, mesh and settings of {record.identifier} in {title}"
        advice = f"choose another --output, or delete objects/{record.identifier}.json to compute them again"
        raise EvaluationError.expected(
            wanted, record.digest, got="those of others", file=results.path, name=record.identifier, advice=advice
        )
    known, names = {case.key: case for case in record.cases}, data.impacts.names
    return replace(
        record,
        digest=data.digest,
        name=data.facts.name,
        material=data.facts.material,
        sample_rate=data.impacts.sample_rate,
        cases=tuple(known.get(case.key) or CaseRecord.of(case, names) for case in cases),
        failure=None,
    )


def run_objects(
    evaluation: Evaluation,
    identifiers: Sequence[str],
    results: ResultsFolder,
    *,
    workers: int = 1,
    address: str | None = None,
    progress: Progress = lambda message, done, total: None,
) -> None:
    """Evaluate all methods on the objects, except those with stored results.

    `workers` is the number of parallel objects on this computer, `address` a ray cluster's (see `workers_at`); its
    computers must see data and results under the same paths. With one worker and no address, all are evaluated in this
    process. Each object is computed on one thread, so that values do not depend on the number of workers. An object
    whose processes end early is a failure. Raises as `Evaluation.begin`, `run_object` and `workers_at`.
    """
    total, whole = len(identifiers), list[str]()

    def done(identifier: str, outcome: Exception | None) -> None:
        if isinstance(outcome, WorkerError):
            record = results.read(identifier) or ObjectRecord(identifier)
            results.write(replace(record, failure=failure_of(outcome)))
        elif outcome is not None:
            raise outcome
        whole.append(identifier)
        progress(f"{identifier}: done", len(whole), total)

    def log(message: str) -> None:
        progress(message, len(whole), total)

    # The lock's file is hidden: a new folder holds nothing else.
    lock = write_lock(results.path, ".results", command="avmsf evaluate", advice=", or choose another --output")
    with workers_at(workers, address, raising=EvaluationError) as parallel, lock:
        evaluation.begin(results)
        if workers > 1 or address is not None:
            act = partial(_run_elsewhere, (evaluation, results, METRICS))
            run_tasks(act, {each: each for each in identifiers}, parallel, done, log)
            return
        for identifier in identifiers:
            run_object(evaluation, identifier, results, log)
            done(identifier, None)


def _run_elsewhere(shared: tuple[Evaluation, ResultsFolder, dict[str, MetricEntry]], identifier: str) -> None:
    evaluation, results, metrics = shared
    METRICS.update(metrics)
    run_object(evaluation, identifier, results)
