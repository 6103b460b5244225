"""README and docs: commands parse, names exist, links lead somewhere, and tables are what the records say."""

import ast
import dataclasses
import importlib
import inspect
import json
import math
import pkgutil
import re
import shlex
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from itertools import permutations
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import avmsf
from avmsf.capture import CaptureSettings
from avmsf.cli import VERBS, options_of
from avmsf.evaluation.registry import expect_suited

REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
LINKED = [*PAGES, REPOSITORY / "CONTRIBUTING.md"]
TEXT = "\n".join(page.read_text() for page in PAGES)
ROWS = re.findall(r"^\|.*$", TEXT, re.MULTILINE)
COMMANDS = {
    *re.findall(r"^    (avmsf .+?)(?: +#.*)?$", TEXT, re.MULTILINE),
    *(command for row in ROWS for command in re.findall(r"`(avmsf \w+ .+?)`", row)),
}


def _blocks(language: str) -> list[str]:
    return [block for page in PAGES for block in re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.DOTALL)]


def _anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives a page's headings: lower case, letters, digits, spaces as dashes."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_every_command_of_the_docs_parses(command: str) -> None:
    _, verb, *arguments = shlex.split(command)
    options_of(verb, arguments)


@pytest.mark.parametrize("block", _blocks("python"))
def test_every_name_and_keyword_of_the_docs_python_exists(block: str) -> None:
    tree = ast.parse(block)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "avmsf":
            assert hasattr(avmsf, node.attr), node.attr
        if isinstance(node, ast.Call) and re.fullmatch(r"avmsf(\.\w+)+", name := ast.unparse(node.func)):
            keywords = {keyword.arg: None for keyword in node.keywords if keyword.arg}
            inspect.signature(pkgutil.resolve_name(name)).bind(*node.args, **keywords)


def test_the_docs_give_every_setting_of_a_capture_and_its_default(tmp_path: Path) -> None:
    defaults, others = _blocks("toml")
    (tmp_path / "capture.toml").write_text(defaults)
    assert CaptureSettings.read(tmp_path / "capture.toml") == CaptureSettings()
    (tmp_path / "capture.toml").write_text(others)
    CaptureSettings.read(tmp_path / "capture.toml")
    named = {*tomllib.loads(defaults), *tomllib.loads(others)}
    assert named == {field.name for field in dataclasses.fields(CaptureSettings)}


@pytest.mark.parametrize(
    "page", sorted((REPOSITORY / "src" / "avmsf").rglob("*/__init__.py")), ids=lambda page: page.parent.name
)
def test_each_module_is_named_by_its_packages_page(page: Path) -> None:
    text = " ".join(re.findall(r"`([^`]+)`", ast.get_docstring(ast.parse(page.read_text())) or ""))
    # The command's page has its subcommands as a table.
    verbs = VERBS if page.parent.name == "cli" else {}
    assert {path.stem for path in page.parent.glob("*.py")} - {"__init__", *verbs} <= set(re.findall(r"\w+", text))


def test_each_identifier_on_a_packages_page_exists() -> None:
    source, known = REPOSITORY / "src" / "avmsf", set[str]()
    trees = {path: ast.parse(path.read_text()) for path in source.rglob("*.py")}
    for path, tree in trees.items():
        known |= {*path.relative_to(source).with_suffix("").parts}
        known |= {str(getattr(node, kind, "")) for node in ast.walk(tree) for kind in ("id", "attr", "name", "arg")}
    pages = {path: ast.get_docstring(tree) or "" for path, tree in trees.items() if path.stem == "__init__"}
    named = [(path, name) for path, page in pages.items() for name in re.findall(r"`([\w.]*[A-Z_][\w.]*)[`(]", page)]
    assert len(named) > 200
    assert [each for each in named if not set(each[1].split(".")) <= known | {"avmsf"}] == []


