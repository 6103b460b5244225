"""A file nested far deeper than any reader's own is refused by each reader's own error, or is as good as none."""

from collections.abc import Callable
from pathlib import Path

import pytest

from avmsf.datasets.objectfolder import CONTACT_LISTS, read_contacts
from avmsf.errors import AvmsfError, DatasetError, EvaluationError
from avmsf.evaluation.results import IDENTITY, ResultsFolder
from avmsf.pipeline.stages import Stage, StageFolder

NESTED = "[" * 100_000


def read_lines(path: Path) -> None:
    path.write_text(f'{{"a": {NESTED}')
    read_contacts([path])


@pytest.mark.parametrize(
    ("name", "read", "kind"),
    [
        (CONTACT_LISTS[0], lambda path: read_contacts([path]), DatasetError),
        (CONTACT_LISTS[1], read_lines, DatasetError),
        (IDENTITY, lambda path: ResultsFolder(path.parent).identity(), EvaluationError),
    ],
)
def test_a_nested_file_is_refused(
    tmp_path: Path, name: str, read: Callable[[Path], object], kind: type[AvmsfError]
) -> None:
    (tmp_path / name).write_text(NESTED)
    with pytest.raises(kind):
        read(tmp_path / name)


def test_a_stage_whose_record_is_nested_runs_again(tmp_path: Path) -> None:
    made: list[Path] = []

    def make(path: Path) -> None:
        made.append(path)
        path.write_text("made")

    for _ in range(2):
        StageFolder(tmp_path).keep(Stage("stage", make))
        (record,) = tmp_path.glob("*.json")
        record.write_text(NESTED)
    assert len(made) == 2
