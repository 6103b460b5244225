"""Fields that earlier versions wrote are read, and sound as they did then."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from avmsf.editing.material import change_material, infer_material
from avmsf.editing.modal_edit import EDITS, adjust_modes
from avmsf.errors import FieldFileError
from avmsf.fem.material import GLASS, WOOD
from avmsf.field.gains.attention import AttentionGains
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.scaled import BodyGains, ScaledGains
from avmsf.field.header import FORMAT
from avmsf.field.store import load
from factories.raising import raises

FILES = sorted((Path(__file__).parent / "data").glob("format-*/*.safetensors"))
MIXTURE = Path(__file__).parent / "data" / f"format-{FORMAT}" / "mixture.safetensors"


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_stored_field_sounds_as_it_did(path):
    expected = load_file(path.parent / "expected")
    sounds = load(path).render(expected["positions"], samples=200)
    loudest = float(expected[path.stem].abs().max())
    # Linear algebra rounds differently on other machines.
    torch.testing.assert_close(sounds, expected[path.stem], rtol=0, atol=1e-4 * loudest)


def test_the_present_format_has_stored_fields_of_all_kinds():
    kinds = {load(path).gain_field.kind for path in FILES if path.parent == MIXTURE.parent}
    assert kinds == {each.kind for each in (AttentionGains, BodyGains, MixtureGains, ScaledGains)}


def test_a_stored_alignment_is_read():
    alignment = load(MIXTURE).alignment
    assert len(alignment.names) == len(alignment.delays) == 8


def test_edits_of_earlier_versions_have_the_present_names(tmp_path):
    field = adjust_modes(change_material(load(MIXTURE), GLASS, WOOD), pitch=1.1)
    entries = field.origin.report[EDITS]
    old = [{**entry, "edit": kind} for entry, kind in zip(entries, ("recast", "retune"), strict=True)]
    report = {**field.origin.report, EDITS: [*old, {"edit": "steer"}, {"edit": "recast", "to": entries[0]["to"]}]}
    replace(field, origin=replace(field.origin, report=report)).save(tmp_path / "old.safetensors")
    assert b"recast" in (tmp_path / "old.safetensors").read_bytes()
    read = load(tmp_path / "old.safetensors")
    kinds = [entry["edit"] for entry in read.origin.report[EDITS]]
    assert kinds == ["change_material", "adjust_modes", "guided", "change_material"]
    assert read.origin.report[EDITS][:2] == entries
    assert infer_material(read, option="--from")[0] == WOOD


@pytest.mark.parametrize(
    ("report", "name"),
    [
        ({EDITS: ["x"]}, "edits.0"),
        ({EDITS: [{"a": 1}]}, "edits.0.edit"),
        ({EDITS: [{"edit": "change_material"}]}, "edits.0.to"),
        ({EDITS: [{"edit": "recast", "to": {"name": "wood"}}]}, "edits.0.to.density"),
        ({EDITS: [{"edit": "adjust_modes", "decay": 1.0}]}, "edits.0.pitch"),
        ({EDITS: [{"edit": "adjust_modes", "pitch": 0.0, "decay": 1.0}]}, "edits.0.pitch"),
        ({"supporting_poles": 3}, "supporting_poles"),
        ({"supporting_poles": [0, 1.0]}, "supporting_poles.1"),
        ({"supporting_poles": [-1]}, "supporting_poles.0"),
        ({"supporting_poles": [10_000]}, "supporting_poles.0"),
    ],
)
def test_edits_and_supporting_poles_that_cannot_be_are_refused(report, name, tmp_path):
    field = load(MIXTURE)
    damaged = replace(field, origin=replace(field.origin, report={**field.origin.report, **report}))
    with raises(FieldFileError, name=f"origin.report.{name}"):
        damaged.save(tmp_path / "field.safetensors")
