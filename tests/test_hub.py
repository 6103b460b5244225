"""Names of the hub are told from paths, one question says whether it answers, and settings are JSON objects."""

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from types import ModuleType
from urllib.error import HTTPError, URLError

import pytest

from avmsf.errors import SceneError
from avmsf.hub import expect_answer, is_hub_name, read_settings
from raising import raises


@pytest.fixture
def constants(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return the settings of the hub's client, which may ask."""
    found: ModuleType = pytest.importorskip("huggingface_hub.constants")
    monkeypatch.setattr(found, "HF_HUB_OFFLINE", False)
    return found


@pytest.fixture(params=[401])
def asked(
    constants: ModuleType, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> Iterator[list[str]]:
    """Paths that a hub of our own is asked for; it refuses all, as the hub does gated models, or otherwise."""
    paths: list[str] = []

    class Gate(BaseHTTPRequestHandler):
        def do_HEAD(self) -> None:
            paths.append(self.path)
            self.send_error(request.param)

        def log_message(self, *_: object) -> None:
            return

    with HTTPServer(("127.0.0.1", 0), Gate) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        monkeypatch.setattr(constants, "ENDPOINT", f"http://127.0.0.1:{server.server_port}")
        yield paths
        server.shutdown()


@pytest.mark.parametrize("name", ["laion/clap-htsat-unfused", "stabilityai/stable-audio-open-1.0"])
def test_an_owner_and_a_model_are_a_name(name: str) -> None:
    assert is_hub_name(name)


@pytest.mark.parametrize("source", ["./model", "../model", "~/model", "/model", "model/", "model", "a/b/c", "", "/"])
def test_a_path_is_no_name(source: str) -> None:
    assert not is_hub_name(source)


def test_a_path_object_is_no_name() -> None:
    assert not is_hub_name(Path("owner/model"))


def test_a_refusal_is_an_answer(asked: list[str]) -> None:
    expect_answer("owner/model", "config.json")
    assert asked == ["/owner/model/resolve/main/config.json"]


@pytest.mark.parametrize("asked", [503], indirect=True)
def test_a_hub_that_fails_does_not_answer(asked: list[str]) -> None:
    with pytest.raises(HTTPError) as caught:
        expect_answer("owner/model", "config.json")
    assert caught.value.code == 503
    assert len(asked) == 1


def test_offline_nobody_is_asked(asked: list[str], constants: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    expect_answer("owner/model", "config.json")
    assert asked == []


def test_where_nobody_answers_it_is_told(constants: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(URLError) as caught:
        expect_answer("owner/model", "config.json")
    assert isinstance(caught.value.reason, ConnectionRefusedError)


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
