"""Common parts of the commands that compute Gaussians, features and surfaces from a folder's views."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from avmsf._utils.wording import counted
from avmsf.capture.together import expect_one_unit
from avmsf.cli.options.checks import read_settings
from avmsf.cli.options.scenes import SceneOptions
from avmsf.cli.scene_bar import SceneBar
from avmsf.pipeline.config import SceneConfig
from avmsf.pipeline.scene import SceneStages
from avmsf.pipeline.stages import Kept, StageFolder
from avmsf.symmetry.symmetries import Symmetries


@contextmanager
def opened_scene(options: SceneOptions, config: SceneConfig, *, command: str) -> Iterator[SceneStages]:
    """Yield the stages of the options' folder, which show their progress and are locked for the command.

    Raises SceneError for a folder without views of the object.
    """
    settings = read_settings(options.folder, options.settings)
    expect_one_unit(options.folder, settings)
    stages = StageFolder(options.kept)
    with SceneBar() as bar:
        scene = SceneStages(
            options.folder, stages, config, settings=settings, listener=bar.listener, device=options.device
        )
        scene.expect_any()
        with stages.lock(command):
            yield scene


def stage_line(name: str, kept: Kept) -> str:
    """Return a message on a stage's time and output."""
    return f"{name:9} {kept.seconds:7.1f} s{'' if kept.fresh else ' (cached)'}  {kept.path}"


def features_words(report: Mapping[str, Any]) -> str:
    """Return a message on the features, their consistency over the views, and their symmetries."""
    lines = [
        f"features: {report['encoder']}, on {report['points']} points, {report['unseen']} of them in no view; "
        f"consistency of the views {100 * report['agreement']:.0f} % of the features' variance"
    ]
    if report.get("dropped"):
        lines.append(
            f"removed: {counted(report['dropped'], 'Gaussian')} inside the object or behind its surface in the views"
        )
    if "symmetries" in report:
        lines.append(Symmetries.from_dict(report["symmetries"]).summary())
    if "orbit_spread" in report:
        before, after = report["orbit_spread"]
        lines.append(
            f"deviation over symmetric points, relative to all: {before:.3f} before pooling, {after:.3f} after"
        )
    return "\n".join(lines)
