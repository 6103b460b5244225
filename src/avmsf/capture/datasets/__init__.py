"""Published recordings of many objects, each read as the `Capture` that a folder made by hand would give."""

from avmsf.capture.datasets.collection import CaptureCollection
from avmsf.capture.datasets.dataset import Dataset, DatasetReport, Look, ObjectFacts, ObjectReport
from avmsf.capture.datasets.numbering import shared_objects
from avmsf.capture.datasets.objectfolder_compact import ObjectFolderCompact
from avmsf.capture.datasets.objectfolder_raw import ObjectFolderRaw
from avmsf.capture.datasets.realimpact import RealImpact
from avmsf.capture.datasets.recognize import open_dataset

__all__ = [
    "CaptureCollection",
    "Dataset",
    "DatasetReport",
    "Look",
    "ObjectFacts",
    "ObjectFolderCompact",
    "ObjectFolderRaw",
    "ObjectReport",
    "RealImpact",
    "open_dataset",
    "shared_objects",
]
