"""`avmsf reconstruct`: from a capture folder with views and recordings to a field."""

from dataclasses import asdict

from avmsf._utils.device import TRAINABLE, usable_device
from avmsf._utils.files import copy_whole
from avmsf.capture import CaptureSettings, read_capture
from avmsf.cli import INTERRUPTED
from avmsf.cli.alignment import describe_alignment
from avmsf.cli.fit import fitted_values, next_after_fit, part_contacts, print_fitted, show_guess, warn_of_quality
from avmsf.cli.heartbeat import doing
from avmsf.cli.options.checks import read_settings
from avmsf.cli.options.reconstruct import Options
from avmsf.cli.printing import console, figure, print_json, say, table
from avmsf.cli.progress import FitBar
from avmsf.cli.scene_bar import SceneBar
from avmsf.cli.scenes import features_words
from avmsf.cli.scores import compare, order_words
from avmsf.cli.visuals import expect_shape
from avmsf.errors import FitError
from avmsf.field.fit import Progress
from avmsf.field.store import load
from avmsf.pipeline.reconstruct import reconstruct, reconstruct_guess
from avmsf.pipeline.record import capture_settings_of
from avmsf.pipeline.stages import StageFolder


def run(options: Options) -> int:
    """Reconstruct, and print a summary; return 130 where Ctrl-C stopped it."""
    usable_device(options.device, raising=FitError, kinds=TRAINABLE)
    settings = capture_settings_of(options.pipeline, read_settings(options.folder, options.settings))
    if options.material is not None:
        return _run_guess(options, options.material, settings)
    capture = read_capture(options.folder, settings)
    if not options.without_shape:
        expect_shape(options.folder, capture, views=True, verb="reconstruct")
    train, test = part_contacts(
        capture.impacts, fraction=options.train_fraction, count=options.train_count, start=options.start
    )
    try:
        with SceneBar() as scene_bar, FitBar() as fit_bar, StageFolder(options.kept).lock("avmsf reconstruct"):
            made = reconstruct(
                options.folder,
                capture,
                train,
                options.pipeline,
                cache=options.kept,
                settings=settings,
                listener=scene_bar.listener,
                fitting=lambda progress: show_fit(progress, scene_bar, fit_bar),
            )
            fitted = load(made.field)
            if options.output is not None:
                copy_whole(made.field, options.output)
    except KeyboardInterrupt:
        say("avmsf reconstruct: interrupted; repeat the command to continue")
        return INTERRUPTED
    doing("comparing the field with the recordings that it was not fitted to")
    scores = {} if test is None else compare(fitted, train, test, made.modes)
    screen = console(errors=options.json)
    for sentence in (*order_words(fitted), *describe_alignment(made.modes, train)):
        screen.print(sentence, soft_wrap=True)
    if made.report:
        screen.print(features_words(made.report), soft_wrap=True)
    rows = [[each.stage, figure(each.seconds), "computed" if each.fresh else "cached"] for each in made.stages]
    screen.print(table("stages", ["stage", "seconds", "source"], rows))
    print_fitted(screen, fitted, train, test, scores, options.output or made.field)
    if made.surface is not None:
        screen.print(f"the object's surface is {made.surface}", soft_wrap=True)
    screen.print(f"the field is {made.field}", soft_wrap=True)
    if options.output is not None:
        screen.print(f"wrote {options.output}", soft_wrap=True)
    next_after_fit(options.output or made.field, trial=test is not None)
    warn_of_quality(fitted)
    if options.json:
        print_json(
            {
                **fitted_values(fitted, train, test, scores, options.output or made.field),
                "surface": None if made.surface is None else str(made.surface),
                "preset": options.preset,
                "features_report": made.report,
                "stages": [asdict(each) for each in made.stages],
            }
        )
    return 0


def _run_guess(options: Options, material: str, settings: CaptureSettings) -> int:
    """Compute a field without recordings, and print a summary."""
    try:
        with SceneBar() as bar, StageFolder(options.kept).lock("avmsf reconstruct"):
            made = reconstruct_guess(
                options.folder,
                material,
                options.pipeline,
                cache=options.kept,
                settings=settings,
                listener=bar.listener,
            )
            if options.output is not None:
                copy_whole(made, options.output)
    except KeyboardInterrupt:
        say("avmsf reconstruct: interrupted; repeat the command to continue")
        return INTERRUPTED
    show_guess(load(made), options.output or made, json=options.json)
    return 0


def show_fit(progress: Progress, scene_bar: SceneBar, fit_bar: FitBar) -> None:
    """Show the fit on a screen that holds one bar at a time."""
    scene_bar.stop()
    fit_bar.show(progress)
