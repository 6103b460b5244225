"""The worker's tasks, in this process: what they write, and what they tell meanwhile."""

import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from avmsf._utils.processes import write_lock
from avmsf.errors import FolderInUseError
from avmsf.field.store import load, save
from avmsf.pipeline.config import CACHE
from avmsf.studio.worker import EventWriter, lead, make_field
from factories.capture_folder import fill
from opened_plate import blow, plate_field


def run(task: Callable[..., Any], values: dict[str, Any], events: Path) -> Any:
    with events.open("w") as stream:
        return task(values, EventWriter(stream))


def events_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.mark.slow
def test_a_field_is_copied_before_another_process_may_replace_it(tmp_path: Path) -> None:
    folder, output, events = fill(tmp_path / "struck"), tmp_path / "made" / "field", tmp_path / "events"
    results: list[Any] = []
    task = {"folder": str(folder), "preset": "default", "modes": 6, "output": str(output)}
    making = threading.Thread(target=lambda: results.append(run(make_field, task, events)))
    making.start()
    copied_when_free: list[bool] = []
    while making.is_alive():
        try:
            with write_lock(folder / CACHE, "stages", command="avmsf fit", wait=0.0):
                made = (folder / CACHE / "field.safetensors").is_file()
                copied_when_free.append(output.is_file() or not made)
        except FolderInUseError:
            pass
        making.join(0.01)
    assert all(copied_when_free)
    assert results == [{"field": str(folder / CACHE / "field.safetensors"), "output": str(output)}]
    assert output.read_bytes() == Path(results[0]["field"]).read_bytes()
    assert 1 <= len(load(output).bank) <= 6
    assert events_of(events)[0] == {"stage": "capture", "done": 0, "total": 0, "words": "reading the recordings"}


def test_a_field_is_led_towards_a_recording_step_by_step(tmp_path: Path) -> None:
    save(plate_field(), tmp_path / "field")
    (tmp_path / "like.wav").write_bytes(blow())
    names = {name: str(tmp_path / name) for name in ("field", "output")}
    task = {**names, "recording": str(tmp_path / "like.wav"), "steps": 3}
    assert run(lead, task, tmp_path / "events") == {"output": names["output"]}
    assert not torch.equal(load(names["output"]).bank.frequency, plate_field().bank.frequency)
    steps = events_of(tmp_path / "events")
    assert [(step["stage"], step["total"]) for step in steps] == [("edit", 3)] * len(steps)
    assert all(step["loss"] is None or step["loss"] >= 0 for step in steps)
    assert steps[-1]["done"] == 3
