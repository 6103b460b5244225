"""Loops compiled for the processor, wherever the package lies."""

import numba.core.caching
import pytest

from avmsf._utils.compiled import compiled


def twice(value: float) -> float:
    return 2 * value


def test_a_loop_is_compiled_and_kept():
    made = compiled()(twice)
    assert made(1.5) == 3.0
    assert made.stats.cache_path is not None


def test_where_nothing_can_be_kept_it_is_compiled_all_the_same(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(numba.core.caching.CompileResultCacheImpl, "_locator_classes", [])
    made = compiled(error_model="numpy")(twice)
    assert made(1.5) == 3.0
    assert made.stats.cache_path is None
