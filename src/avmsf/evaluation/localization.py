"""Localization errors of several methods for each recording, and the coverage of credible regions.

Conventions. Errors are relative to the diagonal of the box around the object's points (`rmed`), once from the true
contact and once from the nearest of its images under the object's symmetries (`rmed_modulo`), for a symmetric object
may sound the same at all of them. The methods:

- `random`: a uniformly distributed point of the object, by its expected error;
- `nearest`: the contact of the training recording with the most similar spectrum;
- `cosine`: the point whose gains have the least cosine distance from the sound's (the paper);
- `diffsound`: the point whose gains, simulated by DiffSound, have the least cosine distance from the sound's; where its
  locator is given;
- `posterior`: the most probable point under the noise and the predictive uncertainty, with a credible region.

A recording that the locator rejects counts as a random point, and its row has the reason.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from jaxtyping import Bool, Float, Float64
from torch import Tensor

from avmsf.baselines.diffsound.locator import DiffSoundLocator
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError, LocationError
from avmsf.evaluation.localization_baselines import NearestSpectrum, random_distance
from avmsf.evaluation.results import write_json
from avmsf.evaluation.symmetric_contacts import Images
from avmsf.localization.contact_map import ContactMap
from avmsf.localization.locator import Locator

METHODS = ("random", "nearest", "cosine", "posterior")
DIFFSOUND = "diffsound"
LEVEL = 0.9
"""Probability of the region whose coverage is evaluated."""


@dataclass(frozen=True)
class StrikeRow:
    """One test recording by one method."""

    recording: str
    method: str
    place: tuple[float, float, float] | None
    """Located contact, meters; None where the error is that of a random point."""
    truth: tuple[float, float, float]
    rmed: float
    rmed_modulo: float
    covered: bool | None = None
    """Whether the region contains the true contact; None for methods without a region."""
    covered_modulo: bool | None = None
    """Whether it contains any of its images."""
    region: float | None = None
    """The region's fraction of the surface, 0 to 1."""
    explained: float | None = None
    """Fraction of the sound's energy that the field explains."""
    refusal: str | None = None
    """Reason why the recording was not located."""


@dataclass(frozen=True)
class LocatingScores:
    """Localization errors of one object's test recordings."""

    name: str
    """Name of the object."""
    rows: tuple[StrikeRow, ...]
    """By recording, then in the order of the methods."""
    diagonal: float
    """Of the box around the object's points, meters."""
    scale: float
    """Size that contact errors are relative to in the ObjectFolder benchmark, meters; by default the diagonal."""
    level: float
    """Probability of the regions."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Seed and settings of the evaluation, as plain values."""

    def figures(self, method: str) -> dict[str, float]:
        """Return a method's means: `rmed`, `rmed_modulo`, `contact_error`, `refused`, the fraction of rejected
        recordings, which count as random points, and, of the regions of the others, `covered`, `covered_modulo` and
        `region`. Raises EvaluationError for a method without rows."""
        rows = [row for row in self.rows if row.method == method]
        if not rows:
            judged = ", ".join(dict.fromkeys(row.method for row in self.rows))
            raise EvaluationError(
                f"{self.name}: expected a method of {judged}, got {method!r}", name="method", value=method
            )
        means = {name: _mean([getattr(row, name) for row in rows]) for name in ("rmed", "rmed_modulo")}
        means["contact_error"] = means["rmed"] * self.diagonal / self.scale
        means["refused"] = _mean([float(row.refusal is not None) for row in rows])
        sure = [row for row in rows if row.region is not None]
        if sure:
            for name in ("covered", "covered_modulo", "region"):
                means[name] = _mean([float(getattr(row, name)) for row in sure])
        return means

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, rows included, and the package's version."""
        methods = dict.fromkeys(row.method for row in self.rows)
        means = {method: self.figures(method) for method in methods}
        return {"version": version("avmsf"), **asdict(self), "means": means}

    def write(self, path: Path) -> None:
        """Write everything as JSON. Raises EvaluationError where that cannot be."""
        write_json(path, self.to_dict())


