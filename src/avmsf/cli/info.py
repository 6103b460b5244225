"""`avmsf info`: what a field, Gaussians or features hold, as text and pictures."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from avmsf._utils.text import counted
from avmsf.cli.options import Common, Flag, expect_capture, read_settings
from avmsf.cli.output import doing, next_command, print_json, print_result, say, show
from avmsf.cli.paths import Existing, OtherCapture, PlotsFolder, SettingsFile, arg, kind_of
from avmsf.errors import SceneError
from avmsf.gaussians.ply_header import read_header

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from avmsf.capture import Impacts
    from avmsf.features.feature_field import FeatureField
    from avmsf.field.sound_field import SoundField

_DRAWN_POINTS, _LISTED_POINTS = 4000, 500
"""Of the surface: for pictures, and for the mean levels in a table."""
_DRAWN_CONTACTS = 4
_BATCH = 1024
"""Points whose gains are taken at once: the encoding of their offsets to many clusters is large."""
_UP = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class Options(Common):
    """Describe a field, Gaussians or features, and draw them with --plots."""

    file: tyro.conf.Positional[
        Annotated[
            Path,
            tyro.conf.arg(metavar="FILE"),
            Existing("a field, Gaussians or features", ("a sound field", "features", "a mesh or Gaussians")),
        ]
    ]
    """A field (.safetensors), Gaussians (.ply) or features (.safetensors), as `avmsf fit` writes them."""
    all: Flag = False
    """Field: list all modes, not only those of most energy."""
    capture: OtherCapture = None
    """Field: compare it with a capture's recordings that it was not fitted to, or with all if there are none."""
    settings: SettingsFile = None
    """Field: use this capture.toml instead of the capture's own."""
    plots: PlotsFolder = None
    """Write figures to this folder. Field: modes.png, gains.png; uncertainty.png and spectrum.png if the gains have a
    posterior; surface.png, with cross-sections, if they have a body; spectrograms.png with --capture. Gaussians:
    cloud.png. Features: features.png."""
    cloud: Annotated[Path | None, arg("CLOUD.ply"), Existing("Gaussians, as a .ply file", ("a mesh or Gaussians",))] = (
        None
    )
    """Features: also draw the colors of the Gaussians that the features lie on."""
    up: Literal["x", "y", "z"] = "z"
    """Gaussians and features: axis that points up."""

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        for cloud in (self.file if self.file.suffix.lower() == ".ply" else None, self.cloud):
            if cloud is not None:
                read_header(cloud)
        if self.capture is not None:
            expect_capture(self.capture, read_settings(self.capture, self.settings))


def run(options: Options) -> int:
    """Describe and draw a file, whose kind its content shows."""
    if options.file.suffix.lower() == ".ply":
        _describe_gaussians(options)
    elif kind_of(options.file) == "features":
        _describe_features(options)
    else:
        _describe_field(options)
    return 0


