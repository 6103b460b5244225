"""A cache that cannot be written changes no result."""

from pathlib import Path

import pytest

from avmsf._utils import caching
from avmsf._utils.files import write_whole
from avmsf.errors import AvmsfWarning, FitError
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
