"""The server as the page uses it: struck, located, edited, recorded, and ended."""

import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
import soundfile
import torch
import trimesh

from avmsf.editing.modal_edit import adjust_modes
from avmsf.errors import StudioError
from avmsf.field.store import save
from avmsf.studio.opening import open_target
from avmsf.studio.server import listen, serve
from factories.capture_folder import fill
from factories.plate_capture import fill_plate
from factories.raising import raises
from served import RATE, Served, blow, open_plate, plate_field, served, wait_until, wav


@pytest.fixture
def plate(tmp_path: Path) -> Iterator[Served]:
    with served(open_plate(tmp_path / "opened", "elastic"), tmp_path / "files") as running:
        yield running


@pytest.fixture
def capture(tmp_path: Path) -> Iterator[Served]:
    mesh = trimesh.creation.box((0.24, 0.17, 0.004)).subdivide().subdivide()
    mesh.export(tmp_path / "lid.obj")
    with served(open_target(tmp_path / "lid.obj"), tmp_path / "files") as running:
        yield running


def tensor(running: Served, manifest: Any, name: str) -> np.ndarray:
    told = manifest["tensors"][name]
    content = running.get(told["file"]).content[told["offset"] :]
    count = int(np.prod(told["shape"]))
    return np.frombuffer(content, np.dtype(told["dtype"]).newbyteorder("<"), count).reshape(told["shape"])


def test_a_blow_on_an_edited_object_is_located_in_the_pages_frame(plate: Served) -> None:
    points = torch.from_numpy(tensor(plate, plate.manifest(), "points").copy())
    plate.ask("POST", "edit", {"base": 1, "material": {"from": "ceramic"}, "size": 0.8})
    edited = plate.studio.session.current.require_field()
    sound = edited.render(0.8 * points[[33]].double())[0]
    [found] = plate.ask("POST", "locate", wav(np.concatenate([np.zeros(200), sound.numpy()]))).words["impacts"]
    assert found["row"] == 33
    assert found["position"] == pytest.approx(points[33].tolist(), abs=1e-7)


def test_a_descent_is_asked_for_alone(plate: Served) -> None:
    for query in ("", "?base=", "?base=-1", "?base=²", "?base=1e3", f"?base={'9' * 5000}"):
        assert plate.ask("POST", f"lead{quote(query, safe='?=')}", blow()).status == 400
    assert plate.ask("POST", "lead?base=7", blow()).status == 409
    assert list(plate.studio.folder.glob("lead-*")) == []


def test_a_guided_edit_that_another_tab_has_overtaken_is_taken_and_its_change_comes_back_by_undo(plate, tmp_path):
    script = "import json, shutil, sys; task = json.loads(input()); shutil.copy(sys.argv[1], task['output'])\n"
    wait = (
        "import os, time\nwhile not os.path.exists(sys.argv[2]): time.sleep(0.01)\nprint(json.dumps({'result': task}))"
    )
    led = adjust_modes(plate_field("elastic"), pitch=1.25)
    save(led, tmp_path / "led")
    plate.studio.jobs.command = (sys.executable, "-c", script + wait, str(tmp_path / "led"), str(tmp_path / "go"))
    job = plate.ask("POST", "lead?base=1", blow()).words["job"]
    assert plate.ask("POST", "lead?base=1", blow()).status == 409
    assert len(list(plate.studio.folder.glob("lead-*"))) == 1
    assert plate.ask("POST", "edit", {"base": 1, "pitch": 1.5}).words["revision"] == 2
    (tmp_path / "go").touch()
    last = plate.events(job)[-1]
    assert last["revision"] == 3
    assert "undo" in last["remarks"][-1]
    assert torch.equal(plate.studio.session.current.require_field().bank.frequency, led.bank.frequency)
    assert plate.ask("POST", "undo", {"base": 3}).status == 200
    assert plate.manifest()["live"]["sliders"]["pitch"] == 1.5


def test_a_capture_is_made_of_a_mesh(capture: Served, tmp_path: Path) -> None:
    manifest = capture.manifest()
    assert manifest["live"]["mode"] == "capture"
    assert {"capture", "reconstruct"} <= set(manifest["live"]["abilities"])
    assert manifest["object"]["kind"] == "mesh"
    assert trimesh.load(io.BytesIO(capture.get("object.glb").content), file_type="glb").bounds is not None
    points, normals = (tensor(capture, manifest, name) for name in ("points", "normals"))
    top = (points[:, 2] > 0.0019) & (np.abs(points[:, 0]) < 0.1) & (np.abs(points[:, 1]) < 0.07)
    assert np.median(normals[top] @ [0, 0, 1.0]) > 0.9
    assert capture.ask("POST", "capture/check", blow()).words["onset_seconds"] == pytest.approx(0.1, abs=1e-3)
    for number, place in enumerate(points[np.flatnonzero(top)[:3]].tolist()):
        query = "x={}&y={}&z={}&nx=0&ny=0&nz=-1".format(*place)
        answer = capture.ask("POST", f"capture/strikes?{query}", blow(number))
        assert (answer.status, answer.words["contact"]) == (201, pytest.approx(place))
    told = capture.get("capture").words
    assert [strike["file"] for strike in told["strikes"]] == ["001.wav", "002.wav", "003.wav"]
    assert told["ready"]
    assert capture.get("capture/strikes/002.wav").content == blow(1)
    quoted = {"If-Match": f'"{told["strikes"][1]["digest"]}"'}
    assert capture.ask("PUT", "capture/strikes/002.wav", blow(9), headers=quoted).words["row"] == 1
    assert capture.ask("PUT", "capture/strikes/002.wav", blow(8), headers=quoted).status == 409
    assert capture.ask("DELETE", "capture/strikes/003.wav").status == 200
    assert len(capture.get("capture").words["strikes"]) == 2
    assert (tmp_path / "lid" / "impacts.csv").is_file()
    (tmp_path / "lid" / "leak.wav").symlink_to(tmp_path / "lid.obj")
    for hidden in ("leak.wav", "impacts.csv", ".avmsf%2Fcapture.lock", "surface.obj"):
        assert capture.get(f"capture/strikes/{hidden}").status == 404
    assert capture.ask("POST", "capture/strikes?x=1", blow()).status == 400
    assert capture.ask("POST", "edit", {"base": 1, "pitch": 2.0}).status == 409


