"""RealImpact: 50 objects, each struck at 5 vertices and recorded by 600 microphones, of which the closest is taken."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

from avmsf._utils.text import in_order
from avmsf.capture.audio import Recording
from avmsf.capture.folder import Capture
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.table import Impact
from avmsf.datasets.dataset import DatasetReport, ObjectFacts, ObjectReport, VisualSource
from avmsf.datasets.numbering import REALIMPACT_NAMES, expect_known, in_words, material_in, number_of, shared_remarks
from avmsf.datasets.recordings import build_capture
from avmsf.errors import CaptureError, DatasetError
from avmsf.mesh.surface import Surface

SAMPLE_RATE_HZ = 48_000.0
"""Of all recordings, Hz; no file tells it."""
ROWS = 3000
MESH = "transformed.obj"
FOLDER, SOUNDS = "preprocessed", "deconvolved_0db.npy"
"""An object's folder of arrays, and its sounds."""
POINTS = ("vertexID.npy", "vertexXYZ.npy", "listenerXYZ.npy")
FORMS: dict[str, tuple[str, tuple[int | None, ...]]] = {
    SOUNDS: ("float32", (ROWS, None)),
    "vertexID.npy": ("int64", (ROWS,)),
    "vertexXYZ.npy": ("float64", (ROWS, 3)),
    "listenerXYZ.npy": ("float64", (ROWS, 3)),
}
"""Types and shapes of the arrays that a capture is made of; None for any length. The other files of the dataset repeat
where the microphones stood."""
SAME_POSITION_M = 1e-3
"""Distance within which two microphone positions are equal."""
DOWNLOAD = "http://downloads.cs.stanford.edu/viscam/RealImpact"
SELF_INTERSECTING = (37, 51, 73, 83)
"""Objects whose meshes intersect themselves."""
MAX_MESH_DISTANCE_M = 1e-3
"""Meters that a struck vertex may lie off the mesh's vertices."""
SETTINGS = CaptureSettings(normalize="none", align=False)


class RealImpact:
    """RealImpact, unpacked: `<number>_<name>/preprocessed/deconvolved_0db.npy` and so on.

    The published sounds are divided by the hammer's spectrum already, and their first sample is the force's onset: they
    are taken as they are, or with `time_zero` "peak" from their peaks, as in the paper, and cut to 3 s. All impacts on
    an object are of one microphone (`closest_rows`). Of the sounds, 2.8 GB per object, only the rows needed are read.
    """

    name = "RealImpact"

    def __init__(self, folder: str | Path, *, time_zero: str | None = None) -> None:
        self.folder = Path(folder)
        self._settings = SETTINGS.starting(time_zero)
        folders = (path for path in self.folder.iterdir() if (path / FOLDER).is_dir() and path.name[0] != ".")
        self._objects = in_order(path.name for path in folders)

    def objects(self) -> tuple[str, ...]:
        """Return the names of all objects with recordings, by their numbers."""
        return self._objects

    def facts(self, identifier: str) -> ObjectFacts:
        """Return what is known of an object; its material is inferred from its name. Raises DatasetError for an unknown
        one."""
        expect_known(identifier, self.objects(), self.name)
        material = material_in(identifier)
        return ObjectFacts(identifier, in_words(identifier), material, inferred=material is not None)

    def capture(self, identifier: str) -> Capture:
        """Read one object's impacts, in the order of the files.

        Raises DatasetError for an unknown object, and for files that are missing, cut short or of another form.
        """
        folder, origin = self._folder_of(identifier), f"{self.name}, {identifier}"
        surface = self._mesh(identifier)
        vertices, positions, microphones = (open_array(folder / name) for name in POINTS)
        corners = surface.vertices.double().numpy()
        rows, common = closest_rows(vertices, microphones, corners)
        contacts = torch.from_numpy(positions[rows])
        off = torch.cdist(contacts, surface.vertices.double()).amin(dim=1)
        farthest = float(off.max())
        if farthest > MAX_MESH_DISTANCE_M:
            wanted = f"vertexXYZ.npy within {MAX_MESH_DISTANCE_M:g} m of the vertices of {MESH}"
            raise DatasetError(
                f"{origin}: expected {wanted}, got {farthest:.3g} m; unpack the archive again",
                file=folder / "vertexXYZ.npy",
                row=rows[int(off.argmax())],
                value=farthest,
            )
        remarks = [] if common else ["no microphone position is common to all impacts: each has its closest one"]
        capture = build_capture(
            self._recordings(identifier, rows, vertices=vertices, positions=positions),
            name=in_words(identifier),
            origin=origin,
            settings=self._settings,
            remarks=remarks,
            recorded=False,
        )
        return replace(capture, surface=surface)

    def visual_source(self, identifier: str) -> VisualSource | None:
        """Return the object's textured mesh; None where it is missing."""
        folder = self._folder_of(identifier)
        return VisualSource(folder, CaptureSettings(surface=MESH)) if (folder / MESH).is_file() else None

    def check(self) -> DatasetReport:
        """Report which files are there and which are missing, from names and headers alone."""
        reports = tuple(self._report(identifier) for identifier in self.objects())
        absent = [name for name in REALIMPACT_NAMES if name not in self.objects()]
        missing = []
        if absent:
            missing.append(
                f"{len(absent)} of {len(REALIMPACT_NAMES)} objects: unpack {DOWNLOAD}/NAME.zip in {self.folder}, where "
                f"NAME is {', '.join(absent)}"
            )
        numbers = [number_of(name) for name in self.objects()]
        remarks = shared_remarks(self.objects(), "ObjectFolder Real")
        knotted = [str(number) for number in SELF_INTERSECTING if number in numbers]
        if knotted:
            remarks.append(f"the meshes of {', '.join(knotted)} are self-intersecting")
        return DatasetReport(self.name, reports, tuple(missing), tuple(remarks))

    def _folder_of(self, identifier: str) -> Path:
        expect_known(identifier, self.objects(), self.name)
        return self.folder / identifier / FOLDER

    def _mesh(self, identifier: str) -> Surface:
        path = self._folder_of(identifier) / MESH
        if not path.is_file():
            raise DatasetError.expected("a file", file=path, advice=f"unpack {identifier}.zip again")
        try:
            return Surface.read(path)
        except CaptureError as error:
            raise DatasetError(str(error), **error.attributes) from error

    def _recordings(
        self, identifier: str, rows: list[int], *, vertices: np.ndarray, positions: np.ndarray
    ) -> Iterator[tuple[Impact, Recording]]:
        path = self._folder_of(identifier) / SOUNDS
        sounds = open_array(path)
        for row in rows:
            name = f"{identifier}/{FOLDER}/{SOUNDS}, row {row}"
            sound = np.array(sounds[row], dtype=np.float64)
            if not np.isfinite(sound).all():
                advice = f"unpack {identifier}.zip again"
                raise DatasetError.expected("finite samples", got="NaN or inf", file=path, row=row, advice=advice)
            recording = Recording(name, sound[None], SAMPLE_RATE_HZ, "FLOAT")
            yield Impact(f"vertex_{vertices[row]}.wav", positions[row].tolist()), recording

    def _report(self, identifier: str) -> ObjectReport:
        folder, problems = self._folder_of(identifier), []
        for name in FORMS:
            try:
                open_array(folder / name)
            except DatasetError as error:
                problems.append(str(error))
        if not (folder / MESH).is_file():
            wanted = "a file to find the closest microphone"
            problems.append(f"{FOLDER}/{MESH}: expected {wanted}, got none; unpack it again")
        count = 0 if problems else len(np.unique(open_array(folder / "vertexID.npy")))
        return ObjectReport(self.facts(identifier), count, tuple(problems))


