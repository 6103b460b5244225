"""The files that the page fetches: those of the last few revisions."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Float32
from torch import Tensor

from avmsf.capture.folder import read_capture
from avmsf.capture.impacts import Impacts
from avmsf.errors import CaptureError, CaptureWarning, StudioError
from avmsf.export.sampled_field import SampledField, outward_normals, supporting_columns
from avmsf.export.web import make_bundle
from avmsf.export.writing import MAX_POINTS
from avmsf.features.feature_field import FeatureField
from avmsf.field.gains.model import points_on_object
from avmsf.field.sound_field import SoundField
from avmsf.gaussians.ply import holds_gaussians, read_splats
from avmsf.mesh.surface import Surface
from avmsf.studio.capture import CaptureEditor
from avmsf.studio.opening import Opened, find_object, find_reconstructed
from avmsf.studio.session import Revision

_MAX_OBJECT_POINTS = 8_000
"""Points of an object without a field."""


@dataclass(frozen=True, eq=False)
class Shown:
    """One revision's files."""

    manifest: dict[str, Any]
    files: Mapping[str, bytes]
    """Contents by relative path, those of the object and of recorded impacts included."""
    sampled: SampledField
    revision: Revision
    remarks: tuple[str, ...]
    """What is shown differs from what there is, a sentence each."""


class Showcase:
    """The files of the last revisions, in memory."""

    def __init__(self, opened: Opened, editor: CaptureEditor | None) -> None:
        self.opened, self.editor = opened, editor
        self.meters = 1.0 if opened.object is not None else opened.settings.surface_meters
        self._shown: dict[int, Shown] = {}

    @property
    def current(self) -> Shown:
        """The last revision's files."""
        return list(self._shown.values())[-1]

    def files_of(self, number: int) -> Mapping[str, bytes]:
        """Return a revision's files, or the last one's if they are no longer kept."""
        return self._shown.get(number, self.current).files

    def show(self, revision: Revision) -> None:
        """Make a revision's files. Raises the errors of `make_bundle`, and StudioError without geometry."""
        sampled = self._sampled(revision)
        if self._is_other_field(revision):
            strikes, remarks = self._strikes(revision.field)
            shown, surface = find_object(self.opened), self._surface(revision.field)
            bundle = make_bundle(sampled, object=shown, meters=self.meters, surface=surface, strikes=strikes)
            manifest, files, remarks = {**bundle.manifest}, bundle.files, remarks + bundle.remarks
        else:
            before, bundle = self.current, make_bundle(sampled)
            kept = {part: before.manifest[part] for part in ("object", "surface", "strikes")}
            manifest, files = {**bundle.manifest, **kept}, {**before.files, **bundle.files}
            remarks = before.remarks
        manifest["name"] = revision.name or manifest["name"] or self.opened.name
        # By revision, so that a page never reads one's manifest with another's numbers.
        file = {"file": f"revisions/{revision.number}/field.bin"}
        manifest["tensors"] = {name: {**tensor, **file} for name, tensor in manifest["tensors"].items()}
        shapeless = revision.field is None or revision.field.gain_field.body is None
        if shapeless and self.editor is not None and find_object(self.opened) is None:
            # Points that only fill the space between contacts have no sides, and impacts there no known direction.
            del manifest["tensors"]["normals"]
        made = Shown(manifest, files, sampled, revision, remarks)
        # A page may still be reading the files of the revisions before. A new dict: others read it meanwhile.
        self._shown = dict([*self._shown.items(), (revision.number, made)][-4:])

    def _surface(self, field: SoundField | None) -> Path | Surface | None:
        """Return the surface to show in place of Gaussians or points: the field's body, or the reconstructed surface.

        None if a mesh of the object's own is shown. Like the points, it has the size before all edits.
        """
        shown = find_object(self.opened)
        if field is None or (shown is not None and not holds_gaussians(shown)):
            return find_reconstructed(self.opened)
        return field.gain_field.fitted.surface or find_reconstructed(self.opened)

    def _sampled(self, revision: Revision) -> SampledField:
        """Return a revision's table: that of the one before, changed, where the field is the same."""
        field = revision.field
        if field is None:
            points, normals = self._clickable()
            nothing = torch.zeros(len(points), 0, dtype=torch.complex64)
            empty = torch.zeros(0, dtype=torch.float64)
            name = self.opened.name
            return SampledField(points, normals, empty, empty, nothing, torch.zeros(0), 48_000.0, name=name)
        if not self._is_other_field(revision):
            before = self.current
            assert before.revision.field is not None
            found = resample(before.sampled, before.revision.field, field)
            return sample(field, before.sampled.points, before.sampled.normals) if found is None else found
        sampled = SampledField.of(field, _thinned(points_on_object(field.gain_field), MAX_POINTS))
        return replace(sampled, points=(sampled.points.double() / field.gain_field.length).float(), box=None)

    def _is_other_field(self, revision: Revision) -> bool:
        """Whether a revision is of another field than the one shown before it, or of the first."""
        return not self._shown or self.current.revision.opening != revision.opening

    def _clickable(self) -> tuple[Float32[Tensor, "points 3"], Float32[Tensor, "points 3"]]:
        """Return points of the object, and normals, where there is no field. Raises StudioError without geometry."""
        path = find_object(self.opened)
        if path is not None and not holds_gaussians(path):
            return _on_mesh(Surface.read(path, meters=self.meters))
        if path is not None:
            points = read_splats(path).centers
        else:
            impacts = [] if self.editor is None else self.editor.impacts()
            contacts = list(dict.fromkeys(tuple(each["contact"]) for each in impacts if each["digest"]))
            if len(contacts) >= 2:
                points = FeatureField.from_contacts(torch.tensor(contacts, dtype=torch.float64)).points
            else:
                # Until the capture's pictures have become something to click.
                points = torch.zeros(0 if self.opened.capture is None else 1, 3)
        if not len(points):
            advice = f"give a mesh or Gaussians of {self.opened.name} by --object"
            raise StudioError.expected("its geometry", name="object", advice=advice)
        points = _thinned(points.float(), _MAX_OBJECT_POINTS)
        return points, outward_normals(points)

    def _strikes(self, field: SoundField | None) -> tuple[Impacts | None, tuple[str, ...]]:
        """Return the capture's impacts, each from its own onset, or the reason why they cannot be compared."""
        if field is None or self.opened.capture is None:
            return None, ()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", CaptureWarning)
                settings = self.opened.settings.starting(field.origin.settings.time_zero)
                impacts = read_capture(self.opened.capture, settings).impacts
        except CaptureError as error:
            return None, (f"recorded impacts are not shown: {error}",)
        if impacts.sample_rate != field.sample_rate:
            found = f"expected the field's {field.sample_rate:g} Hz, got {impacts.sample_rate:g} Hz"
            return None, (f"recorded impacts are not shown: {found}",)
        return impacts, ()