def judge_locating(
    locator: Locator,
    train: Impacts,
    test: Impacts,
    *,
    name: str,
    images: Images | None = None,
    truth: Float[Tensor, "contacts 3"] | None = None,
    methods: Sequence[str] = METHODS,
    diffsound: DiffSoundLocator | None = None,
    level: float = LEVEL,
    scale: float | None = None,
    settings: Mapping[str, Any] | None = None,
) -> LocatingScores:
    """Locate every recording of `test` by every method and compute the errors.

    `images` are those of the object's symmetries; `truth` are the true contacts, meters, if known better than by the
    recordings' table; `diffsound` is needed for the method of this name; contact errors are relative to `scale`,
    meters, by default the diagonal.
    Raises EvaluationError for unknown methods, sounds at another rate than the field's, and objects without a size.
    """
    known = METHODS if diffsound is None else (*METHODS, DIFFSOUND)
    unknown = [method for method in methods if method not in known]
    if unknown or not methods:
        raise EvaluationError(
            f"expected methods of {', '.join(known)}, got {', '.join(unknown) or 'none'}",
            name="methods",
            value=tuple(unknown),
        )
    if test.sample_rate != locator.field.sample_rate:
        raise EvaluationError(
            f"{name}: expected recordings at the field's {locator.field.sample_rate:g} Hz, got {test.sample_rate:g} Hz",
            name="sample_rate",
            value=test.sample_rate,
        )
    if truth is not None and len(truth) != len(test):
        raise EvaluationError(
            f"{name}: expected a true contact for each of {len(test)} recordings, got {len(truth)}",
            name="truth",
            value=len(truth),
        )
    right = test.contacts if truth is None else truth
    ground = Ground(locator.points.double(), Images.none() if images is None else images, level)
    size = ground.diagonal if scale is None else scale
    if not (ground.diagonal > 0.0 and math.isfinite(size) and size > 0.0):
        raise EvaluationError(
            f"{name}: expected a positive diagonal and scale, got {ground.diagonal:g} m and {size:g} m",
            name="scale",
            value=(ground.diagonal, size),
        )
    alike = NearestSpectrum(train)
    rows: list[StrikeRow] = []
    for row in sorted(range(len(test)), key=lambda each: test.names[each]):
        sound, place = test.sounds[row], right[row].double()
        rows += _located(
            locator, alike, ground, sound, place, name=test.names[row], methods=methods, diffsound=diffsound
        )
    return LocatingScores(name, tuple(rows), ground.diagonal, size, level, dict(settings or {}))


@dataclass(frozen=True, eq=False)
class Ground:
    """An object's points, and what is as right as a true place."""

    points: Float64[Tensor, "points 3"]
    """Object frame, meters."""
    images: Images
    level: float
    """Probability of regions."""

    @property
    def diagonal(self) -> float:
        """Of the box around the points, meters."""
        return float((self.points.amax(0) - self.points.amin(0)).norm())

    def errors(self, place: Float64[Tensor, " 3"], truth: Float64[Tensor, " 3"]) -> tuple[float, float]:
        """Return `rmed` and `rmed_modulo` of a place."""
        apart = (self.images.at(truth) - place).norm(dim=1)
        return float((truth - place).norm()) / self.diagonal, float(apart.min()) / self.diagonal

    def random_errors(self, truth: Float64[Tensor, " 3"]) -> tuple[float, float]:
        """Return what is expected of both for a point drawn evenly."""
        return (
            random_distance(self.points, truth[None]) / self.diagonal,
            random_distance(self.points, self.images.at(truth)) / self.diagonal,
        )

    def holds(self, region: Bool[Tensor, " points"], place: Float64[Tensor, " 3"]) -> bool:
        """Return whether the point nearest to a place is in the region."""
        return bool(region[(self.points - place).norm(dim=1).argmin()])


def _located(
    locator: Locator,
    alike: NearestSpectrum,
    ground: Ground,
    sound: Float[Tensor, " samples"],
    truth: Float64[Tensor, " 3"],
    *,
    name: str,
    methods: Sequence[str],
    diffsound: DiffSoundLocator | None,
) -> list[StrikeRow]:
    """Return one strike's rows."""
    found: ContactMap | LocationError | None = None
    if {"cosine", "posterior"} & set(methods):
        try:
            found = locator.locate(sound)
        except LocationError as error:
            found = error
    rows = []
    for method in methods:
        place: Float64[Tensor, " 3"] | None = None
        more: dict[str, Any] = {}
        if method == "nearest":
            if bool(sound.any()):
                place = alike.place(sound)
            else:
                more = {"refusal": "the recording is silent"}
        elif method == DIFFSOUND and diffsound is not None:
            try:
                place = diffsound.place(sound)
            except LocationError as error:
                more = {"refusal": " ".join(str(error).split())}
        elif method != "random" and isinstance(found, ContactMap):
            place = ground.points[int(found.distance.argmin())] if method == "cosine" else found.position.double()
            more = {"explained": found.explained_energy}
            more |= _regions(found, ground, truth) if method == "posterior" else {}
        elif method != "random":
            more = {"refusal": " ".join(str(found).split())}
        errors = ground.random_errors(truth) if place is None else ground.errors(place, truth)
        there = None if place is None else _plain(place)
        rows.append(StrikeRow(name, method, there, _plain(truth), *errors, **more))
    return rows


def _regions(found: ContactMap, ground: Ground, truth: Float64[Tensor, " 3"]) -> dict[str, Any]:
    region = found.region(ground.level)
    inside = [ground.holds(region, image) for image in ground.images.at(truth)]
    return {"covered": inside[0], "covered_modulo": any(inside), "region": float(region.double().mean())}


def _plain(place: Float64[Tensor, " 3"]) -> tuple[float, float, float]:
    across, along, up = place.tolist()
    return across, along, up


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
