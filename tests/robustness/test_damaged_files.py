"""Files with random damage are read, or refused by the package's own error: never a traceback."""

from pathlib import Path

import pytest

from factories import damaged_files as files
from factories.valid_files import write_seeds


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("robustness") / "seeds"
    write_seeds(folder)
    return folder


@pytest.mark.parametrize("count", [2, pytest.param(5, marks=pytest.mark.slow)])
@pytest.mark.parametrize("family", files.FAMILIES)
def test_damage_is_refused_or_harmless(tmp_path: Path, seeds: Path, family: str, count: int) -> None:
    inputs = files.damaged_inputs(seeds, tmp_path / "input", count=count, seed=1, families=(family,))
    results = {name: files.outcome_of(read) for _, name, read in inputs}
    assert len(results) == count
    assert not {name: said for name, (result, said) in results.items() if result not in ("read", "refused")}
