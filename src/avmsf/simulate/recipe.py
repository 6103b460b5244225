"""All that decides a simulated object, as plain values: the same recipe of a shape gives the same bytes."""

import hashlib
import json
import math
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from avmsf._utils.caching import source_digest
from avmsf.errors import SimulationError
from avmsf.simulate.hammer import Hammer
from avmsf.simulate.imperfections import Imperfections
from avmsf.simulate.material import material_named

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class ObjectRecipe:
    """What an object is, how it is struck and how it is heard and seen."""

    kind: str = "bowl"
    """Shape to make: `avmsf simulate --list` names them."""
    mesh: Path | None = None
    """A mesh or scan to take in place of a shape: obj, ply, glb or stl, in metres."""
    thickness: float | None = None
    """Of the walls, metres. None draws a shape's, and fills a mesh, which is a solid body then; with a thickness its
    surface is the outside of a wall."""
    material: str = "ceramic"
    """Name in the table of materials."""
    seed: int = 0
    """Start of all chance: the shape's proportions, the contacts, the noise, the imperfections."""
    size: float | None = None
    """Longest side of the bounding box, metres; as drawn or as scanned where it is not given."""
    up: Literal["x", "y", "z"] = "z"
    """Axis that points to the sky: a hammer comes from above or from the side."""
    modes: int = 64
    """Lowest elastic modes to compute; those that do not sound below 45 % of the sample rate are left out."""
    detail: float = 0.04
    """Edge of the tetrahedra that fill a mesh, over its diagonal. Shapes bring tetrahedra of their own."""
    contacts: int = 40
    """Blows."""
    sample_rate: int = 48000
    """Hz."""
    seconds: float = 2.0
    """Length of what is kept of each recording, from its onset on. The files also hold what is before and after it."""
    noise_db: float | None = -30.0
    """Room noise: its root mean square over that of the noiseless sounds from their impacts on, dB; None for none."""
    microphone: tuple[float, float, float] = (0.45, -0.35, 0.4)
    """Where it stands, from the middle of the object's bounding box, metres."""
    views: int = 72
    """Pictures to render, on three circles around the object; 0 for none."""
    view_size: int = 256
    """Pixels along each side of a picture."""
    surface: bool = True
    """Whether the folder holds the object's mesh; without it, the shape has to be found in the pictures."""
    hammer: Hammer = field(default_factory=Hammer)
    imperfections: Imperfections = field(default_factory=Imperfections)

    def __post_init__(self) -> None:
        material_named(self.material)
        for name, least, most in (
            ("contacts", 2, 100_000),
            ("modes", 1, 1000),
            ("sample_rate", 1000, 1_000_000),
            ("seconds", 0.02, 60.0),
            ("view_size", 16, 8192),
            ("detail", 0.005, 0.5),
        ):
            value = getattr(self, name)
            if not least <= value <= most:
                raise SimulationError(f"{name} = {value:g}: expected {least:g} to {most:g}")
        for name in ("thickness", "size"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise SimulationError(f"{name} = {value:g} m: expected more than 0")
        if self.noise_db is not None and not -math.inf < self.noise_db < 100.0:
            raise SimulationError(
                f"noise_db = {self.noise_db:g}: expected a level in dB, such as -30, or None for none"
            )
        if self.views < 0 or self.views % 3:
            raise SimulationError(f"views = {self.views}: expected a multiple of 3, for three circles of them, or 0")
        if self.seed < 0:
            raise SimulationError(f"seed = {self.seed}: expected 0 or more")

    def values(self) -> dict[str, Any]:
        """Return all settings as JSON holds them, with the package's version and the digest of the mesh's file."""
        record = asdict(self)
        record["mesh"] = None if self.mesh is None else {"file": self.mesh.name, "sha256": _digest(self.mesh)}
        return json.loads(json.dumps({"version": version("avmsf"), **record}))

    def elastic_values(self) -> dict[str, Any]:
        """Return what decides the elastic modes, which take most of the time: some of `values`, and the code."""
        values = self.values()
        names = ("version", "kind", "mesh", "thickness", "material", "seed", "size", "up")
        kept = {"source": source_digest(), **{name: values[name] for name in names}}
        imperfect = {name: values["imperfections"][name] for name in ("thickness", "stiffness", "density", "support")}
        return {**kept, "modes": self.modes, "detail": self.detail, "imperfections": imperfect}


def key_of(values: dict[str, Any]) -> str:
    """Return a short digest of plain values."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:24]


def _digest(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise SimulationError(f"{path}: the mesh cannot be read ({error.strerror}): check the name") from error
