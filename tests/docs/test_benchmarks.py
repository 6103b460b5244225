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


def test_a_number_has_three_digits_and_a_column_that_no_shown_row_has_is_of_dashes(pages: ModuleType) -> None:
    numbers = {999.4: "999", 999.6: "1000", -999.6: "-1000", 0.0612: ".0612", 2.0: "2", 1234.5: "1234"}
    assert {value: pages.in_digits(value) for value in numbers} == numbers
    table = pages.markdown([pages.Record("gains.sim20.mean.error", 0.5, "", "lower")], ["error", "gone"])
    assert table.splitlines() == ["|  | error ↓ | gone |", "|---|---|---|", "| mean | .500 | – |"]


def test_a_method_without_results_has_no_column_and_its_part_is_named(
    pages: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {"gains.sim20": (pages.Record("gains.sim20.mean.mixture", 0.5),)}
    monkeypatch.setattr(pages, "_records", lambda part: found.get(part, ()))
    text = pages.written("<!-- measured: results -->\n<!-- end -->")
    assert "|   | **avmsf's default** |\n| --- | --- |\n| 20 simulated objects, 8 | .500 |" in text
    missing = text.partition("No records yet of:")[2]
    assert "align --parts errors" in missing
    assert "captures" in missing
    assert "--parts sim20 " not in missing
