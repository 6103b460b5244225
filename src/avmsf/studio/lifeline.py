"""Detection of the server's end by its worker process."""

import os
import signal
import sys


def end_with_server() -> None:
    """Wait for the end of the standard input, which is the server's end, and end the whole group of processes."""
    while sys.stdin.buffer.read(1):
        pass
    os.killpg(os.getpgid(0), signal.SIGKILL)