def _describe_field(options: Options) -> None:
    from avmsf.capture import read_capture
    from avmsf.cli.report import describe, field_lines, levels, mode_rows, mode_table, score_table
    from avmsf.evaluation.scores import evaluate
    from avmsf.field.store import load

    field = load(options.file)
    points = field.gain_field.points
    level = levels(gains_at(field, points[:: max(1, len(points) // _LISTED_POINTS)]))
    rows, supporting = mode_rows(field.bank, level, field.is_mode)
    values = {**describe(field), "modes": rows, "supporting_poles": supporting}
    of = ", levels on average over the object"
    lines = [*field_lines(field, options.file), mode_table(of, rows, len(supporting), every=options.all)]
    compared = None
    if options.capture is not None:
        doing("comparing the field with the capture's recordings")
        settings = read_settings(options.capture, options.settings)
        compared, what = _held_out(read_capture(options.capture, settings).impacts, field)
        compared = field.aligned(compared)
        scores = evaluate(field, compared)
        title = f"{counted(len(compared), 'contact')}, {what}; lower is better"
        lines.append(score_table(title, {"field": scores}))
        recordings = {"recordings": list(compared.names), "which": what}
        values |= {"compared_with": {**recordings, "scores": {"field": scores.mean()}}}
    show("\n".join(lines))
    if options.plots is not None:
        _draw_field(field, options.plots, level=level, recorded=compared)
    print_json(values)
    next_command("avmsf render", options.file, "--position X Y Z -o impact.wav")


def gains_at(field: "SoundField", points: "Float[Tensor, 'points 3']") -> "Float[Tensor, 'points modes']":
    """Return the gains at many points, without a warning for one that is off the surface."""
    import torch

    return torch.cat([field.known(part).mean.real for part in torch.split(points, _BATCH)])


def _draw_field(
    field: "SoundField", folder: Path, *, level: "Float[Tensor, ' modes']", recorded: "Impacts | None"
) -> None:
    """Write the figures of a field, with some of the recordings `recorded` next to its sounds."""
    from avmsf.field.posterior import has_posterior, relative_gain_std, spectrum_band
    from avmsf.gaussians.points import farthest_points
    from avmsf.pipeline.record import modes_words
    from avmsf.plotting.pictures import draw_gains, draw_modes, save_picture
    from avmsf.plotting.spectrograms import draw_spectrograms
    from avmsf.plotting.surfaces import draw_surface
    from avmsf.plotting.uncertainty import draw_band, draw_uncertainty

    name, kept = field.origin.capture or "field", field.is_mode
    modes = modes_words(len(field.bank), int((~kept).sum()))
    points = field.gain_field.points
    points = points[:: max(1, len(points) // _DRAWN_POINTS)]
    gains, title = gains_at(field, points)[:, kept], f"gains of the modes of most energy of {name}"
    pictures = {
        "modes": draw_modes(field.bank, level, is_mode=kept, title=f"{modes} of {name}"),
        "gains": draw_gains(points, gains, field.bank.take(kept), title=title),
    }
    if recorded is not None:
        chosen = recorded.take(farthest_points(recorded.contacts, min(_DRAWN_CONTACTS, len(recorded))).tolist())
        sounds = field.render(chosen.contacts, directions=chosen.directions, samples=chosen.sounds.shape[1])
        pairs = zip(chosen.names, chosen.sounds, sounds, strict=True)
        pictures["spectrograms"] = draw_spectrograms(
            {recording: {"recorded": one, "rendered": other} for recording, one, other in pairs},
            ("recorded", "rendered"),
            sample_rate=field.sample_rate,
            normalize=False,
            title=f"{name}: recorded and rendered",
        )
    if has_posterior(field):
        std, title = relative_gain_std(field, points), f"uncertainty of the gains of {name}"
        pictures["uncertainty"] = draw_uncertainty(points, std, title=title, contacts=field.gain_field.contacts)
        band, title = spectrum_band(field, points[0]), f"{name}: one impact, with its uncertainty"
        pictures["spectrum"] = draw_band(band, title=title)
    if field.gain_field.surface is not None:
        pictures["surface"] = draw_surface(field.gain_field.surface, title=f"the body of {name}")
    for stem, picture in pictures.items():
        save_picture(picture, folder / f"{stem}.png")
        say(f"wrote {folder / stem}.png")


def _held_out(impacts: "Impacts", field: "SoundField") -> "tuple[Impacts, str]":
    known = set(field.origin.trained_on)
    rows = [row for row, name in enumerate(impacts.names) if name not in known]
    if not rows:
        return impacts, "all of them training recordings"
    return impacts.take(rows), "not training recordings" if len(rows) < len(impacts) else "none a training recording"


def _describe_gaussians(options: Options) -> None:
    from avmsf.gaussians.ply import read_splats
    from avmsf.plotting.clouds import draw_cloud

    cloud = read_splats(options.file)
    extent = (cloud.centers.amax(0) - cloud.centers.amin(0)).tolist()
    count = counted(len(cloud), "Gaussian")
    text = f"{options.file}: {count}, {' x '.join(f'{side:.3g}' for side in extent)} m"
    values = {"kind": "gaussians", "file": str(options.file), "count": len(cloud), "extent_meters": extent}
    print_result(text, values)
    if _draws(options):
        title = f"{options.file.name}: {count}"
        _save(draw_cloud(cloud.centers, {"color": cloud.colors}, title=title, up=_UP[options.up]), "cloud", options)


def _describe_features(options: Options) -> None:
    from avmsf.cli.report import features_lines
    from avmsf.features.feature_field import GEOMETRY
    from avmsf.features.store import load_features, read_report
    from avmsf.plotting.clouds import component_colors, draw_cloud
    from avmsf.symmetry.symmetries import Symmetries

    features, report = load_features(options.file), read_report(options.file)
    count, dim = features.features.shape
    text = f"{options.file}: {dim} features of {features.encoder} on {count} points"
    values = {"kind": "features", "file": str(options.file), "encoder": features.encoder, "points": count, "dim": dim}
    print_result(
        "\n".join([text, *(features_lines(report) if "encoder" in report else [])]), {**values, "report": report}
    )
    if not _draws(options):
        return
    symmetries = Symmetries.from_dict(report["symmetries"]) if "symmetries" in report else None
    rows = {} if options.cloud is None else {"color": _colors_of(options.cloud, features)}
    # The positions would outweigh the other features.
    positions = 3 if features.encoder.startswith(f"{GEOMETRY} and ") else 0
    rows["features"] = component_colors(features.features[:, positions:])
    title = f"{options.file.name}: {features.encoder} on {count} points"
    _save(
        draw_cloud(features.points, rows, title=title, symmetries=symmetries, up=_UP[options.up]), "features", options
    )


def _draws(options: Options) -> bool:
    """Return whether pictures are asked for; where not, print how to get them."""
    if options.plots is None:
        next_command("avmsf info", options.file, "--plots plots")
    return options.plots is not None


def _save(picture: Any, stem: str, options: Options) -> None:
    from avmsf.plotting.pictures import save_picture

    assert options.plots is not None
    save_picture(picture, options.plots / f"{stem}.png")
    say(f"wrote {options.plots / stem}.png")


def _colors_of(path: Path, features: "FeatureField") -> "Float[Tensor, 'points 3']":
    """Return the colors of the Gaussians that the features lie on."""
    import torch
    from scipy.spatial import cKDTree

    from avmsf.gaussians.ply import read_splats

    cloud = read_splats(path)
    apart, rows = cKDTree(cloud.centers.numpy()).query(features.points.numpy())
    if apart.any():
        wanted, got = f"the {len(features.points)} Gaussians of the features", f"{len(cloud)} others"
        advice = "name the file that the features were computed on"
        raise SceneError.expected(wanted, len(cloud), got=got, file=path, name="--cloud", advice=advice)
    return cloud.take(torch.from_numpy(rows)).colors
