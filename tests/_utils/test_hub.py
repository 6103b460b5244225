"""Names of the hub are told from paths, a download that fails has a reason, and settings are JSON objects."""

import json
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from avmsf._utils.hub import is_hub_name, read_settings, why_not
from avmsf.errors import SceneError
from factories.raising import raises


class Gate(BaseHTTPRequestHandler):
    """Refuses everything, with the code that is the first part of the path."""

    def do_HEAD(self) -> None:
        self.send_error(int(self.path.split("/")[1]))

    def do_GET(self) -> None:
        self.do_HEAD()

    def log_message(self, *_: object) -> None:
        return


@pytest.mark.parametrize("code", [401, 404, 503, None])
def test_why_a_model_cannot_be_had_is_the_servers_code_or_that_there_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int | None
) -> None:
    client = pytest.importorskip("huggingface_hub")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    with HTTPServer(("127.0.0.1", 0), Gate) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        place = "http://127.0.0.1:9" if code is None else f"http://127.0.0.1:{server.server_port}/{code}"
        with pytest.raises(OSError) as caught:
            client.snapshot_download("owner/model", cache_dir=tmp_path, endpoint=place)
        server.shutdown()
    assert why_not(caught.value) == (
        "the server cannot be reached" if code is None else f"the server answered with code {code}"
    )


@pytest.mark.parametrize(
    ("content", "value", "cause"),
    [
        pytest.param(b"{", None, json.JSONDecodeError, id="cut short"),
        pytest.param(b"\xff", None, UnicodeDecodeError, id="no text"),
        pytest.param(b"[1]", "list", type(None), id="a list"),
        pytest.param(None, None, FileNotFoundError, id="missing"),
    ],
)
def test_settings_that_are_none_are_named(
    tmp_path: Path, content: bytes | None, value: str | None, cause: type[Exception]
) -> None:
    path = tmp_path / "config.json"
    if content is not None:
        path.write_bytes(content)
    with raises(SceneError, file=path, value=value) as caught:
        read_settings(path, raising=SceneError)
    assert type(caught.value.__cause__) is cause


def test_settings_are_read(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"model_type": "clap"}', encoding="utf-8")
    assert read_settings(tmp_path / "config.json", raising=SceneError) == {"model_type": "clap"}


def test_an_owner_and_a_model_are_a_name_and_a_path_is_none() -> None:
    assert is_hub_name("laion/clap-htsat-unfused")
    paths = ["./model", "../model", "~/model", "/model", "model/", "model", "a/b/c", "", "/", Path("owner/model")]
    assert not any(map(is_hub_name, paths))
