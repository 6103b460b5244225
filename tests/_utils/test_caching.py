"""States, caches and tensors in files: they come back, and no others do."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save as to_bytes

from avmsf._utils import caching
from avmsf._utils.checkpoint import Checkpoint
from avmsf._utils.files import write_whole
from avmsf._utils.headers import FileKind
from avmsf._utils.tensor_files import read_tensors, write_tensors
from avmsf.errors import AvmsfWarning, FieldFileError, FitError
from factories.raising import raises, warns


def test_where_nothing_can_be_kept_the_work_goes_on_and_the_cause_is_told_once(tmp_path: Path) -> None:
    caching.keep_if_possible(lambda: write_whole(tmp_path / "kept", "a"), tmp_path / "kept")
    assert (tmp_path / "kept").read_text() == "a"
    with warns(AvmsfWarning, file=tmp_path / "kept", value="File exists"):
        caching.keep_if_possible(lambda: write_whole(tmp_path / "kept/a", "a"), tmp_path / "kept/a")
    # A second warning would be an error here.
    caching.keep_if_possible(lambda: write_whole(tmp_path / "kept/b", "a"), tmp_path / "kept/b")

    def refuse() -> None:
        raise FitError("too few")

    # What is wrong with the work itself is no matter of the disk.
    with pytest.raises(FitError):
        caching.keep_if_possible(refuse, tmp_path / "kept")


def test_a_digest_is_of_values_types_and_shapes_and_not_of_how_they_lie_in_memory() -> None:
    given = torch.tensor([[1.0 + 2j, 3.0], [0.0, -1j]])
    same = (given, given.conj().conj(), given.T.contiguous().T, given.numpy(), given.conj().resolve_conj().conj())
    assert len({caching.content_digest(("a", 1), each) for each in same}) == 1
    others = (given.conj(), given.T, given.reshape(4), given.to(torch.complex128), given.real, None, "a")
    assert len({caching.content_digest(("a", 1), each) for each in (given, *others)}) == 1 + len(others)
    parts = (("a", "b"), ("b", "a"), ("ab",), (("a", "b"),), (given, "a"), ("a", given), ("1",), (1,))
    assert len({caching.content_digest(*each) for each in parts}) == len(parts)


def test_a_digest_knows_the_modules_that_a_module_imports_and_no_others(tmp_path: Path) -> None:
    sources = {
        "shop/__init__.py": "",
        "shop/made.py": "def make():\n    from shop.parts import Bolt\n",
        "shop/parts/__init__.py": "",
        "shop/parts/__init__.pyi": "from .bolts import Bolt as Bolt\nfrom .nuts import Nut as Nut\n",
        "shop/parts/bolts.py": "from shop import steel\n",
        "shop/parts/nuts.py": "",
        "shop/steel.py": "",
    }
    for name, text in sources.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def digest() -> str:
        caching.source_digest.cache_clear()
        return caching.source_digest("shop.made", tmp_path)

    before = digest()
    for name, text in sources.items():
        if name.endswith(".py"):
            (tmp_path / name).write_text(text + "# changed\n")
            assert (digest() != before) == (name != "shop/parts/nuts.py"), name
            (tmp_path / name).write_text(text)
    assert digest() == before


def test_what_is_made_once_gives_its_result_or_its_failure_again() -> None:
    calls = []

    def make(number: int, *, sign: int = 1) -> int:
        calls.append((number, sign))
        if number > 2:
            raise FitError("failed", value=len(calls))
        return sign * number

    made = caching.once(make)
    assert [made(1), made(2), made(1), made(1, sign=-1), made(2)] == [1, 2, 1, -1, 2]
    for _ in range(2):
        with raises(FitError, value=4):
            made(3)
    assert calls == [(1, 1), (2, 1), (1, -1), (3, 1)]


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


KIND = FileKind("kind", "a file", "make it again", FieldFileError, formats=(1,))
PLACES = torch.zeros(4, 3, dtype=torch.float64)


@pytest.mark.parametrize(
    "damaged",
    [
        *(lambda whole, kept=kept: whole[:kept] for kept in (0, 5, 9, 100, -1)),
        lambda whole: b"a long text about bowls\n" * 9,
        lambda whole: bytes(200),
        lambda whole: b"RIFF" + bytes(2000),
        lambda whole: to_bytes({"places": PLACES}),
        lambda whole: to_bytes({"places": PLACES}, {"format": "pt"}),
        *(
            lambda whole, words=words: to_bytes({"places": PLACES}, {"kind": words})
            for words in ("", "[]", "[" * 100_000, "{", '"kind"', '{"format": 1}', '{"format": 2, "version": "9.9"}')
        ),
    ],
)
def test_a_file_cut_short_or_of_another_kind_is_refused_as_a_missing_one_and_a_folder(tmp_path, damaged):
    path = tmp_path / "file"
    write_tensors(path, {"places": PLACES}, KIND.to_text({"a": 1}, path, name="record"), KIND)
    assert KIND.parse(read_tensors(path, KIND)[0], path)["a"] == 1
    path.write_bytes(damaged(path.read_bytes()))
    for wrong in (path, tmp_path / "nowhere", tmp_path):
        with raises(FieldFileError, file=wrong):
            KIND.parse(read_tensors(wrong, KIND)[0], wrong)
