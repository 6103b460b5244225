"""Ctrl-C: what is kept, what is said, and that the same command goes on to the same field."""

from pathlib import Path

import pytest
import torch

from avmsf.cli import main
from avmsf.cli.progress import FitBar
from avmsf.field.fit import Progress
from avmsf.field.store import load
from factories.plate_capture import TINY, fill_plate

NETWORK = ("--gain-model", "network", *TINY)


class SoughtAgainError(Exception):
    """Modes were extracted although they are cached."""


Streams = pytest.CaptureFixture[str]


def interrupt_at(monkeypatch: pytest.MonkeyPatch, step: int) -> list[int]:
    """Let Ctrl-C come while a step is shown, once; return the steps that are shown."""
    shown: list[int] = []

    def show(self: FitBar, progress: Progress) -> None:
        shown.append(progress.step)
        if len(shown) == step:
            raise KeyboardInterrupt

    monkeypatch.setattr(FitBar, "show", show)
    return shown


def test_the_same_command_goes_on_to_the_same_field(
    tmp_path: Path, capsys: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = fill_plate(tmp_path / "plate")
    whole, broken = tmp_path / "whole.safetensors", tmp_path / "broken.safetensors"
    assert main(["fit", str(folder), "--output", str(whole), *NETWORK]) == 0
    capsys.readouterr()
    shown = interrupt_at(monkeypatch, 14)
    words = ["fit", str(folder), "--output", str(broken), *NETWORK]
    assert main(words) == 130
    checkpoint, modes = tmp_path / "broken.safetensors.checkpoint", tmp_path / "broken.safetensors.modes"
    assert checkpoint.exists()
    assert modes.exists()
    assert not broken.exists()
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[-1] == (
        f"avmsf fit: interrupted; repeat the command to continue from {checkpoint}, or delete it"
    )
    # Another fit does not take this one's checkpoint for its own.
    assert main([*words, "--seed", "1"]) == 2
    assert str(checkpoint) in capsys.readouterr().err
    del shown[:]
    assert main(words) == 0
    assert shown == [15, 16, 17, 18]
    assert sorted(each.name for each in tmp_path.iterdir()) == ["broken.safetensors", "plate", "whole.safetensors"]
    contacts = torch.tensor([[0.05, 0.06, 0.0], [0.1, 0.02, 0.0]])
    one, other = load(whole).render(contacts), load(broken).render(contacts)
    # The modes of two runs differ in their last digits, by up to 3e-7 of a damping; frequencies move phases by less.
    assert (one - other).abs().max() < 1e-4 * one.abs().max()


def test_an_interruption_before_training_keeps_nothing(
    tmp_path: Path, capsys: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    from avmsf.modal.extraction import extract as kept

    def stop(*arguments: object) -> None:
        raise KeyboardInterrupt

    folder = fill_plate(tmp_path / "plate")
    monkeypatch.setattr(kept, "extract_modes", stop)
    assert main(["fit", str(folder), "--output", str(tmp_path / "field.safetensors"), *NETWORK]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "avmsf fit: interrupted"
    assert [path.name for path in tmp_path.iterdir()] == ["plate"]


def test_an_interruption_as_training_begins_keeps_the_modes(
    tmp_path: Path, capsys: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    from avmsf.modal.extraction import extract as kept
    from avmsf.pipeline import fitting

    def stop(*arguments: object, **named: object) -> None:
        raise KeyboardInterrupt

    def refuse(*arguments: object) -> None:
        raise SoughtAgainError

    words = ["fit", str(fill_plate(tmp_path / "plate")), "--output", str(tmp_path / "field.safetensors"), *NETWORK]
    with monkeypatch.context() as patched:
        patched.setattr(fitting, "fit", stop)
        assert main(words) == 130
    assert capsys.readouterr().err.splitlines()[-1].endswith("from the start of training")
    with monkeypatch.context() as patched:
        patched.setattr(kept, "extract_modes", refuse)
        # The modes that are kept are this method's alone.
        with pytest.raises(SoughtAgainError):
            main([*words, "--extraction", "short-time"])
        assert main(words) == 0
