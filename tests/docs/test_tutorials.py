"""README and tutorials: their commands and Python blocks run, page by page, on small simulated objects."""

import re
import shlex
import shutil
from pathlib import Path
from unittest.mock import patch

import pytest

from avmsf.cli import main
from avmsf.evaluation.registry import METHODS, METRICS
from avmsf.photographs.folder import write_frames
from factories.plate_capture import fill_plate
from factories.plate_set import fill_plates
from factories.small_scene import slab_views
from factories.verbs import sets

REPOSITORY = Path(__file__).resolve().parents[2]
DOCS = REPOSITORY / "docs"
PAGES = (*sorted((DOCS / "tutorials").glob("*.md")), REPOSITORY / "README.md", DOCS / "getting-started.md")
PHOTOGRAPHS, PYTHON = "**With photographs**", "## [Python]"
"""Where README turns from a capture with a mesh to one with photographs, and to Python."""
FEW_STEPS = sets("splat.steps=60 splat.start_points=800")
FEW_VIEWS = sets("views.rendered=48 views.count=18")
SMALL = {
    "fit bowl.ply": sets("modes=8 body.dofs=2000 body.wall=0.003"),
    "fit": (
        *(*FEW_STEPS, *FEW_VIEWS, *sets("lift.encoder=descriptors lift.symmetry=false")),
        *("--gain-model", "smooth", *sets("modes=8 fit.steps=4")),
    ),
    "evaluate": sets("modes=8"),
    "evaluate shots": ("--methods", "knn3", "--counts", "3", "--starts", "1", *sets("modes=8")),
}
"""For each verb, settings that take seconds; the pages' own take minutes."""
LONG = ("avmsf simulate", "avmsf fit scan")
"""Commands that take minutes with any setting: what they make is there already, or is not used on the page."""


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with what the pages' reader has: a capture, its field, and simulated objects."""
    folder = tmp_path_factory.mktemp("workshop")
    fill_plate(folder / "bowl")
    fill_plates(folder / "objects", ("mug-ceramic",), recordings="{:03d}.wav")
    (folder / "places.csv").write_text("x,y,z\n0.05,0.06,0\n")
    assert main(["fit", str(folder / "bowl"), "--output", str(folder / "bowl.safetensors"), *SMALL["fit"]]) == 0
    return folder


@pytest.fixture(scope="module")
def photographed(workshop: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the same with photographs in place of the mesh, which lies next to the folder."""
    folder = tmp_path_factory.mktemp("photographed") / "workshop"
    shutil.copytree(workshop, folder)
    (folder / "bowl" / "surface.ply").rename(folder / "bowl.ply")
    write_frames(slab_views(), folder / "bowl")
    return folder


def parts(page: Path) -> dict[str, str]:
    """Return the page's text by the folder in which it is to run."""
    text = page.read_text()
    if page.stem != "README":
        return {"photographed" if page.stem == "photographs" else "workshop": text}
    assert PHOTOGRAPHS in text
    assert PYTHON in text
    mesh, _, rest = text.partition(PHOTOGRAPHS)
    # Its Python, which another test runs, would fit bodies of many thicknesses, for minutes.
    return {"workshop": mesh, "photographed": rest.partition(PYTHON)[0]}


def steps(text: str) -> list[tuple[str, str]]:
    """Return a page's commands and Python blocks in their order, each as its kind and its text."""
    found = re.findall(r"^    (avmsf [^\n]+)$|^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return [("command", re.split(r"\s+#", command)[0]) if command else ("python", block) for command, block in found]


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_step_of_a_page_runs(page, request, tmp_path, monkeypatch):
    for folder, text in parts(page).items():
        assert steps(text)
        monkeypatch.chdir(shutil.copytree(request.getfixturevalue(folder), tmp_path / folder))
        for kind, step in steps(text):
            if step.startswith(LONG):
                continue
            if kind == "command":
                _, verb, *words = shlex.split(step)
                assert main([verb, *words, *SMALL.get(f"{verb} {words[0]}", SMALL.get(verb, ()))]) == 0, step
            else:
                # A page adds rows of its own to the tables.
                with patch.dict(METHODS), patch.dict(METRICS):
                    exec(compile(step, page.name, "exec"), {})


@pytest.mark.parametrize("page", ["README.md", pytest.param("docs/python.md", marks=pytest.mark.slow)])
def test_the_python_of_a_page_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill_plate(tmp_path / "bowl", surface=False)
    shutil.copy(tmp_path / "bowl" / "001.wav", tmp_path / "HIT.wav")
    monkeypatch.chdir(tmp_path)
    for block in re.findall(r"```python\n(.*?)```", (REPOSITORY / page).read_text(), re.DOTALL):
        # Others need photographs, or solve a body of many elements.
        if "read_views" not in block and "bowl.ply" not in block:
            exec(block, {})
    assert len(list(tmp_path.glob("*.safetensors"))) == 1
