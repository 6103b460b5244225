"""How a process that does a server's work comes to know that the server is no more, however it ended."""

import os
import signal
import sys


def end_with_server() -> None:
    """Wait for the end of the standard input, which is the server's end, and end the whole group of processes."""
    while sys.stdin.buffer.read(1):
        pass
    os.killpg(os.getpgid(0), signal.SIGKILL)
