"""Files with random damage are read, or refused by the package's own error: never a traceback."""

from pathlib import Path

import pytest

from avmsf.errors import EvaluationError
from avmsf.evaluation.results import IDENTITY, ResultsFolder
from avmsf.pipeline.stages import Stage, StageFolder
from factories import damaged_files as files
from factories.valid_files import write_seeds

NESTED = "[" * 100_000
"""Far deeper than any reader's own."""


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("robustness") / "seeds"
    write_seeds(folder)
    return folder


@pytest.mark.parametrize("family", files.FAMILIES)
def test_damage_is_refused_or_harmless(tmp_path: Path, seeds: Path, family: str) -> None:
    inputs = files.damaged_inputs(seeds, tmp_path / "input", count=4, seed=1, families=(family,))
    results = {name: files.outcome_of(read) for _, name, read in inputs}
    assert len(results) == 4
    assert not {name: said for name, (result, said) in results.items() if result not in ("read", "refused")}


def test_nested_results_are_refused(tmp_path: Path) -> None:
    (tmp_path / IDENTITY).write_text(NESTED)
    with pytest.raises(EvaluationError):
        ResultsFolder(tmp_path).identity()


def test_a_stage_whose_record_is_nested_runs_again(tmp_path: Path) -> None:
    made: list[Path] = []

    def make(path: Path) -> None:
        made.append(path)
        path.write_text("made")

    for _ in range(2):
        StageFolder(tmp_path).keep(Stage("stage", make))
        (record,) = tmp_path.glob("*.json")
        record.write_text(NESTED)
    assert len(made) == 2
