"""Processes that a test started, looked up in /proc."""

import time
from collections.abc import Iterable
from pathlib import Path


def alive(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


def gone(processes: Iterable[int]) -> bool:
    """Wait until none of the processes runs, and return whether that came."""
    numbers, deadline = list(processes), time.monotonic() + 10.0
    while any(map(alive, numbers)) and time.monotonic() < deadline:
        time.sleep(0.05)
    return not any(map(alive, numbers))
