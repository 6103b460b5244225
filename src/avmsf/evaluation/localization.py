"""Localization as an experiment of `evaluate`: how far off methods locate recordings, and the maps of some of them."""

from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf._utils.headers import FileKind
from avmsf._utils.tensor_files import read_tensors, write_tensors
from avmsf.baselines.diffsound.renderer import DiffSound
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError, LocationError
from avmsf.evaluation.simple_methods import NearestRecording
from avmsf.evaluation.task import Renderer
from avmsf.field.sound_field import SoundField
from avmsf.localization.contact_map import ContactPosterior
from avmsf.localization.locator import Locator
from avmsf.mesh.points import farthest_points
from avmsf.modal.config import scaled_fft_size
from avmsf.modal.extraction.stft import ShortTime
from avmsf.modal.spectra import magnitude_stft

CANDIDATES = 2000
"""Candidate points: 2 % of the diagonal apart, which is less than the smallest errors."""
MAX_VERTICES = 20_000
"""Vertices of a mesh that DiffSound searches, at most; of more, evenly spaced rows. The archive of ObjectFolder Real's
meshes is called mesh_16k."""
_FFT_SIZE = 4096
"""Samples of a Hann window at 44.1 and 48 kHz: its bins part modes some twenty hertz apart."""
_RENDERED = 64
"""Points whose sounds are held at once."""
_POWER_FLOOR = 1e-6
"""Power over the loudest bin's below which differences do not count: -60 dB."""
_MAP = FileKind(
    "avmsf-contact-map", "the map of a contact", "delete the object's file to compute it again", EvaluationError
)


Sound = Float[Tensor, " samples"]
_Find = Callable[[Sound], tuple[dict[str, Float64[Tensor, " 3"]], ContactPosterior | None]]
"""Returns where a sound comes from, by the names of the errors, and the map of a field."""


def located(
    renderer: Renderer,
    train: Impacts,
    test: Impacts,
    points: Float[Tensor, "points 3"],
    *,
    vertices: Float[Tensor, "vertices 3"] | None = None,
    published: bool = False,
    map_rows: Collection[int] = (),
) -> tuple[dict[str, tuple[float, ...]], dict[int, ContactPosterior]]:
    """Locate each recording of `test` by a method, among `CANDIDATES` of the object's points.

    Returns distances from the true contacts over the diagonal of the object's points, a value for each recording, and
    the maps of a field for those recordings of the rows `map_rows` that could be located. `rmed` is taken at the point
    of least cosine distance between gains (the paper), of fields and DiffSound, or at the contact of the training
    recording with the most similar spectrum, of the nearest recording; `rmed_posterior` at the most probable point, of
    fields. What a method cannot locate counts as a random point.

    DiffSound searches the `vertices` of the object's mesh where they are given, as in the paper. With `published`,
    `rmed` of a field is that of `published_distance`; otherwise its gains are compared at the best delay and without
    their expected noise.
    """
    points = points[farthest_points(points, min(CANDIDATES, len(points)))].double()
    diagonal = float((points.amax(0) - points.amin(0)).norm())
    find, maps = _finder(renderer, train, points, vertices, published), {}
    errors: dict[str, list[float]] = {"rmed": []}
    if isinstance(renderer, SoundField):
        errors["rmed_posterior"] = []
    for row, (sound, truth) in enumerate(zip(test.sounds, test.contacts.double(), strict=True)):
        try:
            positions, found = find(sound)
        except (LocationError, EvaluationError):
            positions, found = {}, None
        # How far a point drawn evenly from the object's is expected to be.
        chance = float((points - truth).norm(dim=1).mean())
        for name, values in errors.items():
            values.append((float((truth - positions[name]).norm()) if name in positions else chance) / diagonal)
        if found is not None and row in map_rows:
            maps[row] = found
    return {name: tuple(values) for name, values in errors.items()}, maps


def _finder(
    renderer: Renderer,
    train: Impacts,
    points: Float64[Tensor, "points 3"],
    vertices: Float[Tensor, "vertices 3"] | None,
    published: bool,
) -> _Find:
    """Return what locates a sound by a method; nothing for methods that cannot."""
    if isinstance(renderer, SoundField):
        return _field_finder(renderer, points, published)
    if isinstance(renderer, DiffSound):
        searched = points
        if vertices is not None:
            rows = torch.linspace(0, len(vertices) - 1, min(MAX_VERTICES, len(vertices)), dtype=torch.float64)
            searched = vertices.double()[rows.round().long()]
        gains = renderer.gains(searched)
        return lambda sound: ({"rmed": searched[int(renderer.distance(gains, sound).argmin())]}, None)
    if isinstance(renderer, NearestRecording):
        nearest = nearest_spectrum(train)
        return lambda sound: ({"rmed": train.contacts[nearest(sound)].double()}, None)
    return lambda sound: ({}, None)


