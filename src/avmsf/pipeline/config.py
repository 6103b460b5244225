"""One configuration for the whole way from views and recordings to a field, and the presets.

Importing this imports nothing that computes.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from avmsf.errors import SceneError, SimulationError
from avmsf.field.config import PAPER, FitConfig, GainModel
from avmsf.modal.config import ExtractionMethod
from avmsf.scene.splatconfig import SplatConfig

Preset = Literal["default", "paper"]
TimeZero = Literal["onset", "peak"]
Geometry = Literal["mesh", "gaussians", "noisy"]
DINO = "facebook/dinov2-base"
DESCRIPTORS = "descriptors"
AUTO = "auto"
CACHE = ".avmsf"
"""Folder inside a capture folder that keeps the outputs of the stages."""


@dataclass(frozen=True)
class ViewsConfig:
    """How views are made of what a folder holds."""

    source: Literal["best", "mesh"] = "best"
    """What shows the object: the best of what the folder holds, photographs with cameras before a mesh, or its mesh."""
    count: int = 0
    """Views to use at most, of cameras as far apart as they stand; 0 uses all."""
    longest: int = 640
    """Pixels of a photograph's longer side; larger ones are scaled down."""
    masks: bool = True
    """Whether photographs without masks get them, which needs a plain background."""
    frames: int = 72
    """Frames to pick from a video."""
    rendered: int = 256
    """Pixels along each side of the 72 pictures that are rendered of a mesh."""
    minutes: float = 30.0
    """Time that structure from motion may take."""
    seed: int = 0
    """Start of the chance in structure from motion."""

    def __post_init__(self) -> None:
        if self.count < 0:
            raise SceneError(f"count = {self.count}: expected 0 for all views, or how many to use")


@dataclass(frozen=True)
class LiftConfig:
    """Settings of the features."""

    encoder: str = AUTO
    """What describes the images: the name of a DINOv2 model (such as facebook/dinov2-base), a folder that holds one,
    `descriptors` (built in, no download), or `auto`: DINOv2 base where it is to be had, else the built-in ones."""
    longest: int = 518
    """Pixels of an image's longer side as DINOv2 sees it."""
    background: Literal["inpainted", "kept"] = "inpainted"
    """What the encoder sees outside an object's mask: the object's colors carried on, or the image as it is (paper)."""
    weighting: Literal["plain", "visibility"] = "visibility"
    """How the views that see a point are averaged: by how well they see it, or plainly (paper)."""
    components: int = 32
    """Principal components of the features to keep; 0 keeps the features as they are."""
    symmetry: bool = True
    """Whether features are made alike where the object's symmetries make its shape alike."""
    missing: float = 0.1
    """Part of the object's surface that may have its counterpart in a hole of the points, for a symmetry to count: more
    where large parts of the object were not seen, up to .45."""
    iterations: int = 3
    """How often features are pooled over the symmetries (paper: T)."""
    angles: int = 36
    """Angles that stand for all of a continuous rotation (paper: the size of Theta)."""
    reach: float = 3.0
    """Point spacings within which the nearest point is a symmetric counterpart; 0 takes it at any distance (paper)."""
    positions: bool = True
    """Whether the points' positions, relative to the object's size, stand before the features."""
    size: float = 0.3
    """Root mean square length of the features beside positions, which are about .5 long; alone they have length 1."""
    onto: Literal["mesh", "gaussians"] = "mesh"
    """What is the object where a folder shows a mesh alone: its own surface, or Gaussians fitted to pictures of it."""
    points: int = 8192
    """Points of a mesh whose own surface is the object."""
    seed: int = 0
    """Start of all chance: which points of a mesh, which of them the search for symmetries looks at."""

    def __post_init__(self) -> None:
        for name, least in {"longest": 1, "components": 0, "iterations": 1, "angles": 2, "points": 100}.items():
            if getattr(self, name) < least:
                raise SceneError(f"{name} = {getattr(self, name)}: expected {least} or more")
        if not 0 <= self.missing <= 0.45:
            raise SceneError(f"missing = {self.missing}: expected 0 to 0.45")
        if not 0 <= self.reach < math.inf:
            raise SceneError(f"reach = {self.reach}: expected a number of point spacings, or 0 for any distance")
        if not 0 < self.size < math.inf:
            raise SceneError(f"size = {self.size}: expected more than 0")


@dataclass(frozen=True)
class BodyConfig:
    """How an object's shape becomes bodies that vibrate."""

    wall: float | None = None
    """Thickness of the object's wall, meters, where it is known; 0 for a body that its surface encloses whole. By
    itself it tries several, and the recordings choose."""
    shapes: int = 80
    """Lowest elastic mode shapes that gains are made of, and on which stiffness and density are updated."""
    freedoms: int = 40_000
    """Degrees of freedom of the finite elements, about."""
    supports: Literal["auto", "free", "try"] = "auto"
    """Whether the object may have been held at its lowest face or point, or along a lower edge (z is upwards). auto:
    tried if the free body predicts recordings left out little better than no body. free: it lay on foam or hung. try:
    always tried, which takes 10 to 30 s more."""

    def __post_init__(self) -> None:
        if self.wall is not None and not 0 <= self.wall < float("inf"):
            raise SimulationError(f"wall = {self.wall}: expected meters, or 0 for a body without a cavity")
        if self.shapes < 1:
            raise SimulationError(f"shapes = {self.shapes}: expected 1 or more")


@dataclass(frozen=True)
class SceneConfig:
    """Settings of all stages up to the features."""

    views: ViewsConfig = field(default_factory=ViewsConfig)
    """How views are made of what the folder holds."""
    splat: SplatConfig = field(default_factory=SplatConfig)
    """How Gaussians are fitted to views."""
    lift: LiftConfig = field(default_factory=LiftConfig)
    """How features are made of views and Gaussians."""


@dataclass(frozen=True)
class PipelineConfig:
    """Settings of all stages."""

    gain_model: GainModel = "auto"
    """How gains vary over the object."""
    body: BodyConfig = field(default_factory=BodyConfig)
    """How the object's shape becomes bodies that vibrate."""
    scene: SceneConfig = field(default_factory=SceneConfig)
    """How views, Gaussians and features are made."""
    fit: FitConfig = field(default_factory=FitConfig)
    """How the field is fitted."""
    method: ExtractionMethod = "high-resolution"
    """How modes are found."""
    modes: int = 128
    """Most modes to keep."""
    time_zero: TimeZero | None = None
    """Where sounds start; None leaves that to the capture's settings."""
    device: str | None = None
    """What computes: cpu or cuda; None takes the GPU where there is one. Training gives the same up to rounding,
    Gaussians do not; stages that are kept are used whichever device made them."""


PRESETS: Mapping[Preset, PipelineConfig] = {
    "default": PipelineConfig(),
    "paper": PipelineConfig(
        gain_model="network",
        scene=SceneConfig(
            lift=LiftConfig(
                encoder=DINO,
                background="kept",
                weighting="plain",
                components=0,
                reach=0.0,
                positions=False,
                onto="gaussians",
            )
        ),
        fit=PAPER,
        method="short-time",
        time_zero="peak",
    ),
}
"""`paper` has every stage as published, and of each published list the middle value; docs/paper-map.md lists what the
paper leaves open."""
