"""Running an evaluation: all methods in all cases of an object, each result stored at once."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import numba
import torch

from avmsf._utils.caching import once
from avmsf.capture.impacts import Impacts
from avmsf.datasets.dataset import ObjectFacts
from avmsf.errors import AvmsfError, EvaluationError
from avmsf.evaluation.case_run import CaseRun
from avmsf.evaluation.cases import Case, Places
from avmsf.evaluation.ground_truth import truth_at, truth_from_first_sample, truth_of
from avmsf.evaluation.other_objects import draw_stranger
from avmsf.evaluation.plan import Evaluation
from avmsf.evaluation.results import CaseRecord, ObjectRecord, ResultsFolder, failure_of
from avmsf.evaluation.task import FromFiles
from avmsf.simulate.ground_truth import Truth


def run_object(
    evaluation: Evaluation, identifier: str, results: ResultsFolder, log: Callable[[str], None] | None = None
) -> None:
    """Evaluate all methods on one object, except those with stored results; each result is stored at once.

    On one thread. Failures of an object or a method are stored as their results. `log` is called with a message for
    each method that begins. Raises EvaluationError where stored results are of other recordings.
    """
    with one_thread():
        record = results.read(identifier) or ObjectRecord(identifier)
        try:
            capture = evaluation.dataset.capture(identifier)
            impacts, surface = capture.impacts, capture.surface
            own = None if evaluation.own_starts is None else evaluation.own_starts.capture(identifier).impacts
            # From its peak, a recording's modes have phases of its own, which the truth of all does not have.
            truth = None if evaluation.time_zero == "peak" else truth_of(evaluation.dataset, identifier)
            digest = digest_of(impacts, truth)
            if truth is not None:
                truth = truth_from_first_sample(truth_at(truth, impacts.names), impacts)
            facts, cases = evaluation.dataset.facts(identifier), evaluation.protocol.choosing.cases(impacts)
        except (AvmsfError, OSError, ValueError) as error:  # A damaged object must not cost the others their hours.
            results.write(replace(record, failure=failure_of(error)))
            return
        record = _described(_of_same_recordings(record, digest, evaluation, results), impacts, facts, cases)
        results.write(record)
        # Each made once for all cases; so is the error of what cannot be made.
        features = once(evaluation.features)
        bodies = once(partial(evaluation.bodies, identifier))
        family = once(partial(evaluation.bodies.family, identifier))
        stranger = once(partial(draw_stranger, evaluation.dataset, identifier, impacts, seed=evaluation.seed))
        firsts = {case.label: case.key for case in reversed(cases)}
        for number, case in enumerate(cases, 1):
            record = _run_case(
                CaseRun(
                    evaluation,
                    identifier,
                    case,
                    impacts,
                    truth,
                    folder=results.path,
                    place=f"{identifier}/{number:02d}",
                    look=partial(features, identifier, views=case.views),
                    bodies=bodies,
                    family=family,
                    material=facts.material,
                    stranger=stranger,
                    vertices=None if surface is None or not len(surface.faces) else surface.vertices,
                    listened=firsts[case.label] == case.key,
                    own_starts=own,
                ),
                record,
                results,
                log,
            )


def _of_same_recordings(
    record: ObjectRecord, digest: str, evaluation: Evaluation, results: ResultsFolder
) -> ObjectRecord:
    """Return an object's record, empty where it has no values; raise EvaluationError for other recordings' values."""
    if record.digest != digest and all(each.failure is not None for each in record.outcomes):
        record = ObjectRecord(record.identifier)
    if record.digest not in ("", digest):
        raise EvaluationError(
            f"{results.path}: expected results of the recordings of {record.identifier} in {evaluation.title}, got "
            "those of others; choose another --output",
            file=results.path,
            name=record.identifier,
            value=record.digest,
        )
    return replace(record, digest=digest)


def _described(record: ObjectRecord, impacts: Impacts, facts: ObjectFacts, cases: Sequence[Case]) -> ObjectRecord:
    """Return an object's record with what is known of it now, and with its cases."""
    known = {case.key: case for case in record.cases}
    return replace(
        record,
        name=facts.name,
        material=facts.material,
        inferred=facts.inferred,
        contacts=len(Places.of(impacts).rows),
        sample_rate=impacts.sample_rate,
        duration=impacts.duration,
        cases=tuple(known.get(case.key) or _named(case, impacts) for case in cases),
        failure=None,
    )


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch and numba compute on one thread: sums in one order, and workers that do not stall each other."""
    threads, kernels = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        numba.set_num_threads(kernels)


def digest_of(impacts: Impacts, truth: Truth | None) -> str:
    """Return a digest of all that figures depend on of an object's recordings and truth."""
    digest = hashlib.sha256(impacts.digest().encode())
    for tensor in () if truth is None else (truth.frequency, truth.damping, truth.gains, truth.quadrature):
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


def _run_case(
    run: CaseRun, record: ObjectRecord, results: ResultsFolder, log: Callable[[str], None] | None
) -> ObjectRecord:
    """Run the methods that have no figures in a case, and return the object's record with them."""
    key = run.case.key
    for method in run.evaluation.methods:
        digest = method.digest(run.identifier) if isinstance(method, FromFiles) else ""
        if record.done(key, method.name, digest):
            continue
        if log is not None:
            log(f"{key}, {method.name}")
        outcome = replace(run.outcome(method), digest=digest)
        cases = tuple(run.described(case) if case.key == key else case for case in record.cases)
        record = replace(record, cases=cases).adding(outcome)
        results.write(record)
    return record


def _named(case: Case, impacts: Impacts) -> CaseRecord:
    train, test = (tuple(impacts.names[row] for row in rows) for rows in (case.train, case.test))
    return CaseRecord(case.key, case.label, train, test)