def _field_finder(field: SoundField, points: Float64[Tensor, "points 3"], published: bool) -> _Find:
    locator = Locator.of(field, points=points)
    gains = rendered_gains(field, points) if published else None

    def find(sound: Sound) -> tuple[dict[str, Float64[Tensor, " 3"]], ContactPosterior | None]:
        distance = None if gains is None else published_distance(field, gains, sound)
        try:
            found = locator.locate(sound)
        except LocationError:
            # Eq. 15 knows no recording that is too noisy.
            return {} if distance is None else {"rmed": points[int(distance.argmin())]}, None
        if distance is not None:
            found = replace(found, distance=distance)
        return {"rmed": points[found.best], "rmed_posterior": found.position.double()}, found

    return find


def published_distance(
    field: SoundField, gains: Float64[Tensor, "points modes"], sound: Float[Tensor, " samples"]
) -> Float64[Tensor, " points"]:
    """Return the cosine distance, 0 to 1, of `rendered_gains` at points from a sound's (eq. 15); 1 without gains.

    The sound starts where the field's training sounds do and has their sample rate. Raises LocationError where no mode
    of the field is found in it.
    """
    recorded = _regressed(field, sound.detach().cpu()[None, : field.samples])[0]
    if not bool(recorded.any()):
        advice = "record the impact louder, or with less noise"
        raise LocationError.expected("one of the field's modes", name="sound", advice=advice)
    return 1.0 - torch.nn.functional.cosine_similarity(gains, recorded[None], dim=1)


def rendered_gains(field: SoundField, points: Float[Tensor, "points 3"]) -> Float64[Tensor, "points modes"]:
    """Return the gains that the paper's regression (eq. 5) finds in the sounds that a field renders at points.

    A recording's gains are found in this way too: at the bins of the field's own frequencies, not negative. What a
    network is trained to output instead has signs that its loss does not see, and counts neighbors in one bin apart.
    """
    return torch.cat(
        [_regressed(field, field.render(each, noise=False)) for each in torch.split(points.float(), _RENDERED)]
    )


def _regressed(field: SoundField, sounds: Float[Tensor, "contacts samples"]) -> Float64[Tensor, "contacts modes"]:
    return ShortTime().gains(sounds, field.bank, field.sample_rate)


def nearest_spectrum(train: Impacts) -> Callable[[Sound], int]:
    """Return what finds the row of the training recording with the most similar spectrum, independent of level.

    Training recordings that are silent are never the nearest. It raises EvaluationError for a sound that is silent.
    """
    signatures = torch.stack([_signature(sound, train.sample_rate) for sound in train.sounds])

    def row(sound: Sound) -> int:
        if not bool(sound.any()):
            raise EvaluationError.expected("a recording", 0.0, got="silence", name="sound", advice="omit it")
        similarity = signatures @ _signature(sound, train.sample_rate)
        return int(torch.where(train.sounds.any(dim=1), similarity, -torch.inf).argmax())

    return row


def _signature(sound: Sound, sample_rate: float) -> Float64[Tensor, " bins"]:
    """Return the log of the mean power spectrum, of mean zero and norm one; 0 for silence."""
    size = scaled_fft_size(_FFT_SIZE, sample_rate=sample_rate)
    padded = torch.nn.functional.pad(sound.double(), (0, max(0, size - len(sound))))
    power = magnitude_stft(padded[None], fft_size=size, hop=size // 4)[0].square().mean(dim=1)
    if not float(power.max()) > 0.0:
        return torch.zeros_like(power)
    level = torch.log(power.clamp_min(_POWER_FLOOR * float(power.max())))
    centered = level - level.mean()
    return centered / centered.norm().clamp_min(torch.finfo(torch.float64).tiny)


def write_map(path: Path, found: ContactPosterior, *, truth: Float[Tensor, " 3"]) -> None:
    """Write a map, and the true contact (meters). Raises EvaluationError where that cannot be."""
    tensors = {"points": found.points, "distance": found.distance, "probability": found.probability, "truth": truth}
    energies = torch.tensor([found.explained_energy, found.modal_energy, found.null_energy], dtype=torch.float64)
    write_tensors(path, {**tensors, "energies": energies}, "1", _MAP)


def read_map(path: Path) -> tuple[ContactPosterior, Float[Tensor, " 3"]]:
    """Return a map that `write_map` wrote, and the true contact. Raises EvaluationError where there is none."""
    _, tensors = read_tensors(path, _MAP)
    try:
        truth, energies = tensors.pop("truth"), tensors.pop("energies").tolist()
        return ContactPosterior(tensors["points"], tensors["distance"], tensors["probability"], *energies), truth
    except (KeyError, TypeError) as error:
        raise _MAP.damaged(path, error) from error
