"""All that decides a simulated object, as plain values: the same recipe of a shape gives the same bytes."""

import hashlib
import json
import math
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from avmsf._utils.caching import source_digest
from avmsf.errors import SimulationError
from avmsf.fem.material import material_named
from avmsf.modal.config import MAX_CONTACT_SECONDS

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def _expect(fits: object, wanted: str, value: object, name: str) -> None:
    if not fits:
        raise SimulationError.expected(wanted, value, name=name)


@dataclass(frozen=True)
class Hammer:
    """The hammer; by default a small steel one with a round tip."""

    mass: float = 0.02
    """Of its head, kilograms."""
    radius: float = 0.003
    """Of its tip, meters."""
    young: float = 2e11
    """Young's modulus of its tip, pascals: 2e11 is steel, 3e9 a hard plastic, 1e7 rubber."""
    poisson: float = 0.29
    """Poisson's ratio of its tip."""
    speed: float = 0.5
    """Speed at impact, meters per second."""
    pulse: Literal["hertz", "half-sine"] = "hertz"
    """hertz: a round tip; half-sine: a flat one."""
    contact_time: float = 0.0
    """Duration of the contact at `speed`, seconds; 0 computes it from the above."""

    def __post_init__(self) -> None:
        for name, unit in (("mass", "kg"), ("radius", "m"), ("young", "Pa"), ("speed", "m/s")):
            value = getattr(self, name)
            _expect(0 < value < math.inf, f"more than 0 {unit}", value, f"hammer.{name}")
        _expect(-1 < self.poisson < 0.5, "more than -1 and less than .5", self.poisson, "hammer.poisson")
        wanted = f"0 to compute it, or up to {MAX_CONTACT_SECONDS:g} s"
        _expect(0 <= self.contact_time <= MAX_CONTACT_SECONDS, wanted, self.contact_time, "hammer.contact_time")


@dataclass(frozen=True)
class Imperfections:
    """Deviations of the object and its recordings from the ideal; 0 switches each off."""

    thickness: float = 0.03
    """Variation of the wall thickness, root mean square over its mean."""
    stiffness: float = 0.05
    """Variation of Young's modulus over the body, root mean square of its logarithm."""
    density: float = 0.02
    """Variation of the density over the body, root mean square of its logarithm."""
    support: float = 15.0
    """Resonance frequency of the object on three soft springs under it, Hz."""
    support_damping: float = 0.015
    """Damping ratio of that resonance."""
    coupling: float = 0.2
    """Part of the damping that is localized and so couples modes, 0 to 1."""
    retardation: float = 1.0
    """Factor on the differences of delay from the body's parts to the microphone, 0 to 1."""
    contact: float = 0.0015
    """Distance along the surface from the recorded contact to the true one, meters, root mean square."""
    direction: float = 5.0
    """Angle between the recorded direction of the impact and the true one, degrees, root mean square."""
    force: float = 0.02
    """Relative error of the recorded peak force, root mean square."""
    speed: float = 0.3
    """Variation of the impacts' speeds, root mean square of their logarithm.

    The peak forces of 74 impacts by hand (the aircraft test of the benchmarks) vary by .37, 3.2 dB, with a range of 16
    dB. By Hertz's law force goes with speed to the power 6/5, so speeds vary by .31.
    """
    contact_time: float = 0.1
    """Variation of the contact times that does not follow from the speeds, root mean square of their logarithm.

    The hand adds mass to the hammer, and the tip is inclined to the surface. In 31 impacts by hand on ceramic,
    wood, polycarbonate and steel (the recordings published with DiffImpact, Clarke et al. 2021) the pulses' widths
    depart from Hertz's law by .11.
    """
    pretrigger: float = 0.05
    """Time from the start of a recording to the arrival of the impact's sound, seconds; the next two add to it."""
    jitter: float = 0.001
    """Variation of that time from recording to recording, seconds, root mean square.

    A recorder's clock is not locked to the impact: at 48 kHz the default is 48 samples, so the fraction of a sample at
    which a sound starts is uniformly random.
    """
    sensor: float = 0.0
    """Mass of a sensor that is moved with the contact, over the object's: shifts each mode's frequency."""
    warming: float = 0.0
    """Relative fall of all frequencies from the first recording to the last, as of a body that gets warmer."""
    propagation: float = 1.0
    """Factor on the delay of the recordings by the travel of sound from the object's nearest point to the microphone,
    0 to 1."""

    def __post_init__(self) -> None:
        highest = {
            "coupling": 1.0, "retardation": 1.0, "contact": 1.0, "direction": 45.0, "support": math.inf,
            "pretrigger": 10.0, "propagation": 1.0,
        }  # fmt: skip
        for each in fields(self):
            value, most = getattr(self, each.name), highest.get(each.name, 0.5)
            limit = f"up to {most:g}" if math.isfinite(most) else "a finite number above 0"
            fits = 0 <= value <= most and math.isfinite(value)
            _expect(fits, f"0 to switch it off, or {limit}", value, f"imperfections.{each.name}")

    @classmethod
    def none(cls) -> "Imperfections":
        """Return the record with everything switched off; sound travels from all parts of the body with its delay.

        Every recording then starts with the sound of its impact.
        """
        return replace(cls(**{each.name: 0.0 for each in fields(cls)}), retardation=1.0)


