"""Names of the hub are told from paths, and a download that fails has a reason."""

import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from avmsf._utils.files import model_folder
from avmsf.errors import SceneError, download_failure
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
    assert download_failure(caught.value) == (
        "the server cannot be reached" if code is None else f"the server answered with code {code}"
    )


def test_an_owner_and_a_model_are_a_name_and_a_path_is_none(tmp_path: Path) -> None:
    assert model_folder("laion/clap-htsat-unfused", "a model", raising=SceneError) is None
    assert model_folder(tmp_path, "a model", raising=SceneError) == tmp_path
    paths = ["./model", "../model", "~/model", "/model", "model/", "model", "a/b/c", Path("owner/model")]
    for path in paths:
        with raises(SceneError, file=Path(path).expanduser(), name="source", value=str(path)):
            model_folder(path, "a model", raising=SceneError)
