"""A small plate to open, and the real server in a thread, asked over a socket: nothing tidies up what tests send."""

import asyncio
import http.client
import io
import json
import threading
import time
from collections.abc import Coroutine, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import soundfile

from avmsf.field.sound_field import SoundField
from avmsf.field.store import save
from avmsf.pipeline.config import Preset
from avmsf.studio.guard import MAX_UPLOAD_BYTES, Guard, new_token
from avmsf.studio.opening import Opened
from avmsf.studio.server import listen, make_app, make_server
from avmsf.studio.studio import Studio
from factories.capture_folder import ring
from factories.made_fields import FIELDS, sounding

RATE = 8000
T = TypeVar("T")


def plate_field(kind: str = "positional") -> SoundField:
    return sounding(FIELDS[kind](), noise=1e-6, samples=2400)


def open_plate(home: Path, kind: str = "positional") -> Opened:
    home.mkdir(parents=True, exist_ok=True)
    path = home / "plate.safetensors"
    save(plate_field(kind), path)
    return Opened("plate", home, field=path)


def wav(samples: np.ndarray, *, rate: int = RATE, subtype: str = "FLOAT", kind: str = "WAV") -> bytes:
    memory = io.BytesIO()
    soundfile.write(memory, samples, rate, subtype=subtype, format=kind)
    return memory.getvalue()


@cache
def blow(seed: int = 0, **options: float) -> bytes:
    """Return a wav file; the same object again, for its header holds the time at which it was written."""
    return wav(ring(before=0.1, seed=seed, **options))


def run_async(coroutine: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine to its end in a thread of its own: Playwright leaves a loop running in the main thread."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(asyncio.run, coroutine).result()


@dataclass(frozen=True)
class Answer:
    status: int
    headers: Mapping[str, str]
    content: bytes

    @property
    def words(self) -> Any:
        return json.loads(self.content)


@dataclass(frozen=True, eq=False)
class Served:
    studio: Studio
    port: int
    token: str

    def ask(
        self,
        method: str,
        place: str,
        body: bytes | Mapping[str, Any] | None = None,
        *,
        headers: Mapping[str, str] | None = None,
        whole: bool = False,
    ) -> Answer:
        """Send one request under the token, or with `whole` to the path as it is."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        path = place if whole else f"/{self.token}/{place}"
        content = json.dumps(body).encode() if isinstance(body, Mapping) else body
        try:
            connection.request(method, path, content, dict(headers or {}))
            answer = connection.getresponse()
            return Answer(answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read())
        finally:
            connection.close()

    def get(self, place: str) -> Answer:
        return self.ask("GET", place)

    def manifest(self) -> Any:
        return self.get("manifest.json").words

    def events(self, job: str) -> list[Any]:
        text = self.get(f"jobs/{job}/events").content.decode()
        return [json.loads(part.partition("data: ")[2]) for part in text.split("\n\n") if part]


@contextmanager
def served(
    opened: Opened, folder: Path, *, preset: Preset = "default", largest: int = MAX_UPLOAD_BYTES
) -> Iterator[Served]:
    folder.mkdir(exist_ok=True)
    studio = Studio(opened, folder, preset)
    token = new_token()
    with listen(0) as listener:
        port = listener.getsockname()[1]
        app = Guard(make_app(studio), token=token, port=port, largest=largest)
        server = make_server(app)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        try:
            wait_until(lambda: server.started or not thread.is_alive())
            yield Served(studio, port, token)
        finally:
            server.should_exit = True
            thread.join(20)
        assert not thread.is_alive()


def wait_until(done: Any) -> None:
    end = time.monotonic() + 20.0
    while not done():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)
