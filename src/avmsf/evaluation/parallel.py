"""Running an evaluation object by object: one after the other, or side by side on ray."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from avmsf.errors import EvaluationError
from avmsf.evaluation.results import ResultsFolder
from avmsf.evaluation.runner import Evaluation, run_object


@dataclass(frozen=True)
class RunProgress:
    """Progress of an evaluation."""

    words: str
    """The stage that has begun or ended."""
    done: int
    """Number of finished objects."""
    total: int


def run_objects(
    evaluation: Evaluation,
    identifiers: Sequence[str],
    results: ResultsFolder,
    *,
    workers: int = 1,
    address: str | None = None,
    progress: Callable[[RunProgress], None] = lambda event: None,
) -> None:
    """Evaluate the objects, and keep each figure as it comes; what has figures already is not computed again.

    `workers` is the number of parallel objects on this computer, `address` a ray cluster's or `auto`; its computers
    must see data and results under the same paths. With one worker and no address, ray is not needed. Each object is
    computed on one thread, so that figures do not depend on the number of workers. Raises as `Evaluation.begin` and
    `run_object`, and EvaluationError where ray is needed and not installed.
    """
    if workers < 1:
        raise EvaluationError(f"expected 1 worker or more, got {workers}", name="workers", value=workers)
    if address is None and workers == 1:
        evaluation.begin(results)
        for done, identifier in enumerate(identifiers):

            def log(words: str, identifier: str = identifier, done: int = done) -> None:
                progress(RunProgress(f"{identifier}: {words}", done, len(identifiers)))

            run_object(evaluation, identifier, results, log)
            progress(RunProgress(f"{identifier}: done", done + 1, len(identifiers)))
        return
    ray = _ray()
    evaluation.begin(results)
    with _cluster(ray, workers, address):
        _run_remotely(ray, evaluation, identifiers, results, progress)


def _run_remotely(
    ray: ModuleType,
    evaluation: Evaluation,
    identifiers: Sequence[str],
    results: ResultsFolder,
    progress: Callable[[RunProgress], None],
) -> None:
    # max_retries: a worker that was killed for memory would be killed again.
    remote = ray.remote(num_cpus=1, max_retries=0)(_run_alone)
    shared = ray.put((evaluation, results))
    pending: dict[Any, str] = {remote.remote(shared, identifier): identifier for identifier in identifiers}
    progress(RunProgress(f"{len(pending)} objects on ray", 0, len(identifiers)))
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
                progress(RunProgress(f"{identifier}: done", len(identifiers) - len(pending), len(identifiers)))
    finally:
        for reference in pending:
            ray.cancel(reference, force=True)


def _run_alone(shared: tuple[Evaluation, ResultsFolder], identifier: str) -> None:
    evaluation, results = shared
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
