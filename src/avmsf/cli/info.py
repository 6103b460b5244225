"""`avmsf info`: what a field, Gaussians, features or a surface hold, as text and pictures."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from avmsf._utils.text import counted
from avmsf.capture.settings import settings_of
from avmsf.cli.options import Common, Flag, expect_capture
from avmsf.cli.output import command, doing, finish, say, show
from avmsf.cli.paths import Existing, OtherCapture, PlotsFolder, kind_of

if TYPE_CHECKING:
    from jaxtyping import Float
    from matplotlib.figure import Figure
    from torch import Tensor

    from avmsf.capture import Capture, Impacts
    from avmsf.field.sound_field import SoundField

    _Described = tuple[str, dict[str, Any], Callable[[], Figure]]
    """Text and values on a file, and what draws it."""

_DRAWN_POINTS = 4000
_DRAWN_CONTACTS = 4


@dataclass(frozen=True)
class Options(Common):
    """Describe a field, Gaussians, features or a mesh, and draw them with --plots."""

    file: tyro.conf.Positional[
        Annotated[
            Path,
            tyro.conf.arg(metavar="FILE"),
            Existing("a field, Gaussians, features or a mesh", ("a sound field", "features", "a mesh or Gaussians")),
        ]
    ]
    """A field (.safetensors), Gaussians (.ply), features (.safetensors) or a mesh, as `avmsf fit` writes them."""
    all: Flag = False
    """Field: list all modes, not only those of most energy."""
    capture: OtherCapture = None
    """Field: compare it with a capture's recordings that it was not fitted to, or with all if there are none."""
    plots: PlotsFolder = None
    """Write figures to this folder. Field: modes.png, gains.png; uncertainty.png if the gains have a posterior;
    surface.png, with cross-sections, if they have a body; spectrograms.png with --capture. Gaussians: cloud.png.
    Features: features.png. Mesh: surface.png."""

    def _check(self) -> None:
        if self.capture is not None:
            expect_capture(self.capture)


def run(options: Options) -> int:
    """Describe and draw a file, whose kind its content shows."""
    if kind_of(options.file) == "a sound field":
        return _describe_field(options)
    steps = [command("avmsf info", options.file, "--plots plots")] if options.plots is None else []
    return finish("", describe_shape(options.file, options.plots), *steps)


def _describe_field(options: Options) -> int:
    from avmsf.capture import read_capture
    from avmsf.cli.report import describe, field_lines, levels, mode_rows, mode_table, score_table
    from avmsf.evaluation.scores import evaluate
    from avmsf.field.store import load

    field = load(options.file)
    rows, supporting = mode_rows(field.bank, levels(field.amplitudes), field.is_mode)
    values = {**describe(field), "modes": rows, "supporting_poles": supporting}
    of = ", levels on average over the object"
    lines = [*field_lines(field, options.file), mode_table(of, rows, len(supporting), every=options.all)]
    compared = None
    if options.capture is not None:
        doing("comparing the field with the capture's recordings")
        # Its sounds start where those of the recordings did that it was fitted to.
        settings = settings_of(options.capture).starting(field.origin.settings.time_zero)
        read = read_capture(options.capture, settings)
        impacts, others = read.impacts, _not_trained_on(field, read)
        what = "all of them training recordings"
        if others:
            what = "not training recordings" if len(others) < len(impacts) else "none a training recording"
        compared = field.aligned(impacts.take(others) if others else impacts)
        scores = evaluate(field, compared)
        title = f"{counted(len(compared), 'contact')}, {what}; lower is better"
        lines.append(score_table(title, {"field": scores}))
        recordings = {"recordings": list(compared.names), "which": what}
        values |= {"compared_with": {**recordings, "scores": {"field": scores.mean()}}}
    show("\n".join(lines))
    if options.plots is not None:
        draw_field(field, options.plots, recorded=compared)
    return finish("", values, command("avmsf render", options.file, "--position X Y Z -o impact.wav"))


def _not_trained_on(field: "SoundField", capture: "Capture") -> list[int]:
    """Return the recordings' rows that a field was not fitted to, by what they hold where it knows that, or by name."""
    from avmsf.modal.extraction.alignment import recording_keys

    alignment, keys = field.alignment, recording_keys(capture.impacts)
    if alignment is not None and capture.impacts.sample_rate == field.sample_rate:
        return [row for row, key in enumerate(keys) if key not in alignment.keys]
    return [row for row, name in enumerate(capture.impacts.names) if name not in field.origin.trained_on]


