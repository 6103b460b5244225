"""`avmsf view-cloud`: Gaussians or features as pictures, from all sides."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
import tyro
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.bench.clouds import component_colours, draw_cloud, draw_features, save_turntable
from avmsf.bench.pictures import save_picture
from avmsf.cli.printing import print_text, say
from avmsf.cli.scenes import features_words
from avmsf.errors import SceneError
from avmsf.scene.features import GEOMETRY, FeatureField
from avmsf.scene.featurestore import load_features, read_report
from avmsf.scene.gaussians import GaussianCloud
from avmsf.scene.ply import read_splats
from avmsf.scene.start import ZEROTH
from avmsf.scene.symmetry import Symmetries

_UP = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class Options:
    """Draw Gaussians or features from all sides: colours, features, clusters, symmetries."""

    file: tyro.conf.Positional[Path]
    """Gaussians (.ply, as `avmsf splat` writes them) or features (.safetensors, as `avmsf lift` does)."""
    output: Path
    """Folder for the pictures: cloud.png or features.png, and turntable.gif, on which the cloud turns."""
    cloud: Path | None = None
    """Gaussians that the features lie on, to draw their colours beside the features."""
    clusters: int = 64
    """Regions to draw of features."""
    up: Literal["x", "y", "z"] = "z"
    """Axis that points to the sky."""


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return tyro.cli(Options, prog="avmsf view-cloud", args=words, config=(tyro.conf.FlagCreatePairsOff,))


def run(options: Options) -> int:
    """Draw."""
    if options.file.suffix.lower() == ".ply":
        _draw_cloud(options)
    else:
        _draw_features(options)
    return 0


def _draw_cloud(options: Options) -> None:
    cloud = read_splats(options.file)
    colors = plain_colors(cloud)
    title = f"{options.file.name}: {len(cloud)} Gaussians"
    _write(draw_cloud(cloud.centers, {"colour": colors}, title=title, up=_UP[options.up]), options.output / "cloud.png")
    _turn(cloud.centers, colors, options)


def _draw_features(options: Options) -> None:
    features, report = load_features(options.file), read_report(options.file)
    symmetries = Symmetries.from_dict(report["symmetries"]) if "symmetries" in report else None
    if "encoder" in report:
        print_text(features_words(report))
    shown = without_positions(features)
    figure = draw_features(
        shown,
        title=f"{options.file.name}: {features.encoder} on {len(features.points)} points",
        colours=None if options.cloud is None else _colors_of(options.cloud, features),
        clusters=min(options.clusters, len(features.points)),
        symmetries=symmetries,
        up=_UP[options.up],
    )
    _write(figure, options.output / "features.png")
    _turn(features.points, component_colours(shown.features), options, symmetries=symmetries)


def _colors_of(path: Path, features: FeatureField) -> Float[Tensor, "points 3"]:
    """Return the colours of the Gaussians that the features lie on."""
    cloud = read_splats(path)
    apart, rows = cKDTree(cloud.centers.numpy()).query(features.points.numpy())
    if apart.any():
        raise SceneError(
            f"{path}: expected the Gaussians that the features lie on ({len(features.points)}), found {len(cloud)} "
            "others: name the file that the features were lifted onto"
        )
    return plain_colors(cloud.take(torch.from_numpy(rows)))


def _turn(
    points: Float[Tensor, "points 3"],
    colors: Float[Tensor, "points 3"],
    options: Options,
    *,
    symmetries: Symmetries | None = None,
) -> None:
    path = options.output / "turntable.gif"
    save_turntable(points, colors, path, symmetries=symmetries, up=_UP[options.up])
    say(f"wrote {path}")


def _write(picture: Figure, path: Path) -> None:
    save_picture(picture, path)
    say(f"wrote {path}")


def without_positions(features: FeatureField) -> FeatureField:
    """Return the features alone, which positions beside them would outshine."""
    if not features.encoder.startswith(f"{GEOMETRY} and "):
        return features
    return replace(features, features=features.features[:, 3:])


def plain_colors(cloud: GaussianCloud) -> Float[Tensor, "points 3"]:
    """Return the Gaussians' colours as seen from nowhere in particular, 0 to 1."""
    return (0.5 + ZEROTH * cloud.harmonics[:, 0]).clamp(0, 1).detach()
