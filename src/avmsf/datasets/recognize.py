"""The class that reads a folder's dataset."""

from pathlib import Path

from avmsf.datasets.collection import CaptureCollection
from avmsf.datasets.dataset import Dataset
from avmsf.datasets.detect import Kind, expect_signs
from avmsf.datasets.objectfolder_raw import ObjectFolderRaw
from avmsf.datasets.realimpact import RealImpact
from avmsf.errors import DatasetError

_CLASSES: dict[Kind, type[CaptureCollection] | type[ObjectFolderRaw] | type[RealImpact]] = {
    "captures": CaptureCollection,
    "ObjectFolder Real": ObjectFolderRaw,
    "RealImpact": RealImpact,
}


def open_dataset(
    path: str | Path,
    *,
    contacts: str | Path | None = None,
    table: str | Path | None = None,
    time_zero: str | None = None,
) -> Dataset:
    """Return the dataset that a folder holds, recognized by its files.

    `contacts` is the path of ObjectFolder Real's contacts, `table` that of its objects' names (`ObjectFolderRaw`).
    `time_zero` is where sounds start, `onset` or `peak`; None leaves that to the dataset or the captures. Raises
    DatasetError for a folder that holds none and for options that the dataset does not take.
    """
    folder = Path(path)
    kind = _CLASSES[expect_signs(folder)]
    for name, given in (("contacts", contacts), ("table", table)):
        if given is not None and kind is not ObjectFolderRaw:
            raise DatasetError.expected(
                f"no `{name}` with {kind.name}", str(given), got=str(given), file=folder, name=name, advice="omit it"
            )
    if kind is ObjectFolderRaw:
        return ObjectFolderRaw(folder, contacts=contacts, table=table, time_zero=time_zero)
    return kind(folder, time_zero=time_zero)
