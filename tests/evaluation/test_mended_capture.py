"""An object that could not be evaluated is evaluated once it is mended, in the same folder of results."""

from dataclasses import replace
from pathlib import Path

from avmsf.datasets import CaptureCollection
from avmsf.evaluation.methods import method_named
from avmsf.evaluation.parallel import run_objects
from avmsf.evaluation.protocols import PROTOCOLS
from avmsf.evaluation.results import ResultsFolder
from avmsf.evaluation.runner import Evaluation
from avmsf.evaluation.splits import MetricSettings
from avmsf.simulate.ground_truth import TRUTH, read_truth, write_truth
from factories.plate_set import PlateInputs, fill_plates


def test_a_truth_of_other_recordings_costs_neither_the_other_objects_nor_the_folder(tmp_path: Path) -> None:
    folder = fill_plates(tmp_path / "plates", ("a", "b"), count=6, truth=True)
    truth = read_truth(folder / "a")
    write_truth(replace(truth, names=tuple(f"x{name}" for name in truth.names)), folder / "a" / TRUTH)
    results = ResultsFolder(tmp_path / "results")
    methods = (method_named("nearest"),)

    def run() -> dict[str, int]:
        evaluation = Evaluation(
            CaptureCollection(folder),
            "plates",
            PROTOCOLS["farthest"],
            methods,
            PlateInputs(),
            metric_settings=MetricSettings(cdpam=False),
        )
        run_objects(evaluation, ("a", "b"), results)
        return {each.identifier: sum(one.failure is None for one in each.outcomes) for each in results.records()}

    first = run()
    assert first["a"] == 0
    assert first["b"] > 0
    (folder / "a" / TRUTH).unlink()
    assert run()["a"] == first["b"]
    assert results.read("a").failure is None