def open_array(path: Path) -> np.ndarray:
    """Return the array of a file of `FORMS`, mapped into memory: only its header is read.

    Raises DatasetError unless it is whole and of its form.
    """
    dtype, shape = FORMS[path.name]
    if not path.is_file():
        raise DatasetError.expected("a file", file=path, advice="download or unpack it again")
    try:
        array = np.lib.format.open_memmap(path, mode="r")
    except (OSError, ValueError) as error:
        size = path.stat().st_size
        got, advice = f"{size} bytes ({error})", "download or unpack it again"
        raise DatasetError.expected(
            "a whole NumPy array", size, got=got, file=path, name="size", advice=advice
        ) from error
    advice = "take the published file"
    fits = len(shape) == array.ndim and all(a in (None, b) for a, b in zip(shape, array.shape, strict=True))
    if array.dtype != dtype or not fits:
        lengths = ", ".join("any" if length is None else str(length) for length in shape)
        wanted, value = f"{dtype} ({lengths})", (str(array.dtype), *array.shape)
        got = f"{array.dtype} {array.shape}"
        raise DatasetError.expected(wanted, value, got=got, file=path, name="shape", advice=advice)
    if not array.flags.c_contiguous:
        raise DatasetError.expected("row-major order", "F", got="column-major", file=path, name="order", advice=advice)
    return array


def closest_rows(
    vertices: Int64[np.ndarray, " rows"],
    microphones: Float64[np.ndarray, "rows 3"],
    surface: Float64[np.ndarray, "points 3"],
) -> tuple[list[int], bool]:
    """Return, for each impact vertex in the order of the rows, the row of the microphone closest to the object.

    The closest is the one with the smallest distance to the nearest point of the surface among the microphone positions
    that all vertices have in common, so that the sounds differ by the contact only. The second value is whether there
    are such positions; otherwise each vertex has its own closest microphone. Of equally close ones the first row is
    taken.
    """
    tree = cKDTree(surface)
    groups = [np.flatnonzero(vertices == vertex) for vertex in dict.fromkeys(vertices.tolist())]
    first = groups[0]
    matches = np.empty((len(groups), len(first)), dtype=np.int64)
    common = np.ones(len(first), dtype=bool)
    for index, group in enumerate(groups):
        distance, nearest = cKDTree(microphones[group]).query(microphones[first])
        matches[index] = group[nearest]
        common &= distance <= SAME_POSITION_M
    if not common.any():
        return [int(group[np.argmin(tree.query(microphones[group])[0])]) for group in groups], False
    best = int(np.argmin(np.where(common, tree.query(microphones[first])[0], np.inf)))
    return [int(row) for row in matches[:, best]], True