@dataclass(frozen=True)
class ObjectRecipe:
    """An object, its impacts, recordings and images."""

    kind: str = "bowl"
    """Shape: `avmsf simulate --list` names them."""
    mesh: Path | None = None
    """A mesh or scan instead of a shape: obj, ply, glb or stl, in meters."""
    thickness: float | None = None
    """Wall thickness, meters. By default that of a shape is drawn at random, and a mesh is a solid body; with a
    thickness the mesh is the outside of a wall."""
    material: str = "ceramic"
    """Name in the table of materials."""
    seed: int = 0
    """Random seed of the shape's proportions, the contacts, the noise and the imperfections."""
    size: float | None = None
    """Longest side of the bounding box, meters; by default that of the random shape or of the mesh."""
    up: Literal["x", "y", "z"] = "z"
    """Upward axis: the hammer comes from above or from the side."""
    elastic_modes: int = 64
    """Number of elastic modes to compute, the lowest; those above 45 % of the sample rate are left out."""
    detail: float = 0.04
    """Edge length of the tetrahedra in a mesh, over its diagonal. Shapes have tetrahedra of their own."""
    impacts: int = 40
    """Number of impacts."""
    sample_rate: int = 48000
    """Sample rate, Hz."""
    seconds: float = 2.0
    """Length of each recording that is used, from its onset. The files are longer."""
    noise_db: float | None = -30.0
    """Room noise: its root mean square over that of the noiseless sounds after the impacts, dB; None for no noise."""
    microphone: tuple[float, float, float] = (0.45, -0.35, 0.4)
    """Position of the microphone from the center of the object's bounding box, meters."""
    views: int = 72
    """Images to render, on three circles around the object; 0 for none."""
    view_size: int = 256
    """Pixels along each side of an image."""
    surface: bool = True
    """Write the object's mesh; without it, the shape has to be reconstructed from the images."""
    hammer: Hammer = field(default_factory=Hammer)
    imperfections: Imperfections = field(default_factory=Imperfections)

    def __post_init__(self) -> None:
        material_named(self.material)
        for name, least, most in (
            ("impacts", 2, 100_000),
            ("elastic_modes", 1, 1000),
            ("sample_rate", 1000, 1_000_000),
            ("seconds", 0.02, 60.0),
            ("view_size", 16, 8192),
            ("detail", 0.005, 0.5),
        ):
            value = getattr(self, name)
            _expect(least <= value <= most, f"{least:g} to {most:g}", value, name)
        for name in ("thickness", "size"):
            value = getattr(self, name)
            _expect(value is None or 0 < value <= 100.0, "more than 0 and at most 100 m", value, name)
        fits = self.noise_db is None or -math.inf < self.noise_db < 100.0
        _expect(fits, "a level in dB, such as -30, or None for none", self.noise_db, "noise_db")
        circled = self.views >= 0 and not self.views % 3
        _expect(circled, "a multiple of 3, for three circles, or 0", self.views, "views")
        _expect(self.seed >= 0, "0 or more", self.seed, "seed")

    def values(self) -> dict[str, Any]:
        """Return all settings as JSON holds them, with the package's version and the digest of the mesh's file."""
        record = asdict(self)
        record["mesh"] = None if self.mesh is None else {"file": self.mesh.name, "sha256": _digest(self.mesh)}
        return json.loads(json.dumps({"version": version("avmsf"), **record}))

    def elastic_values(self) -> dict[str, Any]:
        """Return what decides the elastic modes, which take most of the time: some of `values`, and the code."""
        values = self.values()
        names = ("version", "kind", "mesh", "thickness", "material", "seed", "size", "up")
        kept = {"source": source_digest("avmsf.simulate.bodies"), **{name: values[name] for name in names}}
        imperfect = {name: values["imperfections"][name] for name in ("thickness", "stiffness", "density", "support")}
        return {**kept, "modes": self.elastic_modes, "detail": self.detail, "imperfections": imperfect}


