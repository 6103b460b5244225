"""RealImpact: 50 objects, each struck at 5 vertices and heard by 600 microphones, of which the closest is taken."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from avmsf.capture.audio import Recording
from avmsf.capture.folder import Capture
from avmsf.capture.settings import CaptureSettings
from avmsf.datasets.arrays import ArrayForm, judge_array, read_array
from avmsf.datasets.dataset import DatasetReport, Look, ObjectFacts, ObjectReport
from avmsf.datasets.detect import FOLDER, SOUNDS
from avmsf.datasets.listeners import closest_rows
from avmsf.datasets.numbering import (
    REALIMPACT_NAMES,
    in_order,
    in_words,
    material_in,
    number_of,
    refuse_unknown,
    shared_remarks,
)
from avmsf.datasets.recordings import Blow, gather
from avmsf.errors import CaptureError, DatasetError
from avmsf.mesh.surface import Surface, read_surface

RATE = 48_000.0
"""Of all recordings, Hz; no file tells it."""
ROWS = 3000
MESH = "transformed.obj"
FORMS = {
    SOUNDS: ArrayForm("float32", (ROWS, None)),
    "vertexID.npy": ArrayForm("int64", (ROWS,)),
    "vertexXYZ.npy": ArrayForm("float64", (ROWS, 3)),
    "listenerXYZ.npy": ArrayForm("float64", (ROWS, 3)),
    "angle.npy": ArrayForm("int64", (ROWS,)),
    "distance.npy": ArrayForm("int64", (ROWS,)),
    "micID.npy": ArrayForm("int64", (ROWS,)),
}
NEEDED = (SOUNDS, "vertexID.npy", "vertexXYZ.npy", "listenerXYZ.npy")
"""The arrays that a capture is made of; the others repeat where the microphones stood."""
DOWNLOAD = "http://downloads.cs.stanford.edu/viscam/RealImpact"
SELF_INTERSECTING = (37, 51, 73, 83)
"""Objects whose meshes intersect themselves."""
OFF_MESH = 1e-3
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

    def objects(self) -> tuple[str, ...]:
        """Return the names of all objects with recordings, by their numbers."""
        return self._objects

    def facts(self, identifier: str) -> ObjectFacts:
        """Return what is known of an object; its material is inferred from its name. Raises DatasetError for an unknown
        one."""
        self._expect(identifier)
        material = material_in(identifier)
        return ObjectFacts(identifier, in_words(identifier), material, inferred=material is not None)

    def capture(self, identifier: str) -> Capture:
        """Read one object's impacts, in the order of the files.

        Raises DatasetError for an unknown object, and for files that are missing, cut short or of another form.
        """
        self._expect(identifier)
        origin = f"{self.name}, {identifier}"
        surface = self._mesh(identifier)
        vertices, places, listeners = (self._array(identifier, name) for name in NEEDED[1:])
        corners = surface.vertices.double().numpy()
        rows, common = closest_rows(vertices, listeners, corners)
        contacts = torch.from_numpy(places[rows])
        off = torch.cdist(contacts, surface.vertices.double()).amin(dim=1)
        if float(off.max()) > OFF_MESH:
            raise DatasetError(
                f"{origin}: expected vertexXYZ.npy within {OFF_MESH:g} m of the vertices of {MESH}, got "
                f"{float(off.max()):.3g} m; unpack the archive again",
                file=self.folder / identifier / FOLDER / "vertexXYZ.npy",
                row=rows[int(off.argmax())],
                value=float(off.max()),
            )
        remarks = [] if common else ["no microphone position is common to all impacts: each has its closest one"]
        capture = gather(
            self._blows(identifier, rows, vertices=vertices, places=places),
            name=in_words(identifier),
            origin=origin,
            settings=self._settings,
            remarks=remarks,
            recorded=False,
        )
        return replace(capture, surface=surface)

    def look(self, identifier: str) -> Look | None:
        """Return the object's textured mesh; None where it is missing."""
        self._expect(identifier)
        folder = self.folder / identifier / FOLDER
        return Look(folder, CaptureSettings(surface=MESH)) if (folder / MESH).is_file() else None

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

    @cached_property
    def _objects(self) -> tuple[str, ...]:
        return in_order(path.name for path in self.folder.iterdir() if (path / FOLDER).is_dir() and path.name[0] != ".")

    def _expect(self, identifier: str) -> None:
        if identifier not in self.objects():
            refuse_unknown(identifier, self.objects(), self.name)

    def _array(self, identifier: str, name: str, *, lazily: bool = False) -> np.ndarray:
        shown = f"{identifier}/{FOLDER}/{name}"
        return read_array(self.folder / shown, FORMS[name], shown=shown, lazily=lazily)

    def _mesh(self, identifier: str) -> Surface:
        shown = f"{identifier}/{FOLDER}/{MESH}"
        if not (self.folder / shown).is_file():
            raise DatasetError(
                f"{shown}: expected a file, got none; unpack {identifier}.zip again", file=self.folder / shown
            )
        try:
            return read_surface(self.folder / shown)
        except CaptureError as error:
            raise DatasetError(str(error), **error.attributes) from error

    def _blows(self, identifier: str, rows: list[int], *, vertices: np.ndarray, places: np.ndarray) -> Iterator[Blow]:
        sounds = self._array(identifier, SOUNDS, lazily=True)
        for row in rows:
            name = f"{identifier}/{FOLDER}/{SOUNDS}, row {row}"
            sound = np.array(sounds[row], dtype=np.float64)
            if not np.isfinite(sound).all():
                raise DatasetError(
                    f"{name}: expected finite samples, got NaN or inf; unpack {identifier}.zip again",
                    file=self.folder / identifier / FOLDER / SOUNDS,
                    row=row,
                )
            recording = Recording(name, sound[None], RATE, "FLOAT")
            yield Blow(f"vertex_{vertices[row]}.wav", recording, places[row])

    def _report(self, identifier: str) -> ObjectReport:
        folder = self.folder / identifier / FOLDER
        problems = {name: judge_array(folder / name, form, shown=f"{FOLDER}/{name}") for name, form in FORMS.items()}
        wrong = [str(problem) for problem in problems.values() if problem is not None]
        usable = not any(problems[name] for name in NEEDED)
        if not (folder / MESH).is_file():
            wrong.append(f"{FOLDER}/{MESH}: expected a file to find the closest microphone, got none; unpack it again")
            usable = False
        count = len(np.unique(self._array(identifier, "vertexID.npy"))) if usable else 0
        return ObjectReport(self.facts(identifier), count, tuple(wrong))