@pytest.mark.parametrize("page", LINKED, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_no_text_directly_below_a_table_becomes_a_row(page: Path) -> None:
    assert re.findall(r"^\|.*\n(?![|\n]).+", page.read_text(), re.MULTILINE) == []


@pytest.mark.parametrize("page", LINKED, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_every_link_of_the_docs_leads_to_a_file_and_a_heading(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert not anchor or anchor in _anchors(target), link


def test_the_notebook_is_stored_without_outputs() -> None:
    """`make docs` executes it."""
    notebook = json.loads((REPOSITORY / "docs" / "tutorials" / "quickstart.ipynb").read_text())
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert cells
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in cells)


@pytest.mark.parametrize("page", ["paper-map", "gain-models"])
def test_every_function_and_test_in_the_table_of_equations_exists(page: str) -> None:
    text = (REPOSITORY / f"docs/{page}.md").read_text()
    functions = re.findall(r"`(avmsf\.[\w.]+)`", text)
    tests = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", text)
    assert min(len(functions), len(tests)) > 10
    for function in functions:
        pkgutil.resolve_name(function)
    for file, name in tests:
        assert f"def {name}(" in (REPOSITORY / file).read_text(), f"{file} has no {name}"


@pytest.fixture(scope="module")
def pages() -> Iterator[ModuleType]:
    """Return the module that writes the pages; benchmarks are beside the package, not in it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(REPOSITORY)
        from benchmarks import pages

        yield pages


@pytest.mark.parametrize("name", ["README.md", "docs/baselines.md", "docs/benchmarks.md", "docs/scale.md"])
def test_every_table_of_a_page_is_what_the_records_say(pages: ModuleType, name: str) -> None:
    text = (REPOSITORY / name).read_text(encoding="utf-8")
    assert text == pages.written(text), "python -m benchmarks tables"


@pytest.mark.parametrize("name", ["docs/baselines.md", "docs/benchmarks.md", "docs/scale.md"])
def test_figures_after_a_mark_are_in_the_records(pages: ModuleType, name: str) -> None:
    """In a paragraph after `<!-- from: PART ... -->` those of two decimals are values, or quotients of a kind."""
    text = (REPOSITORY / name).read_text(encoding="utf-8")
    marked = re.findall(r"<!-- from: (.+) -->\n((?:.+\n)+)", text)
    assert marked
    for parts, paragraph in marked:
        records = [each for part in parts.split() for each in pages.stored(pages.STORED / f"{part}.jsonl")]
        kinds = defaultdict(list)
        for each in records:
            if each.object in ("", "all") or parts.startswith("speed"):
                kinds[each.name.split(".")[1], each.name.split(".")[-1].split()[0]].append(each.value)
        known = [each.value for each in records]
        known += [one / other for same in kinds.values() for one, other in permutations(same, 2) if other]
        for figure in re.findall(r"(?<![\w.])\d*\.\d{2,}\b", paragraph):
            rounding = 0.501 * 10 ** -len(figure.partition(".")[2])
            assert any(abs(each - float(figure)) <= rounding for each in known), f"{figure} of {parts}"


def test_the_page_has_every_part_and_no_records_are_of_none(pages: ModuleType) -> None:
    text = (REPOSITORY / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    marked = {part for found in pages.MARKED.finditer(text) for part in found[2].split(" | ")[0].split()}
    assert marked == {*pages.parts(), "overview", "results"}
    assert {path.stem for path in pages.STORED.iterdir()} <= set(pages.parts())


def test_every_part_of_a_benchmark_that_the_docs_name_exists(pages: ModuleType) -> None:
    named = re.findall(r"\b([a-z]+)\s--parts((?:\s(?!--)[\w-]+)+)", TEXT)
    assert len(named) > 50
    assert {f"{name}.{part}" for name, parts in named for part in parts.split()} <= {*pages.parts()}


def test_a_number_has_three_digits_and_a_column_that_no_shown_row_has_is_of_dashes(pages: ModuleType) -> None:
    numbers = {999.4: "999", 999.6: "1000", -999.6: "-1000", 0.0612: ".0612", 2.0: "2", 1234.5: "1234"}
    assert {value: pages.in_digits(value) for value in numbers} == numbers
    table = pages.markdown([pages.Record("gains.sim20.mean.error", 0.5, "", "lower")], ["error", "gone"])
    assert table.splitlines() == ["|  | error ↓ | gone |", "|---|---|---|", "| mean | .500 | – |"]
    assert pages.markdown([pages.Record("gains.sim20.mean.error", 0.5, "", "lower")], ["gone"]) == ""


def test_a_part_is_measured_again_if_it_failed_or_its_records_are_of_another_commit(
    pages: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runner, commit, measured = importlib.import_module("benchmarks.__main__"), ["one"], list[str]()

    def measure(settings: Any) -> Iterator[Any]:
        """Measure nothing."""
        measured.append(commit[0])
        yield pages.Record("error", 0.5)
        if len(measured) == 1:
            yield pages.Record("failure", math.nan, object="bell", note="silent")

    monkeypatch.setattr(runner, "parts_of", lambda name: {"part": measure})
    monkeypatch.setattr(runner, "code_commit", lambda: commit[0])
    words = ["tasks", "--output", str(tmp_path)]
    assert [runner.main(words) for _ in range(3)] == [0, 0, 0]
    assert measured == ["one", "one"]
    commit[0] = "two"
    assert runner.main(words) == 0
    assert [each.commit for each in pages.stored(tmp_path / "tasks.part.jsonl")] == ["two"]
    # With changes that are not committed nothing is known.
    commit[0] = "two+"
    assert runner.main(words) == runner.main(words) == 0
    assert measured == ["one", "one", "two", "two+", "two+"]


def test_every_method_of_an_evaluation_is_there_and_suits_its_protocol(pages: ModuleType) -> None:
    for part in pages.parts_of("evaluation").values():
        for method in part.keywords["methods"].split(","):
            expect_suited(method, part.keywords["protocol"])
