"""Work that was interrupted goes on from its own state, and from no other."""

from pathlib import Path

import pytest
import torch

from avmsf._utils import checkpoint
from avmsf._utils.checkpoint import Checkpoint
from avmsf.errors import AvmsfWarning, FitError
from factories.raising import raises, warns


def of(path: Path | str | None, **identity: str) -> Checkpoint:
    return Checkpoint(path, {"seed": "0", **identity}, what="the work", raising=FitError)


def test_a_state_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "new" / "state"
    assert of(path).read() is None
    of(path).save({"step": 3, "values": [torch.arange(3)]})
    state = of(str(path)).read()
    assert state["step"] == 3
    assert state["values"][0].tolist() == [0, 1, 2]
    assert [each.name for each in path.parent.iterdir()] == ["state"]
    # A state that cannot be written costs no work.
    with warns(AvmsfWarning, file="new/state/below"):
        of(path / "below").save({})


def test_without_a_path_nothing_is_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "SAVE_SECONDS", -1.0)
    of(None).save({"step": 3})
    assert of(None).read() is None
    assert not of(None).due
    assert of(tmp_path / "state").due


def test_the_state_of_other_work_is_refused_by_what_differs(tmp_path: Path) -> None:
    of(tmp_path / "state", recordings="a").save({})
    with raises(FitError, file="state", value=["recordings", "views"]):
        of(tmp_path / "state", recordings="b", views="c").read()


@pytest.mark.parametrize("kind", ["empty", "text", "cut", "list", "pickle"])
def test_what_is_no_checkpoint_is_refused_and_kept(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "state"
    of(path).save({"step": 3})
    if kind == "list":
        torch.save([1, 2], path)
    elif kind == "pickle":
        torch.save({"identity": Path("x"), "state": {}}, path)
    else:
        whole = path.read_bytes()
        path.write_bytes({"empty": b"", "text": b"hello there", "cut": whole[:-40]}[kind])
    before = path.read_bytes()
    with raises(FitError, file="state", value=None) as caught:
        of(path).read()
    # Torch's own message advises to switch its safety off.
    assert "weights_only" not in str(caught.value)
    assert path.read_bytes() == before
