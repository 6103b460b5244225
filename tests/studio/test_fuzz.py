"""Requests that no page would send: none is answered by 500, none prints a traceback, and no answer is long."""

from pathlib import Path

import pytest

from avmsf.studio.opening import open_target
from benchmarks.robustness.studio import Request, fuzz, write_object
from served import served


@pytest.mark.parametrize("count", [14, pytest.param(150, marks=pytest.mark.slow)])
def test_no_request_breaks_the_studio(tmp_path: Path, capfd: pytest.CaptureFixture[str], count: int) -> None:
    path = write_object(tmp_path / "object")
    with served(open_target(path, capture=path.parent), tmp_path / "files") as running:

        def ask(request: Request) -> tuple[int, bytes]:
            answer = running.ask(request.method, request.path, request.body, headers=request.headers)
            return answer.status, answer.content

        found = fuzz(ask, count=count, seed=0)
        assert running.get("manifest.json").status == 200
    assert (found["server_errors"], found["unanswered"]) == (0, 0)
    assert found["longest_refusal_bytes"] < 1000
    assert "Traceback" not in capfd.readouterr().err
