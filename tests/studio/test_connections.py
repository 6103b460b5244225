"""Connections of whoever does not know the secret: half-open ones end, and many do not keep others out."""

import json
import os
import re
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from avmsf.studio import connections
from opened_plate import blow, open_plate
from served import Served, served

resource = pytest.importorskip("resource", reason="this system has no limit of file descriptors")
HALF = b"GET / HTTP/1.1\r\nHost: localhost\r\n"


@pytest.fixture
def hasty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    monkeypatch.setattr(connections, "IDLE_SECONDS", 0.5)
    monkeypatch.setattr(connections, "MAX_CONNECTIONS", 16)
    with served(open_plate(tmp_path / "opened"), tmp_path / "files") as running:
        yield running


def connected(port: int, content: bytes = HALF) -> socket.socket:
    made = socket.create_connection(("127.0.0.1", port), timeout=20)
    made.sendall(content)
    return made


def is_closed(each: socket.socket) -> bool:
    """Read to the end of a connection; the time-out of the socket raises where it has none."""
    try:
        while each.recv(1 << 16):
            pass
    except ConnectionResetError:
        pass
    return True


def test_a_request_that_is_never_completed_ends(hasty: Served) -> None:
    answered = f"GET /{hasty.token}/manifest.json HTTP/1.1\r\nHost: localhost:{hasty.port}\r\n\r\n".encode()
    refused = b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000\r\n\r\nnot yet all"
    for content in (b"", HALF, b"\r\n", answered + HALF, refused):
        with connected(hasty.port, content) as half:
            assert is_closed(half)


def test_a_request_that_trickles_in_ends(hasty: Served) -> None:
    with connected(hasty.port) as half:
        end = time.monotonic() + 20
        with pytest.raises(ConnectionError):  # noqa: PT012
            while time.monotonic() < end:
                half.sendall(b"X-A: b\r\n")
                time.sleep(0.1)


def test_a_request_that_is_being_sent_or_answered_may_take_longer(hasty: Served) -> None:
    content = blow()
    head = (
        f"POST /{hasty.token}/locate HTTP/1.1\r\nHost: localhost:{hasty.port}\r\nContent-Length: {len(content)}\r\n"
        "Connection: close\r\n\r\n"
    )
    with connected(hasty.port, head.encode() + content[:1000]) as slow:
        time.sleep(1.5)
        slow.sendall(content[1000:])
        assert slow.recv(1 << 16).startswith(b"HTTP/1.1 ")


def test_the_longest_idle_of_too_many_connections_end(hasty: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "IDLE_SECONDS", 600.0)
    with ExitStack() as stack:
        made = [stack.enter_context(connected(hasty.port)) for _ in range(60)]
        assert hasty.get("manifest.json").status == 200
        assert all(map(is_closed, made[: 60 - connections.MAX_CONNECTIONS]))
        made[-1].sendall(b"\r\n")
        assert made[-1].recv(1 << 16).startswith(b"HTTP/1.1 403")


@pytest.mark.slow
def test_at_the_limit_of_files_the_studio_answers_and_its_terminal_stays_quiet(tmp_path: Path) -> None:
    if resource.getrlimit(resource.RLIMIT_NOFILE)[0] < 600:
        pytest.skip("this test itself needs more open files")
    opened = open_plate(tmp_path / "opened")
    words = f"import resource, sys\nresource.setrlimit({resource.RLIMIT_NOFILE}, (128, 128))\n"
    words += "from avmsf.cli import main\nsys.exit(main())"
    command = [sys.executable, "-c", words, "studio", str(opened.field), "--no-browser", "--port", "0"]
    with (tmp_path / "said").open("w") as said:
        process = subprocess.Popen(command, stderr=said, env={**os.environ, "TMPDIR": str(tmp_path)})
    try:
        end = time.monotonic() + 60
        address = re.compile(r"http://127\.0\.0\.1:(\d+)/[\w-]{32}/")
        while (found := address.search(text := (tmp_path / "said").read_text())) is None:
            assert time.monotonic() < end
            assert process.poll() is None, text
            time.sleep(0.1)
        with ExitStack() as stack:
            for _ in range(400):
                stack.enter_context(connected(int(found[1])))
            with urllib.request.urlopen(f"{found[0]}manifest.json", timeout=20) as answer:
                assert json.load(answer)["modes"] == 5
        assert len((tmp_path / "said").read_text().splitlines()) <= 3
    finally:
        process.kill()
        process.wait()