def _on_mesh(surface: Surface) -> tuple[Float32[Tensor, "points 3"], Float32[Tensor, "points 3"]]:
    """Return points on a mesh, its vertices if it has no faces, and normals, outward on average."""
    mesh = trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy())
    if not len(surface.faces) or not mesh.area > 0:
        points = _thinned(surface.vertices, _MAX_OBJECT_POINTS)
        return points, outward_normals(points)
    places, rows = trimesh.sample.sample_surface(mesh, _MAX_OBJECT_POINTS, seed=0)
    points, normals = torch.from_numpy(np.array(places)).float(), torch.from_numpy(mesh.face_normals[rows]).float()
    if not mesh.is_winding_consistent:
        return points, outward_normals(points)
    outwards = float((normals * (points - points.mean(0))).sum())
    return points, normals if outwards > 0 else -normals


def _thinned(points: Float[Tensor, "points 3"], most: int) -> Float[Tensor, "kept 3"]:
    """Return at most so many of the points, by chance that is always the same: the farthest of all take minutes."""
    if len(points) <= most:
        return points
    return points[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:most].sort().values]


def sample(field: SoundField, points: Float[Tensor, "points 3"], normals: Float[Tensor, "points 3"]) -> SampledField:
    """Return the table of a field at points of the object that it was fitted to, meters."""
    sampled = SampledField.of(field, points.double() * field.gain_field.length, normals)
    return replace(sampled, points=points, box=None)


def resample(sampled: SampledField, before: SoundField, after: SoundField) -> SampledField | None:
    """Return the table of the field `after` an edit from that of the field `before`.

    None if that is not possible: for another fitted field, phase, a mode that was inaudible or muted, or none left.
    """
    if before.gain_field.fitted is not after.gain_field.fitted or not torch.equal(before.phase, after.phase):
        return None
    old, new = before.scale, after.scale
    if not bool(after.audible.any()) or bool((after.audible & (~before.audible | ((old == 0) & (new != 0)))).any()):
        return None
    audible = torch.nonzero(after.audible).flatten()
    columns = (torch.cumsum(before.audible.long(), 0) - 1)[audible]
    factor = torch.where(old[audible] == 0, 0.0, new[audible] / old[audible])
    change = after.bank.damping[audible] / before.bank.damping[audible]
    return replace(
        sampled,
        frequency=after.bank.frequency[audible],
        damping=sampled.damping[..., columns] * change,
        gains=(sampled.gains[:, columns] * factor).to(torch.complex64),
        supporting=supporting_columns(after),
        name=after.origin.capture,
    )
