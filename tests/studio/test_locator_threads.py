"""One locator, used by several threads at once: no error, and nothing computed twice."""

import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from avmsf.localization import locator as module
from avmsf.localization.locator import Locator, _Length
from opened_plate import plate_field

THREADS = 8
LENGTHS = (400, 480, 560, 640)


def test_threads_share_what_is_cached(monkeypatch: pytest.MonkeyPatch) -> None:
    locator = Locator.of(plate_field("elastic"))
    made: Counter[Any] = Counter()
    together = threading.Barrier(THREADS)
    of, calibrate = _Length.of, module.calibrate_tempering

    def slow_length(locator: Locator, samples: int, highest: float) -> _Length:
        made[samples] += 1
        time.sleep(0.02)  # lets the other threads come to the same place
        return of(locator, samples, highest)

    def slow_heed(field: Any) -> float:
        made["heed"] += 1
        time.sleep(0.02)
        return calibrate(field)

    monkeypatch.setattr(module._Length, "of", staticmethod(slow_length))
    monkeypatch.setattr(module, "calibrate_tempering", slow_heed)

    def prepare(_: int) -> None:
        together.wait(20)
        locator.prepare(*LENGTHS)

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(prepare, range(THREADS)))
    assert made == {**dict.fromkeys(LENGTHS, 1), "heed": 1}
    assert sorted(samples for samples, _ in locator.lengths) == sorted(LENGTHS)
