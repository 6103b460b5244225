"""The Python of the README and of docs/python.md runs as it is printed, on a small plate."""

import re
import shutil
from pathlib import Path

import pytest

from factories.plate_capture import fill_plate

REPOSITORY = Path(__file__).resolve().parents[2]


def blocks(page: str) -> list[str]:
    """Return the blocks of code, but for those that need photographs, or solve a body of many elements."""
    found = re.findall(r"```python\n(.*?)```", (REPOSITORY / page).read_text(), re.DOTALL)
    return [block for block in found if "read_views" not in block and "bowl.ply" not in block]


@pytest.mark.parametrize("page", ["README.md", pytest.param("docs/python.md", marks=pytest.mark.slow)])
def test_the_python_of_a_page_runs(page, tmp_path, monkeypatch):
    fill_plate(tmp_path / "bowl", surface=False)
    shutil.copy(tmp_path / "bowl" / "001.wav", tmp_path / "HIT.wav")
    monkeypatch.chdir(tmp_path)
    for block in blocks(page):
        exec(block, {})
    assert (tmp_path / "bowl.safetensors").is_file()
