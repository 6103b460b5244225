"""The most probable body of a field: when it is named, and when it warns."""

import math
from pathlib import Path

import pytest
import torch

from avmsf.errors import FieldFileError
from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import save
from avmsf.modal.residual_noise import Residual
from factories.made_fields import BANK, positional


def field_with(report: dict[str, object]) -> SoundField:
    zero = torch.zeros(len(BANK), dtype=torch.float64)
    return SoundField(BANK, positional(), zero, Residual(torch.full((9,), 1e-3)), 8000.0, 400, Origin(report=report))


def body_report(*, wall: float | None, ratio: float, searched: bool = False) -> dict[str, object]:
    """A report whose most probable body has this wall, meters, and this ratio of stiffness to density over aluminum's.

    Frequencies of one shape scale with the square root of the ratio.
    """
    body = {"body": "shape", "wall_thickness": wall, "frequency_factor": math.sqrt(ratio), "support": "free"}
    credibility = {"credible": True, "with_body": 2.5, "without_body": 0.75}
    thickness = {"median": 0.0013, "low": 0.0009, "high": 0.0018} if searched else None
    return {"bodies": [body], "credibility": credibility, "thickness": thickness}


def test_a_body_stiffer_than_every_material_warns_and_a_plausible_one_does_not() -> None:
    # Ceramic has 1.03 times aluminum's ratio. Beyond it 5 % of frequency are allowed for, and 20 % of thickness: a
    # jug's of 1.15 has the truth within its interval.
    for wall, searched in ((0.0013, True), (0.0035, False), (None, False)):
        for ratio in (3.67, 1.7, 1.5, 1.03, 0.1):
            field = field_with(body_report(wall=wall, ratio=ratio, searched=searched))
            assert field.body is not None
            assert bool(field.body.warning) is (ratio > 1.6)
            assert field.body.record()["warning"] == (field.body.warning or None)
            assert field.body.warning in repr(field)


def test_a_body_that_is_not_credible_or_edited_is_not_named() -> None:
    report = body_report(wall=None, ratio=9.0)
    assert field_with(report | {"credibility": {"credible": False}}).body is None
    assert field_with(report | {"edits": [{"edit": "x"}]}).body is None


@pytest.mark.parametrize(
    "damage", [{"bodies": []}, {"bodies": [3]}, {"bodies": {}}, {"thickness": 3}, {"thickness": {"a": 1}}]
)
def test_a_damaged_report_of_a_body_is_refused(tmp_path: Path, damage: dict[str, object]) -> None:
    with pytest.raises(FieldFileError):
        save(field_with(body_report(wall=0.0013, ratio=1.0, searched=True) | damage), tmp_path / "jug.safetensors")