def draw_field(field: "SoundField", folder: Path, *, recorded: "Impacts | None" = None) -> None:
    """Write the figures of a field to a folder, with some of the recordings `recorded` next to its sounds."""
    from avmsf.cli.report import levels
    from avmsf.mesh.points import farthest_points
    from avmsf.pipeline.fit import modes_words
    from avmsf.plotting.objects import draw_surface
    from avmsf.plotting.pictures import draw_gains, draw_modes, draw_spectrograms, save_picture
    from avmsf.plotting.uncertainty import draw_uncertainty

    name, kept = field.origin.capture or "field", field.is_mode
    modes = modes_words(len(field.bank), int((~kept).sum()))
    points = field.gain_field.points
    points = points[:: max(1, len(points) // _DRAWN_POINTS)]
    # Not `field.gains`, which warns of points off the surface.
    gains = field.known(points).mean.real[:, kept]
    title = f"gains of the modes of most energy of {name}"
    pictures = {
        "modes": draw_modes(field.bank, levels(field.amplitudes), is_mode=kept, title=f"{modes} of {name}"),
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
    if field.has_posterior:
        std, title = field.relative_gain_std(points), f"uncertainty of the gains of {name}"
        pictures["uncertainty"] = draw_uncertainty(points, std, title=title, contacts=field.gain_field.contacts)
    if field.gain_field.surface is not None:
        pictures["surface"] = draw_surface(field.gain_field.surface, title=f"the body of {name}")
    for stem, picture in pictures.items():
        save_picture(picture, folder / f"{stem}.png")
        say(f"wrote {folder / stem}.png")


def describe_shape(
    path: Path, plots: Path | None, contacts: "Float[Tensor, 'contacts 3'] | None" = None
) -> dict[str, Any]:
    """Print what Gaussians, features or a surface hold, draw them in the folder `plots`, and return plain values."""
    from avmsf.gaussians.ply import holds_gaussians
    from avmsf.plotting.pictures import save_picture

    if kind_of(path) == "features":
        text, values, draw = _features(path)
    else:
        text, values, draw = _gaussians(path) if holds_gaussians(path) else _surface(path, contacts)
    show(text)
    if plots is not None:
        picture = plots / ("cloud.png" if values["kind"] == "gaussians" else f"{values['kind']}.png")
        save_picture(draw(), picture)
        say(f"wrote {picture}")
    return {"file": str(path), **values}


def _gaussians(path: Path) -> "_Described":
    from avmsf.gaussians.ply import read_splats
    from avmsf.plotting.objects import draw_cloud

    cloud = read_splats(path)
    extent = (cloud.centers.amax(0) - cloud.centers.amin(0)).tolist()
    title = f"{path.name}: {counted(len(cloud), 'Gaussian')}"
    values = {"kind": "gaussians", "count": len(cloud), "extent_meters": extent}
    text = f"{title}, {' x '.join(f'{side:.3g}' for side in extent)} m"
    return text, values, lambda: draw_cloud(cloud.centers, {"color": cloud.colors}, title=title)


def _features(path: Path) -> "_Described":
    from avmsf.cli.report import features_lines
    from avmsf.features.feature_field import GEOMETRY, load_features, read_report
    from avmsf.plotting.objects import component_colors, draw_cloud
    from avmsf.symmetry.symmetries import Symmetries

    features, report = load_features(path), read_report(path)
    count, dim = features.features.shape
    title = f"{path.name}: {dim} features of {features.encoder} on {count} points"
    values = {"kind": "features", "encoder": features.encoder, "points": count, "dim": dim, "report": report}

    def draw() -> "Figure":
        symmetries = Symmetries.from_dict(report["symmetries"]) if "symmetries" in report else None
        # The positions would outweigh the other features.
        positions = 3 if features.encoder.startswith(f"{GEOMETRY} and ") else 0
        rows = {"features": component_colors(features.features[:, positions:])}
        return draw_cloud(features.points, rows, title=title, symmetries=symmetries)

    return "\n".join([title, *features_lines(report)]), values, draw


def _surface(path: Path, contacts: "Float[Tensor, 'contacts 3'] | None") -> "_Described":
    import trimesh

    from avmsf.mesh.surface import Surface
    from avmsf.plotting.objects import draw_surface

    surface = Surface.read(path)
    mesh = trimesh.Trimesh(surface.vertices.double().numpy(), surface.faces.numpy(), process=True)
    extent = " x ".join(f"{1000 * side:.3g}" for side in surface.vertices.amax(0) - surface.vertices.amin(0))
    closed = f"closed, volume {1e6 * abs(mesh.volume):.3g} cm3" if mesh.is_watertight else "not closed"
    text = f"{counted(len(surface.faces), 'triangle')}, {extent} mm, area {1e4 * mesh.area:.3g} cm2, {closed}"
    values = {"kind": "surface", "triangles": len(surface.faces)}
    title = f"{path.name}: surface"
    return f"{path.name}: {text}", values, lambda: draw_surface(surface, title=title, contacts=contacts)
