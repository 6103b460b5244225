"""Files with random damage are read, or refused by the package's own error: never a traceback."""

from pathlib import Path

import pytest
import torch

from avmsf.cli import check
from benchmarks.robustness import files
from benchmarks.robustness.seeds import write_seeds


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


def test_an_error_of_another_kind_is_a_traceback() -> None:
    def read() -> None:
        raise IndexError("index 99 is out of bounds")

    assert files.outcome_of(read) == ("traceback", "IndexError: index 99 is out of bounds")
    assert files.run_apart("family", "name", read).result == "traceback"


@pytest.mark.parametrize("error", [MemoryError(), RecursionError("too deep"), SystemExit(2)], ids=repr)
def test_a_verb_that_runs_out_of_memory_or_depth_refuses_nothing(
    error: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(options: check.Options) -> int:
        raise error

    monkeypatch.setattr(check, "run", fail)
    result, message = files.outcome_of(lambda: files.run_verb("check", "."))
    assert (result, message.split(":")[0]) == ("traceback", type(error).__name__)


def test_torch_is_bounded_too() -> None:
    def grow() -> None:
        torch.empty(2 * files.MAX_MEGABYTES << 20, dtype=torch.uint8)

    assert files.run_apart("family", "name", grow).result == "too large"


def test_memory_is_bounded_and_measured() -> None:
    def grow(megabytes: int) -> None:
        bytearray(megabytes << 20)

    assert files.run_apart("family", "name", lambda: grow(2 * files.MAX_MEGABYTES)).result == "too large"
    # A gap of 400 MB in the heap that the small input's memory fits into.
    fill = [bytes(100_000) for _ in range(4000)] + [keep := bytes(120_000)]
    del fill
    small = files.run_apart("family", "name", lambda: grow(200))
    assert keep
    assert (small.result, round(small.megabytes, -2)) == ("read", 200)


@pytest.mark.slow
def test_no_input_of_the_benchmark_is_a_fault() -> None:
    assert [each for each in files.run(count=6, seed=0) if each.result in files.FAULTS] == []