def test_a_reconstruction_needs_two_strikes(capture: Served) -> None:
    answer = capture.ask("POST", "reconstruct", {})
    assert answer.status == 409
    assert "recordings" in answer.words["error"]
    assert capture.get("jobs/unknown/events").status == 404
    assert capture.ask("DELETE", "jobs/unknown").status == 404


def test_the_field_that_a_job_made_is_opened_whatever_has_replaced_it_since(tmp_path: Path) -> None:
    made = adjust_modes(plate_field(), pitch=1.25)
    save(made, tmp_path / "made")
    script = (
        "import json, shutil, sys; task = json.loads(input()); shutil.copy(sys.argv[1], task['output'])\n"
        "print(json.dumps({'result': {'field': 'replaced', 'task': task, 'output': task['output']}}))"
    )
    with served(open_target(fill(tmp_path / "struck")), tmp_path / "files", preset="paper") as running:
        running.studio.jobs.command = (sys.executable, "-c", script, str(tmp_path / "made"))
        last = running.events(running.ask("POST", "reconstruct", {}).words["job"])[-1]
        assert last["field"] == "replaced"
        assert last["task"]["preset"] == "paper"
        assert torch.equal(running.studio.session.current.require_field().bank.frequency, made.bank.frequency)


def test_a_capture_with_a_field_is_struck_and_its_strikes_are_marked(tmp_path: Path) -> None:
    folder = fill_plate(tmp_path / "plate")
    (folder / ".avmsf").mkdir()
    field = plate_field()
    save(replace(field, samples=4000), folder / ".avmsf" / "field.safetensors")
    for target in (folder, folder / ".avmsf" / "field.safetensors"):
        opened = open_target(target)
        assert (opened.home, opened.capture) == (folder, folder)
    with served(opened, tmp_path / "files") as running:
        manifest = running.manifest()
        assert manifest["live"]["mode"] == "field"
        assert {"capture", "locate"} <= set(manifest["live"]["abilities"])
        assert len(manifest["strikes"]) == 8
        sound = running.get(manifest["strikes"][0]["sound"])
        assert sound.headers["content-type"] == "audio/wav"
        assert soundfile.read(io.BytesIO(sound.content))[1] == RATE


def test_a_port_in_use_is_named_with_a_way_out(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = other.getsockname()[1]
        with raises(StudioError, name="port", value=taken):
            serve(open_plate(tmp_path), port=taken, browser=False, log=print)
    with raises(StudioError, name="port", value=70_000):
        serve(open_plate(tmp_path), port=70_000, browser=False, log=print)
    # Without a port there is always one: at most one of two studios has the usual one.
    with listen(None) as one, listen(None) as two:
        assert one.getsockname()[1] != two.getsockname()[1]
        assert {each.getsockname()[0] for each in (one, two)} == {"127.0.0.1"}


BROWSER = "import os, sys; from pathlib import Path; path = Path(sys.argv[2].removeprefix('file://'))\n"
BROWSER += "Path(sys.argv[1]).write_text(f'{path.stat().st_mode & 0o777:o} {path.read_text()}')"


@pytest.mark.slow
def test_the_command_serves_until_it_is_told_to_end_and_tells_no_browsers_command_line_its_secret(tmp_path):
    opened, seen, script = open_plate(tmp_path / "opened"), tmp_path / "seen", tmp_path / "browser.py"
    script.write_text(BROWSER)
    command = [sys.executable, "-c", "import sys; from avmsf.cli import main; sys.exit(main())", "studio"]
    environment = {**os.environ, "TMPDIR": str(tmp_path / "temporary")}
    environment["BROWSER"] = f"{sys.executable} {script} {seen} %s"
    (tmp_path / "temporary").mkdir()
    command += [str(opened.field), "--port", "0", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    assert process.stderr is not None
    try:
        line = next(line for line in process.stderr if "http://" in line)
        address = line.split()[1]
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{32}/", address)
        with urllib.request.urlopen(f"{address}manifest.json", timeout=20) as answer:
            assert json.load(answer)["modes"] == 5
        wait_until(seen.exists)
        process.send_signal(signal.SIGINT)
        out, rest = process.communicate(timeout=20)
    finally:
        process.kill()
    assert (process.returncode, rest, json.loads(out)) == (0, "closed\n", {"address": address})
    assert list((tmp_path / "temporary").iterdir()) == []
    mode, _, text = seen.read_text().partition(" ")
    assert mode == "600"
    assert f'content="0; url={address}"' in text
