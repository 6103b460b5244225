"""What mkdocs builds besides the written pages: references, formulas, pages of the root, and the gallery's sounds."""

import ast
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

REPOSITORY = Path(__file__).resolve().parents[1]
SOURCE = REPOSITORY / "src" / "avmsf"
ROOT_PAGES = {"Contributing": "CONTRIBUTING.md", "Changes": "CHANGELOG.md"}
HELP = """
import contextlib, io, json
from avmsf.cli import VERBS, main
found = {}
for verb in VERBS:
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        main([verb, "--help"])
    found[verb] = [VERBS[verb], text.getvalue()]
print(json.dumps(found))
"""
"""Prints each verb's summary and help.

It runs in a process of its own, so that what verbs import does not slow mkdocs down.
"""

_RULE = re.compile(r" *[-─]{10,} *$")
_generated: dict[str, str] = {}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Generate the pages and add them to the navigation."""
    _generated.clear()
    sections = {title: entry for part in config.nav for title, entry in part.items()}
    sections["Reference"][1:1] = [{"Command line": _command_pages()}, {"Python packages": _package_pages()}]
    for title, name in ROOT_PAGES.items():
        page = name.lower()
        # Links from the root lead into this folder.
        _generated[page] = (REPOSITORY / name).read_text().replace("](docs/", "](")
        sections["Development"].append({title: page})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages and sounds."""
    for path, text in _generated.items():
        files.append(File.generated(config, path, content=text))
    with TemporaryDirectory(prefix="avmsf-") as folder:
        environment = {**os.environ, "PYTHONPATH": str(SOURCE.parent)}
        subprocess.run([sys.executable, REPOSITORY / "docs" / "gallery.py", folder], check=True, env=environment)
        for path in Path(folder).iterdir():
            files.append(File.generated(config, f"gallery/{path.name}", content=path.read_bytes()))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Lead links to pages of the repository's root to their copies."""
    for name in ROOT_PAGES.values():
        markdown = re.sub(rf"\]\((?:\.\./)+{re.escape(name)}", f"]({name.lower()}", markdown)
    return markdown


def on_page_content(html: str, **_: Any) -> str:
    """Write formulas as MathML, which browsers show without a script."""

    def mathml(found: re.Match[str]) -> str:
        written = convert(_unescaped(found[3]), display="inline" if found[1] == "span" else "block")
        # The converter leaves no space after functions without parentheses.
        return re.sub(r"(<mi>(?:log|det)</mi>)(?!<mo[^>]*>&#x00028;)", r'\1<mspace width="0.17em"/>', written)

    return re.sub(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', mathml, html, flags=re.DOTALL)


def on_post_build(config: MkDocsConfig) -> None:
    """Refuse pages that load a script, a style, a font or a picture from another host."""
    pattern = re.compile(r'<(?:script|img|iframe|link rel="stylesheet")[^>]+(?:src|href)="(?:https?:)?//[^"]+"')
    for page in Path(config.site_dir).rglob("*.html"):
        if found := pattern.search(page.read_text()):
            raise SystemExit(f"{page}: expected nothing from other hosts, got {found[0]}")


def _unescaped(formula: str) -> str:
    return formula.replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")


def _command_pages() -> list[Any]:
    """Write one page for each verb from its help, and return their part of the navigation."""
    # The width of a page's text, in characters.
    environment = {**os.environ, "COLUMNS": "80", "NO_COLOR": "1", "PYTHONPATH": str(SOURCE.parent)}
    run = subprocess.run([sys.executable, "-c", HELP], capture_output=True, text=True, check=True, env=environment)
    helps: dict[str, list[str]] = json.loads(run.stdout)
    lines = [f"| [{verb}]({verb}.md) | {summary} |" for verb, (summary, _) in helps.items()]
    _generated["cli/README.md"] = "\n".join(["# Command line", "", "| command | |", "|---|---|", *lines, ""])
    for verb, (_, text) in helps.items():
        _generated[f"cli/{verb}.md"] = _command_page(verb, text)
    return ["cli/README.md", *({verb: f"cli/{verb}.md"} for verb in helps)]


def _command_page(verb: str, text: str) -> str:
    """Return a page of a verb's help: the usage as it is, the description as text, and the options as a list."""
    usage, _, rest = text.partition("\n\n")
    lines = rest.splitlines()
    page, described = [f"# avmsf {verb}", "", "```text", usage.strip(), "```", ""], False
    for line, following in zip(lines, [*lines[1:], ""], strict=True):
        words = line.strip().replace("<", "&lt;").replace("*", "\\*")
        indent = len(line) - len(line.lstrip())
        if _RULE.match(line):
            continue
        if indent <= 1 and words and (_RULE.match(following) or (words.endswith(":") and words.islower())):
            page += ["", f"## {words.strip(':').capitalize()}", ""]
            described = False
        elif 0 < indent <= 4 and (words.startswith("-") or re.match(r"[A-Z{\[]\S*[^.\s](  |$)", words)):
            name, _, description = words.partition("  ")
            page += ["", f"`{name}`", f":   {description.strip()}"]
            described = True
        elif page[-1] == ":   ":
            # The description of a long option begins on the line below.
            page[-1] += words
        else:
            page.append(f"    {words}" if described and words else words)
    return "\n".join(page) + "\n"


def _package_pages() -> list[Any]:
    """Write one page for each package that exports names, and return their part of the navigation."""
    exported = {path.parent: names for path in sorted(SOURCE.rglob("__init__.py")) if (names := _names(path))}
    entries = []
    for folder, names in exported.items():
        module = _module(folder)
        lines = [f"# {module}", "", ast.get_docstring(ast.parse((folder / "__init__.py").read_text())) or "", ""]
        # Each name is documented once, in the package below that exports it too.
        below = {name: _module(other) for other in exported if other.is_relative_to(folder) for name in exported[other]}
        elsewhere = [f"[{name}][{below[name]}.{name}]" for name in names if below[name] != module]
        lines += [f"Documented with the packages below: {', '.join(elsewhere)}.", ""] if elsewhere else []
        lines += [f"::: {module}.{name}\n" for name in names if below[name] == module]
        _generated[f"api/{module}.md"] = "\n".join(lines)
        entries.append({module: f"api/{module}.md"})
    return entries


def _names(package: Path) -> list[str]:
    """Return the names that a package exports: those of its `__all__`, and those that its stub imports from modules."""
    stub = package.with_suffix(".pyi")
    exported: list[str] = []
    for node in ast.parse(package.read_text()).body:
        literal = isinstance(node, ast.Assign) and isinstance(node.value, ast.List)
        if literal and ast.unparse(node.targets[0]) == "__all__":
            exported = [each.value for each in node.value.elts if isinstance(each, ast.Constant)]
            if len(exported) == len(node.value.elts):
                return [name for name in exported if not name.startswith("_")]
    nodes = ast.parse(stub.read_text()).body if stub.exists() else []
    imports = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
    named = {*exported, *(each.name for node in imports for each in node.names)}
    return sorted(name for name in named if not name.startswith("_"))


def _module(folder: Path) -> str:
    return ".".join(folder.relative_to(SOURCE.parent).parts)
