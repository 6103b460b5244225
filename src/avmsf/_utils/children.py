"""Processes that end with the one that started them, on every system: the pipe to their standard input closes."""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

_RUNNING: set["subprocess.Popen[bytes]"] = set()


def start_child(command: Sequence[str], **settings: Any) -> "subprocess.Popen[bytes]":
    """Start a process that `end_child` or `end_with_parent` ends; `settings` are those of Popen. Raises OSError."""
    process = subprocess.Popen(command, stdin=subprocess.PIPE, **settings)
    _RUNNING.add(process)
    return process


def end_child(process: "subprocess.Popen[bytes]") -> None:
    """Kill a process, where it runs."""
    with process:
        process.kill()
    _RUNNING.discard(process)


def end_with_parent() -> None:
    """Wait for the end of the standard input, which is the parent's; end this process and those that it started."""
    while sys.stdin.buffer.read(1):
        pass
    for process in _RUNNING.copy():
        process.kill()
    os._exit(1)


def ending_of(status: int) -> str:
    """Return what ended a process: the name of a signal, or the exit status."""
    if status >= 0:
        return f"exit status {status}"
    names = {each.value: each.name for each in signal.Signals}
    return names.get(-status, f"signal {-status}")
