"""Ctrl-C in a fit: what is kept, what is said, and that the same command goes on to the same field."""

from pathlib import Path

import pytest
import torch

from avmsf._utils.progress import ProgressDisplay
from avmsf.cli import main
from avmsf.field.store import load
from factories.plate_capture import TINY, fill_plate

NETWORK = ("--gain-model", "network", "--without-shape", *TINY)
Streams = pytest.CaptureFixture[str]


def test_the_same_command_goes_on_to_the_same_field(
    tmp_path: Path, capsys: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, cache = fill_plate(tmp_path / "plate"), tmp_path / "plate" / ".avmsf"
    whole, broken = tmp_path / "whole.safetensors", tmp_path / "broken.safetensors"
    assert main(["fit", str(folder), "--output", str(whole), "--cache", str(tmp_path / "other"), *NETWORK]) == 0
    capsys.readouterr()
    shown: list[int] = []

    def show(self: ProgressDisplay, stage: str, done: int, total: int, message: str) -> None:
        shown.append(done)
        if len(shown) == 14:
            raise KeyboardInterrupt

    monkeypatch.setattr(ProgressDisplay, "step", show)
    words = ["fit", str(folder), "--output", str(broken), *NETWORK]
    assert main(words) == 130
    assert (cache / "field.safetensors.checkpoint").exists()
    assert (cache / "modes.safetensors").exists()
    assert not broken.exists()
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[-1] == "avmsf fit: interrupted; repeat the command to continue"
    del shown[:]
    assert main(words) == 0
    # Of the six steps end to end, those after the second.
    assert shown == [3, 4, 5, 6]
    assert not (cache / "field.safetensors.checkpoint").exists()
    contacts = torch.tensor([[0.05, 0.06, 0.0], [0.1, 0.02, 0.0]])
    one, other = load(whole).render(contacts), load(broken).render(contacts)
    # The modes of two runs differ in their last digits, by up to 3e-7 of a damping; frequencies move phases by less.
    assert (one - other).abs().max() < 1e-4 * one.abs().max()
