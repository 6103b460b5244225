"""Running an evaluation: all methods on one object after the other, or on several at a time by ray.

Each result is stored at once; what has results already is not computed again.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from types import ModuleType
from typing import Any

from avmsf._utils.device import one_thread
from avmsf.capture.impacts import Impacts
from avmsf.errors import AvmsfError, EvaluationError
from avmsf.evaluation.case_run import CaseRun, Evaluation, ObjectData
from avmsf.evaluation.recorded import RecordedMethod
from avmsf.evaluation.registry import METRICS, MetricEntry
from avmsf.evaluation.results import CaseRecord, ObjectRecord, ResultsFolder, failure_of
from avmsf.evaluation.splits import Case

Progress = Callable[[str, int, int], None]
"""Gets what has begun or ended, the number of finished objects, and of all."""


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

    `workers` is the number of parallel objects on this computer, `address` a ray cluster's or `auto`; its computers
    must see data and results under the same paths. With one worker and no address, ray is not needed. Each object is
    computed on one thread, so that values do not depend on the number of workers. Raises as `Evaluation.begin` and
    `run_object`, and EvaluationError where ray is needed and not installed.
    """
    if workers < 1:
        raise EvaluationError.expected("1 worker or more", workers, name="workers")
    if address is not None or workers > 1:
        ray = _ray()
        evaluation.begin(results)
        with _cluster(ray, workers, address):
            _run_remotely(ray, evaluation, identifiers, results, progress)
        return
    evaluation.begin(results)
    total = len(identifiers)
    for done, identifier in enumerate(identifiers):

        def log(message: str, done: int = done) -> None:
            progress(message, done, total)

        run_object(evaluation, identifier, results, log)
        progress(f"{identifier}: done", done + 1, total)


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
            cases = evaluation.protocol.choosing.cases(data.impacts)
        except (AvmsfError, OSError, ValueError) as error:  # A damaged object must not cost the others their hours.
            results.write(replace(record, failure=failure_of(error)))
            return
        record = _begun(record, data, cases, evaluation, results)
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
    record: ObjectRecord, data: ObjectData, cases: Sequence[Case], evaluation: Evaluation, results: ResultsFolder
) -> ObjectRecord:
    """Return an object's record with its cases and all else that is known; refuse values of other recordings."""
    if record.digest != data.digest and all(each.failure is not None for each in record.outcomes):
        record = ObjectRecord(record.identifier)
    if record.digest not in ("", data.digest):
        raise EvaluationError.expected(
            f"results of the recordings of {record.identifier} in {evaluation.title}",
            record.digest,
            got="those of others",
            file=results.path,
            name=record.identifier,
            advice="choose another --output",
        )
    known = {case.key: case for case in record.cases}
    return replace(
        record,
        digest=data.digest,
        name=data.facts.name,
        material=data.facts.material,
        sample_rate=data.impacts.sample_rate,
        cases=tuple(known.get(case.key) or _named(case, data.impacts) for case in cases),
        failure=None,
    )


def _named(case: Case, impacts: Impacts) -> CaseRecord:
    train, test = (tuple(impacts.names[row] for row in rows) for rows in (case.train, case.test))
    return CaseRecord(case.key, case.label, train, test)


def _run_remotely(
    ray: ModuleType,
    evaluation: Evaluation,
    identifiers: Sequence[str],
    results: ResultsFolder,
    progress: Progress,
) -> None:
    # max_retries: a worker that was killed for memory would be killed again.
    remote = ray.remote(num_cpus=1, max_retries=0)(_run_elsewhere)
    shared = ray.put((evaluation, results, METRICS))
    pending: dict[Any, str] = {remote.remote(shared, identifier): identifier for identifier in identifiers}
    progress(f"{len(pending)} objects on ray", 0, len(identifiers))
    try:
        while pending:
            # A time limit lets Ctrl-C through.
            ready, _ = ray.wait(list(pending), num_returns=1, timeout=1.0)
            for reference in ready:
                identifier = pending.pop(reference)
                try:
                    ray.get(reference)
                except ray.exceptions.RayError as error:
                    cause = getattr(error, "cause", None)
                    if isinstance(cause, Exception) and not isinstance(cause, ray.exceptions.RayError):
                        raise cause from None
                    raise EvaluationError.expected(
                        "a worker process that finishes",
                        got=f"one that ended early ({str(error).splitlines()[0]})",
                        name=identifier,
                        advice="run the command again, with fewer --workers if memory ran out",
                    ) from error
                progress(f"{identifier}: done", len(identifiers) - len(pending), len(identifiers))
    finally:
        for reference in pending:
            ray.cancel(reference, force=True)


def _run_elsewhere(shared: tuple[Evaluation, ResultsFolder, dict[str, MetricEntry]], identifier: str) -> None:
    evaluation, results, metrics = shared
    METRICS.update(metrics)
    run_object(evaluation, identifier, results)


@contextmanager
def _cluster(ray: ModuleType, workers: int, address: str | None) -> Iterator[None]:
    settings: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    if address is None:
        settings |= {"num_cpus": workers, "include_dashboard": False, "address": "local"}
    else:
        settings["address"] = address
    try:
        ray.init(**settings)
    except (ConnectionError, RuntimeError, ValueError) as error:
        wanted, advice = "a cluster to connect to", "check that it runs and has this address"
        if address is None:
            wanted, advice = "ray to start on this computer", "use --workers 1, which needs no ray"
        reason = " ".join(str(error).split())
        raise EvaluationError.expected(wanted, address, got=reason, name="ray", advice=advice) from error
    try:
        yield
    finally:
        ray.shutdown()


def _ray() -> ModuleType:
    # One computer needs no authentication, and no usage is reported.
    for name, value in {
        "RAY_AUTH_MODE": "disabled",
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    }.items():
        os.environ.setdefault(name, value)
    try:
        import ray
    except ImportError as error:
        raise EvaluationError.expected(
            "an installed package", name="ray", advice="pip install 'avmsf[scale]', or omit --workers and --ray"
        ) from error
    return ray
