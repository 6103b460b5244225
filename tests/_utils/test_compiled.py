"""Loops compiled for the processor, wherever the package lies."""

from types import SimpleNamespace

import numba.core.caching
import pytest

from avmsf._utils.compiled import compiled


def twice(value: float) -> float:
    return 2 * value


def test_a_loop_is_compiled_and_kept():
    made = compiled()(twice)
    assert made(1.5) == 3.0
    assert made.stats.cache_path is not None


@pytest.mark.parametrize("full", [False, True])
def test_where_nothing_can_be_kept_it_is_compiled_all_the_same(monkeypatch: pytest.MonkeyPatch, full: bool):
    if full:
        monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=0))
    else:
        monkeypatch.setattr(numba.core.caching.CompileResultCacheImpl, "_locator_classes", [])
    made = compiled(error_model="numpy")(twice)
    assert made(1.5) == 3.0
    assert made.stats.cache_path is None
