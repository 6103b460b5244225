"""What `avmsf info` prints and draws of Gaussians and features."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf._utils.text import counted
from avmsf.cli.fit import features_words
from avmsf.cli.options.info import Options
from avmsf.cli.printing import console, say
from avmsf.errors import SceneError
from avmsf.features.feature_field import GEOMETRY, FeatureField
from avmsf.features.store import load_features, read_report
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.ply import read_splats
from avmsf.plotting.clouds import component_colors, draw_cloud
from avmsf.plotting.pictures import save_picture
from avmsf.symmetry.symmetries import Symmetries

_UP = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def describe_cloud(options: Options) -> dict[str, Any]:
    """Print a description of Gaussians, draw them with --plots, and return their values."""
    cloud = read_splats(options.file)
    extent = (cloud.centers.amax(0) - cloud.centers.amin(0)).tolist()
    screen = console(errors=options.json)
    sides = " x ".join(f"{side:.3g}" for side in extent)
    screen.print(f"{options.file}: {counted(len(cloud), 'Gaussian')}, {sides} m", soft_wrap=True)
    if options.plots is not None:
        _draw_cloud(cloud, options, options.plots)
    return {"kind": "gaussians", "file": str(options.file), "count": len(cloud), "extent_meters": extent}


def describe_features(options: Options) -> dict[str, Any]:
    """Print a description of features, draw them with --plots, and return their values."""
    features, report = load_features(options.file), read_report(options.file)
    screen = console(errors=options.json)
    count, dim = features.features.shape
    screen.print(f"{options.file}: {dim} features of {features.encoder} on {count} points", soft_wrap=True)
    if "encoder" in report:
        screen.print(features_words(report), soft_wrap=True)
    if options.plots is not None:
        _draw_features(features, report, options, options.plots)
    values = {"kind": "features", "file": str(options.file), "encoder": features.encoder, "points": count, "dim": dim}
    return {**values, "report": report}


def _draw_cloud(cloud: GaussianCloud, options: Options, folder: Path) -> None:
    title = f"{options.file.name}: {counted(len(cloud), 'Gaussian')}"
    save_picture(
        draw_cloud(cloud.centers, {"color": cloud.colors}, title=title, up=_UP[options.up]), folder / "cloud.png"
    )
    say(f"wrote {folder / 'cloud.png'}")


def _draw_features(features: FeatureField, report: dict[str, Any], options: Options, folder: Path) -> None:
    symmetries = Symmetries.from_dict(report["symmetries"]) if "symmetries" in report else None
    rows = {} if options.cloud is None else {"color": _colors_of(options.cloud, features)}
    rows["features"] = component_colors(without_positions(features).features)
    title = f"{options.file.name}: {features.encoder} on {len(features.points)} points"
    figure = draw_cloud(features.points, rows, title=title, symmetries=symmetries, up=_UP[options.up])
    save_picture(figure, folder / "features.png")
    say(f"wrote {folder / 'features.png'}")


def _colors_of(path: Path, features: FeatureField) -> Float[Tensor, "points 3"]:
    """Return the colors of the Gaussians that the features lie on."""
    cloud = read_splats(path)
    apart, rows = cKDTree(cloud.centers.numpy()).query(features.points.numpy())
    if apart.any():
        wanted, got = f"the {len(features.points)} Gaussians of the features", f"{len(cloud)} others"
        advice = "name the file that the features were computed on"
        raise SceneError.expected(wanted, len(cloud), got=got, file=path, name="--cloud", advice=advice)
    return cloud.take(torch.from_numpy(rows)).colors


def without_positions(features: FeatureField) -> FeatureField:
    """Return the features without the positions, which would outweigh them."""
    if not features.encoder.startswith(f"{GEOMETRY} and "):
        return features
    return replace(features, features=features.features[:, 3:])
