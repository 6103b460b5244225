"""Presets: what `paper` selects, that it is complete, and that the options of the commands start from it."""

import re
from dataclasses import asdict, replace
from pathlib import Path

import avmsf
from avmsf.capture import Capture, CaptureSettings
from avmsf.cli.fit import Options as FitOptions
from avmsf.cli.modes import Options as ModesOptions
from avmsf.errors import AvmsfError, FitError, SceneError
from avmsf.field.store import load
from avmsf.pipeline.config import PRESETS, LiftConfig, PipelineConfig, ViewsConfig
from avmsf.pipeline.record import recorded, with_record
from factories.plate_field import plate_impacts
from factories.raising import raises


def test_commands_start_from_the_preset_and_change_what_is_said() -> None:
    assert FitOptions.parse(["mug"]).all_settings == PRESETS["default"] == PipelineConfig()
    words = ["mug", "--set", "lift.encoder=descriptors", "--preset", "paper", "--set", "fit.steps=7"]
    mixed = FitOptions.parse(words).all_settings
    assert (mixed.fit.steps, mixed.fit.clusters) == (7, 256)
    assert (mixed.scene.lift.encoder, mixed.scene.lift.onto) == ("descriptors", "gaussians")
    modes, paper = ModesOptions.parse(["mug", "--preset", "paper", "--modes", "5"]).pipeline, PRESETS["paper"]
    assert (modes.extraction, modes.time_zero, modes.modes) == (paper.extraction, paper.time_zero, 5)


def test_a_seed_is_that_of_all_stages() -> None:
    made = FitOptions.parse(["mug", "--seed", "4"]).all_settings
    assert {made.fit.seed, made.scene.views.seed, made.scene.splat.seed, made.scene.lift.seed} == {4}


def test_the_start_of_sounds_is_the_presets_before_the_captures_own() -> None:
    own = CaptureSettings(seconds=1.0, time_zero="peak")
    assert own.starting(PipelineConfig().time_zero) == own
    assert replace(own, time_zero="onset").starting(PRESETS["paper"].time_zero) == own
    onset = FitOptions.parse(["mug", "--output", "f", "--set", "time_zero=onset"]).all_settings.time_zero
    assert own.starting(onset) == replace(own, time_zero="onset")


def test_the_table_of_the_docs_selects_the_preset_but_for_what_the_paper_leaves_open() -> None:
    page = (Path(__file__).parents[2] / "docs" / "paper-map.md").read_text(encoding="utf-8")
    table = page.partition("## The paper's form of each stage")[2].partition("\n\nIn `evaluate`")[0]
    words = [word for options in re.findall(r"`(--[^`]*)`", table.partition("|---|")[2]) for word in options.split()]
    found, paper = FitOptions.parse(["mug", *words]).all_settings, PRESETS["paper"]
    silent = {name: getattr(paper.fit, name) for name in ("width", "hidden", "layers", "warmup_rate")}
    assert replace(found, fit=replace(found.fit, **silent)) == paper


def test_settings_out_of_range_and_another_start_of_sounds_than_the_presets_are_refused() -> None:
    for config, name in ((ViewsConfig, "count"), (LiftConfig, "reach"), (LiftConfig, "feature_size")):
        with raises(SceneError, name=name, value=-1):
            config(**{name: -1})
    with raises(AvmsfError, name="fit"):
        FitOptions.parse(["mug", "--preset", "quick"])
    with raises(FitError, name="time_zero", value="onset"):
        avmsf.fit(Capture("plate", plate_impacts()), config=PRESETS["paper"], progress=False)


def test_settings_in_earlier_files_have_the_names_of_today() -> None:
    field = load(Path(__file__).parents[1] / "field" / "data" / "format-8" / "mixture.safetensors")
    assert recorded(field) == {}
    scene = {"splat": {"dissent": 0.1, "background": "found"}, "lift": {"background": "kept", "size": 0.3}}
    report = {"pipeline": {"method": "short-time", "body": {"freedoms": 5000}, "scene": scene}}
    earlier = replace(field, origin=replace(field.origin, report=report))
    assert recorded(earlier) == {
        "extraction": "short-time",
        "body": {"dofs": 5000},
        "scene": {
            "splat": {"wrong_masks": 0.1, "background": "found"},
            "lift": {"encoder_background": "kept", "feature_size": 0.3},
        },
    }
    config = PRESETS["paper"]
    now = recorded(with_record(field, config, {"scene": asdict(config.scene)}))
    assert {**now, "fit": asdict(config.fit)} == {**asdict(config), "encoder": None}
