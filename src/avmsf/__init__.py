"""The sound of real objects: from a few taps to a field that sounds right wherever the object is struck."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from avmsf.bench.evaluation import evaluate, split
    from avmsf.capture import Capture, CaptureSettings, Impacts, Surface, check, read_capture, write_capture
    from avmsf.capture.cameras import Camera, View
    from avmsf.capture.views import find_foreground, read_views
    from avmsf.capture.views.write import write_views
    from avmsf.export.bundle import write_bundle
    from avmsf.export.faust import write_faust
    from avmsf.export.gltf import write_gltf
    from avmsf.export.modaldemo import read_demo, write_demo
    from avmsf.export.sampledfield import SampledField
    from avmsf.export.universal import write_universal
    from avmsf.export.wavgrid import write_grid
    from avmsf.export.webpage import write_webpage
    from avmsf.field.config import PAPER, FitConfig
    from avmsf.field.fit import fit
    from avmsf.field.gains.bodies import CandidateBodies
    from avmsf.field.gains.estimator import MixtureEstimator
    from avmsf.field.recipes import Attention
    from avmsf.field.soundfield import SoundField
    from avmsf.field.store import load, save
    from avmsf.field.suggest import suggest
    from avmsf.modal.bank import ModalBank
    from avmsf.modal.extraction.extract import Extraction, extract
    from avmsf.modal.extraction.finders import HighResolution, ShortTime
    from avmsf.modal.pulse import ForcePulse
    from avmsf.modal.residual import Residual
    from avmsf.pipeline.bodies import candidate_bodies
    from avmsf.pipeline.config import BodyConfig
    from avmsf.pipeline.guess import guess_field
    from avmsf.scene.descriptors import ImageDescriptors
    from avmsf.scene.dino import DinoEncoder
    from avmsf.scene.features import FeatureField
    from avmsf.scene.featurestore import load_features, save_features
    from avmsf.scene.gaussians import GaussianCloud
    from avmsf.scene.lift import lift
    from avmsf.scene.ply import read_splats, write_splats
    from avmsf.scene.reduction import reduce, resize, with_positions
    from avmsf.scene.refine import refine
    from avmsf.scene.splat import splat
    from avmsf.scene.splatconfig import SplatConfig
    from avmsf.scene.symmetry import Symmetries
    from avmsf.scene.symmetrysearch import find_symmetries
    from avmsf.simulate.material import MATERIALS, Material
    from avmsf.tasks.config import DistillationConfig, SteerConfig
    from avmsf.tasks.distillation import DecoderDistillation
    from avmsf.tasks.listening import Listener
    from avmsf.tasks.locate import locate
    from avmsf.tasks.locator import Locator
    from avmsf.tasks.materialstatistics import MaterialStatistics
    from avmsf.tasks.recast import recast
    from avmsf.tasks.reference import Reference
    from avmsf.tasks.retune import retune
    from avmsf.tasks.severalblows import locate_blows
    from avmsf.tasks.stableaudio import StableAudio
    from avmsf.tasks.steer import steer

__version__ = "0.1.0"

__all__ = [
    "MATERIALS",
    "PAPER",
    "Attention",
    "BodyConfig",
    "Camera",
    "CandidateBodies",
    "Capture",
    "CaptureSettings",
    "DecoderDistillation",
    "DinoEncoder",
    "DistillationConfig",
    "Extraction",
    "FeatureField",
    "FitConfig",
    "ForcePulse",
    "GaussianCloud",
    "HighResolution",
    "ImageDescriptors",
    "Impacts",
    "Listener",
    "Locator",
    "Material",
    "MaterialStatistics",
    "MixtureEstimator",
    "ModalBank",
    "Reference",
    "Residual",
    "SampledField",
    "ShortTime",
    "SoundField",
    "SplatConfig",
    "StableAudio",
    "SteerConfig",
    "Surface",
    "Symmetries",
    "View",
    "candidate_bodies",
    "check",
    "evaluate",
    "extract",
    "find_foreground",
    "find_symmetries",
    "fit",
    "guess_field",
    "lift",
    "load",
    "load_features",
    "locate",
    "locate_blows",
    "read_capture",
    "read_demo",
    "read_splats",
    "read_views",
    "recast",
    "reduce",
    "refine",
    "resize",
    "retune",
    "save",
    "save_features",
    "splat",
    "split",
    "steer",
    "suggest",
    "with_positions",
    "write_bundle",
    "write_capture",
    "write_demo",
    "write_faust",
    "write_gltf",
    "write_grid",
    "write_splats",
    "write_universal",
    "write_views",
    "write_webpage",
]

# Names are fetched when they are first asked for: torch takes seconds to import, and `avmsf --help` needs none of it.
_HOMES = {
    "avmsf.export.bundle": ("write_bundle",),
    "avmsf.export.faust": ("write_faust",),
    "avmsf.export.gltf": ("write_gltf",),
    "avmsf.export.modaldemo": (
        "read_demo",
        "write_demo",
    ),
    "avmsf.export.sampledfield": ("SampledField",),
    "avmsf.export.universal": ("write_universal",),
    "avmsf.export.wavgrid": ("write_grid",),
    "avmsf.export.webpage": ("write_webpage",),
    "avmsf.modal.pulse": ("ForcePulse",),
    "avmsf.capture.cameras": (
        "Camera",
        "View",
    ),
    "avmsf.capture.views": (
        "find_foreground",
        "read_views",
    ),
    "avmsf.capture.views.write": ("write_views",),
    "avmsf.scene.descriptors": ("ImageDescriptors",),
    "avmsf.scene.dino": ("DinoEncoder",),
    "avmsf.scene.featurestore": (
        "load_features",
        "save_features",
    ),
    "avmsf.scene.gaussians": ("GaussianCloud",),
    "avmsf.scene.lift": ("lift",),
    "avmsf.scene.ply": (
        "read_splats",
        "write_splats",
    ),
    "avmsf.scene.reduction": (
        "reduce",
        "resize",
        "with_positions",
    ),
    "avmsf.scene.refine": ("refine",),
    "avmsf.scene.splat": ("splat",),
    "avmsf.scene.splatconfig": ("SplatConfig",),
    "avmsf.scene.symmetry": ("Symmetries",),
    "avmsf.scene.symmetrysearch": ("find_symmetries",),
    "avmsf.bench.evaluation": ("evaluate", "split"),
    "avmsf.capture": ("Capture", "CaptureSettings", "Impacts", "Surface", "check", "read_capture", "write_capture"),
    "avmsf.field.config": ("PAPER", "FitConfig"),
    "avmsf.field.fit": ("fit",),
    "avmsf.field.gains.bodies": ("CandidateBodies",),
    "avmsf.field.gains.estimator": ("MixtureEstimator",),
    "avmsf.field.recipes": ("Attention",),
    "avmsf.field.soundfield": ("SoundField",),
    "avmsf.field.store": ("load", "save"),
    "avmsf.field.suggest": ("suggest",),
    "avmsf.modal.bank": ("ModalBank",),
    "avmsf.modal.extraction.extract": ("Extraction", "extract"),
    "avmsf.modal.extraction.finders": ("HighResolution", "ShortTime"),
    "avmsf.modal.residual": ("Residual",),
    "avmsf.pipeline.bodies": ("BodyConfig", "candidate_bodies"),
    "avmsf.pipeline.guess": ("guess_field",),
    "avmsf.tasks.locate": ("locate",),
    "avmsf.tasks.locator": ("Locator",),
    "avmsf.tasks.severalblows": ("locate_blows",),
    "avmsf.tasks.listening": ("Listener",),
    "avmsf.tasks.recast": ("recast",),
    "avmsf.tasks.retune": ("retune",),
    "avmsf.tasks.steer": (
        "SteerConfig",
        "steer",
    ),
    "avmsf.tasks.reference": ("Reference",),
    "avmsf.tasks.distillation": (
        "DecoderDistillation",
        "DistillationConfig",
    ),
    "avmsf.tasks.stableaudio": ("StableAudio",),
    "avmsf.tasks.materialstatistics": ("MaterialStatistics",),
    "avmsf.simulate.material": (
        "MATERIALS",
        "Material",
    ),
    "avmsf.scene.features": ("FeatureField",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> object:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'avmsf' has no attribute {name!r}")
    value = getattr(import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
