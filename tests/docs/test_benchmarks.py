"""The tables of README and docs/benchmarks.md are what the stored records say."""

from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def pages() -> Iterator[ModuleType]:
    """Return the module that writes the pages; benchmarks are beside the package, not in it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(REPOSITORY)
        from benchmarks import pages

        yield pages


@pytest.mark.parametrize("name", ["README.md", "docs/benchmarks.md"])
def test_every_table_of_a_page_is_what_the_records_say(pages: ModuleType, name: str) -> None:
    text = (REPOSITORY / name).read_text(encoding="utf-8")
    assert text == pages.written(text), "python -m benchmarks tables"


def test_the_page_has_every_part_and_no_records_are_of_none(pages: ModuleType) -> None:
    text = (REPOSITORY / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    marked = {part for found in pages.MARKED.finditer(text) for part in found[2].split(" | ")[0].split()}
    assert marked == {*pages.parts(), "overview", "results"}
    assert {path.stem for path in pages.STORED.iterdir()} <= set(pages.parts())
