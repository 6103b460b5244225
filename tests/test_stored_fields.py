"""Fields that earlier versions wrote are read, and sound as they did then."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from avmsf.field import SoundField
from avmsf.field.header import FORMAT
from stored_fields import fields

FILES = sorted((Path(__file__).parent / "data").glob("format-*/*.safetensors"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_stored_field_sounds_as_it_did(path):
    expected = load_file(path.parent / "expected")
    sounds = SoundField.load(path).render(expected["positions"], samples=200)
    loudest = float(expected[path.stem].abs().max())
    # Linear algebra rounds differently on other machines.
    torch.testing.assert_close(sounds, expected[path.stem], rtol=0, atol=1e-4 * loudest)


def test_the_present_format_has_stored_fields_of_all_kinds():
    assert {path.stem for path in FILES if path.parent.name == f"format-{FORMAT}"} == set(fields())


def test_a_stored_alignment_is_read():
    path = next(path for path in FILES if path.stem == "mixture")
    alignment = SoundField.load(path).alignment
    assert alignment is not None
    assert len(alignment.names) == len(alignment.delays) == 8
