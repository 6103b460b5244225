"""The pages of the command line that the documentation generates from the commands' help."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

HOOKS = Path(__file__).resolve().parents[2] / "docs" / "hooks.py"


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    hooks = _hooks()
    hooks._command_pages()
    return dict(hooks._generated)


def test_every_option_has_a_description_on_its_line(pages: dict[str, str]) -> None:
    described = [line for page in pages.values() for line in page.splitlines() if line.startswith(":")]
    assert len(described) > 200
    assert all(line.removeprefix(":   ").strip() for line in described)


def _hooks() -> ModuleType:
    pytest.importorskip("latex2mathml")
    pytest.importorskip("mkdocs")
    spec = spec_from_file_location("docs_hooks", HOOKS)
    assert spec is not None
    assert spec.loader is not None
    hooks = module_from_spec(spec)
    spec.loader.exec_module(hooks)
    return hooks
