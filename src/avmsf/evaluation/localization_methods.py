"""Localization as an experiment of `evaluate`: how far off methods locate recordings, and the maps of some of them."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.baselines.diffsound.locator import DiffSoundLocator
from avmsf.baselines.diffsound.renderer import DiffSound
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError, LocationError
from avmsf.evaluation.localization import LEVEL, Ground
from avmsf.evaluation.localization_baselines import NearestSpectrum
from avmsf.evaluation.renderer import Renderer
from avmsf.evaluation.simple_methods import NearestRecording
from avmsf.evaluation.symmetric_contacts import Images
from avmsf.field.sound_field import SoundField
from avmsf.gaussians.points import farthest_points
from avmsf.localization.contact_map import ContactMap
from avmsf.localization.locator import Locator
from avmsf.localization.published import PublishedLocator

CANDIDATES = 2000
"""Candidate points: 2 % of the diagonal apart, which is less than the smallest errors."""
MAX_VERTICES = 20_000
"""Vertices of a mesh that DiffSound searches, at most; of more, evenly spaced rows. The archive of ObjectFolder Real's
meshes is called mesh_16k."""


@dataclass(frozen=True, eq=False)
class Located:
    """Where a method locates recordings."""

    errors: Mapping[str, tuple[float, ...]]
    """Distances from the true contacts over the diagonal of the object's points, a value for each recording.

    `rmed`: at the point of least cosine distance between gains (the paper), of fields and DiffSound; at the contact of
    the training recording with the most similar spectrum, of the nearest recording. `rmed_posterior`, of fields: at the
    most probable point. What a method cannot locate counts as a random point, as do all recordings of a method that
    locates nothing.
    """
    maps: Mapping[int, ContactMap] = field(default_factory=dict)
    """Maps of fields by the rows of recordings, of those that were asked for and could be located."""


_Places = tuple[dict[str, Float64[Tensor, " 3"]], ContactMap | None]


def located(
    renderer: Renderer,
    train: Impacts,
    test: Impacts,
    points: Float[Tensor, "points 3"],
    *,
    vertices: Float[Tensor, "vertices 3"] | None = None,
    published: bool = False,
    kept: Collection[int] = (),
) -> Located:
    """Locate each recording of `test` by a method, among `CANDIDATES` of the object's points.

    DiffSound searches the `vertices` of the object's mesh where they are given, as in the paper. With `published`,
    `rmed` of a field is that of `PublishedLocator`; otherwise its gains are compared at the best delay and without
    their expected noise. `kept` are the rows whose maps are returned.
    """
    points = points[farthest_points(points, min(CANDIDATES, len(points)))].double()
    ground = Ground(points, Images.none(), LEVEL)
    if isinstance(renderer, SoundField):
        find = _by_field(renderer, points, published)
    else:
        find = _finder(renderer, train, points if vertices is None else _fewer(vertices.double()))
    names = ("rmed", "rmed_posterior") if isinstance(renderer, SoundField) else ("rmed",)
    rows, maps = [], {}
    for row, (sound, truth) in enumerate(zip(test.sounds, test.contacts.double(), strict=True)):
        try:
            places, found = find(sound)
        except (LocationError, EvaluationError):
            places, found = {}, None
        chance = ground.random_errors(truth)[0]
        rows.append([ground.errors(places[name], truth)[0] if name in places else chance for name in names])
        if found is not None and row in kept:
            maps[row] = found
    return Located({name: tuple(row[number] for row in rows) for number, name in enumerate(names)}, maps)


def _by_field(
    field: SoundField, points: Float64[Tensor, "points 3"], published: bool
) -> Callable[[Float[Tensor, " samples"]], _Places]:
    """Return what locates a sound by a field."""
    locator = Locator.of(field, points=points)
    plain = PublishedLocator.of(field, points) if published else None

    def find(sound: Float[Tensor, " samples"]) -> _Places:
        distance = None if plain is None else plain.distance(sound)
        try:
            found = locator.locate(sound)
        except LocationError:
            # Eq. 15 knows no recording that is too noisy.
            return {} if distance is None else {"rmed": points[int(distance.argmin())]}, None
        if distance is not None:
            found = replace(found, distance=distance)
        return {"rmed": points[found.best], "rmed_posterior": found.position.double()}, found

    return find


def _finder(
    renderer: Renderer, train: Impacts, points: Float64[Tensor, "points 3"]
) -> Callable[[Float[Tensor, " samples"]], _Places]:
    """Return what locates a sound by another method; nothing for methods that cannot."""
    if isinstance(renderer, DiffSound):
        simulated = DiffSoundLocator.of(renderer, points)
        return lambda sound: ({"rmed": simulated.place(sound)}, None)
    if isinstance(renderer, NearestRecording):
        similar = NearestSpectrum(train)
        return lambda sound: ({"rmed": similar.place(sound)}, None)
    return lambda sound: ({}, None)


def _fewer(vertices: Float64[Tensor, "vertices 3"]) -> Float64[Tensor, "points 3"]:
    count = min(MAX_VERTICES, len(vertices))
    return vertices[torch.linspace(0, len(vertices) - 1, count, dtype=torch.float64).round().long()]