def _digest(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise SimulationError.expected("a mesh", error.strerror, file=path, advice="check the name") from error


EXAMPLE = ObjectRecipe(
    kind="mug",
    thickness=0.003,
    seed=1,
    impacts=16,
    sample_rate=44100,
    seconds=1.0,
    noise_db=-40.0,
    views=48,
    view_size=192,
    surface=False,
)
"""`avmsf simulate example` makes it anew; `--set surface=true` adds the mesh."""
EXAMPLE_FOLDER = Path(__file__).parents[1] / "example"
"""The capture folder that the package ships, made of that recipe: recordings and photographs, no mesh."""


SET = "sim-20"
_WALLS = {
    "mug-ceramic": 0.003,
    "skillet-iron": 0.0025,
    "bell-iron": 0.002,
    "tube-steel": 0.0015,
    "jug-ceramic": 0.003,
    "tray-polycarbonate": 0.006,
}
_SIZES = {"blob-polycarbonate": 0.5, "tube-steel": 0.5}
"""Walls and longest sides that differ from what is drawn, meters: where few modes would be heard, or most too low."""


def _recipes(*names: str, seed: int) -> dict[str, ObjectRecipe]:
    """Return recipes by the objects' names, which are kinds and materials; the first has the seed, others the next."""
    return {
        name: ObjectRecipe(kind, material=material, seed=each, size=_SIZES.get(name), thickness=_WALLS.get(name))
        for each, name in enumerate(names, start=seed)
        for kind, material in (name.split("-"),)
    }


SIM20 = _recipes(
    "mug-ceramic", "bowl-glass", "skillet-iron", "plate-ceramic", "spoon-steel", "goblet-glass", "bracket-steel",
    "bell-iron", "blob-polycarbonate", "pot-steel", "dish-ceramic", "fluted-ceramic", "jug-glass", "tray-polycarbonate",
    "mug-plastic", "tube-steel", "spoon-wood", "platter-wood", "jug-ceramic", "bowl-wood", seed=1,
)  # fmt: skip
"""In the order in which they are made."""
ABLATED = ("mug-ceramic", "bowl-glass", "bracket-steel", "pot-steel", "dish-ceramic", "spoon-wood")
"""Objects of the smaller studies: with and without symmetry, ringing and dull, thick and thin."""
HELD_OUT = _recipes("bottle-glass", "lid-ceramic", "boomerang-wood", "channel-steel", "scallop-polycarbonate", seed=101)
"""Objects of kinds that are not in sim-20; docs/benchmarks.md says which settings were chosen on them."""
NON_SYMMETRIC = tuple(
    name
    for name, recipe in (SIM20 | HELD_OUT).items()
    if recipe.kind in ("mug", "skillet", "spoon", "bracket", "blob", "dish", "jug", "boomerang", "scallop")
)
"""Objects whose shape no turn about z carries onto itself; of some a mirror does."""
SETS = {SET: SIM20, "held-out": HELD_OUT}
"""The recipes of the sets of objects by the sets' names."""


def named_recipe(name: str) -> ObjectRecipe:
    """Return the recipe of one of the sets' objects. Raises SimulationError with the names there are."""
    known = SIM20 | HELD_OUT
    if name not in known:
        raise SimulationError.unknown(name, known, name="object")
    return known[name]
