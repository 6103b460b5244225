"""The tutorial notebook runs as it is, and holds no outputs."""

import json
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).resolve().parents[2] / "docs" / "tutorials" / "quickstart.ipynb"


def test_the_notebook_is_stored_without_outputs():
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    assert cells
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in cells)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Of Jupyter's own packages.
def test_the_notebook_plays_sounds_and_evaluates_a_field(tmp_path):
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbclient.NotebookClient(notebook, resources={"metadata": {"path": str(tmp_path)}}, timeout=300).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    shown = [output["data"] for output in outputs if "data" in output]
    assert sum("<audio" in data.get("text/html", "") for data in shown) == 5
    assert sum("image/png" in data for data in shown) == 5
    errors = [float(data["text/plain"]) for data in shown if data["text/plain"].replace(".", "").isdigit()]
    # The mean of the three nearest recordings has .86.
    assert errors[0] < 0.4
