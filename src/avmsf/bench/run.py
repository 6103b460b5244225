"""Running an evaluation: object by object, case by case, method by method, keeping each figure as it comes."""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

import numba
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.bench.caserun import CaseRun
from avmsf.bench.cases import Case, Places
from avmsf.bench.knowntruth import truth_at, truth_from_first_sample, truth_of
from avmsf.bench.otherobjects import draw_stranger
from avmsf.bench.plan import Evaluation
from avmsf.bench.results import CaseRecord, ObjectRecord, ResultsFolder, one_line
from avmsf.bench.task import Look
from avmsf.capture.impacts import Impacts
from avmsf.errors import AvmsfError, EvaluationError
from avmsf.fem.family import BodyFamily
from avmsf.field.gains.bodies import CandidateBodies
from avmsf.scene.features import FeatureField
from avmsf.simulate.truth import Truth


def run_object(
    evaluation: Evaluation, identifier: str, results: ResultsFolder, tell: Callable[[str], None] | None = None
) -> None:
    """Evaluate all methods on one object, but for those that have figures already; each is kept as it comes.

    One thread computes, whatever runs beside it. What keeps an object or a method from having figures is kept in their
    place. `tell` hears what begins. Raises EvaluationError where kept figures are of other recordings.
    """
    with one_thread():
        record = results.read(identifier) or ObjectRecord(identifier)
        try:
            impacts = evaluation.dataset.capture(identifier).impacts
            facts = evaluation.dataset.facts(identifier)
            truth = truth_of(evaluation.dataset, identifier)
            cases = evaluation.protocol.choosing.cases(impacts)
            digest = digest_of(impacts, truth)
            if truth is not None:
                truth = truth_from_first_sample(truth_at(truth, impacts.names), impacts)
        except AvmsfError as error:
            results.write(replace(record, failure=one_line(error)))
            return
        except (OSError, ValueError) as error:  # A damaged object must not cost the others their hours.
            results.write(replace(record, failure=f"{type(error).__name__}: {one_line(error)}"))
            return
        if record.digest != digest and all(each.failure is not None for each in record.outcomes):
            # Nothing is mixed where there are no figures yet.
            record = ObjectRecord(identifier)
        if record.digest not in ("", digest):
            raise EvaluationError(
                f"{results.path}: holds figures of other recordings of {identifier} than {evaluation.title} "
                "holds now; results are not mixed, choose another --output"
            )
        known = {case.key: case for case in record.cases}
        record = replace(
            record,
            name=facts.name,
            material=facts.material,
            inferred=facts.inferred,
            digest=digest,
            contacts=len(Places.of(impacts).rows),
            sample_rate=impacts.sample_rate,
            duration=impacts.duration,
            cases=tuple(known.get(case.key) or _named(case, impacts) for case in cases),
            failure=None,
        )
        results.write(record)
        looks = _Looks(evaluation, identifier)

        @cache
        def stranger() -> Float[Tensor, " samples"]:
            return draw_stranger(evaluation.dataset, identifier, impacts, seed=evaluation.seed)

        @cache
        def bodies() -> CandidateBodies | AvmsfError:
            try:
                return evaluation.bodies(identifier)
            except AvmsfError as error:
                return error

        @cache
        def family() -> BodyFamily | AvmsfError:
            if evaluation.families is None:
                return EvaluationError(f"{identifier}: its shape is not known: expected a mesh, or views of it")
            try:
                return evaluation.families(identifier)
            except AvmsfError as error:
                return error

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
                    look=looks.of(case.views),
                    bodies=bodies,
                    family=family,
                    material=facts.material,
                    stranger=stranger,
                    listened=firsts[case.label] == case.key,
                ),
                record,
                results,
                tell,
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
    run: CaseRun, record: ObjectRecord, results: ResultsFolder, tell: Callable[[str], None] | None
) -> ObjectRecord:
    """Run the methods that have no figures in a case, and return the object's record with them."""
    key = run.case.key
    for method in run.evaluation.methods:
        if record.done(key, method.name):
            continue
        if tell is not None:
            tell(f"{key}, {method.name}")
        outcome = run.outcome(method)
        cases = tuple(run.described(case) if case.key == key else case for case in record.cases)
        record = replace(record, cases=cases).adding(outcome)
        results.write(record)
    return record


class _Looks:
    """An object's features, each made once; so is the error of an object that nothing shows."""

    def __init__(self, evaluation: Evaluation, identifier: str) -> None:
        self.evaluation, self.identifier = evaluation, identifier
        self.made: dict[tuple[Look, int | None], FeatureField | AvmsfError] = {}

    def of(self, views: int | None) -> Callable[[Look], FeatureField]:
        """Return what makes features from at most so many views."""

        def make(look: Look) -> FeatureField:
            if (look, views) not in self.made:
                try:
                    self.made[look, views] = self.evaluation.features(self.identifier, look, views)
                except AvmsfError as error:
                    self.made[look, views] = error
            found = self.made[look, views]
            if isinstance(found, AvmsfError):
                raise found
            return found

        return make


def _named(case: Case, impacts: Impacts) -> CaseRecord:
    train, test = (tuple(impacts.names[row] for row in rows) for rows in (case.train, case.test))
    return CaseRecord(case.key, case.label, train, test)
