"""Stages and the settings that decide them."""

import json
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from functools import partialmethod
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import avmsf
import avmsf.pipeline.fit as module
from avmsf._utils.progress import ProgressListener
from avmsf.capture import Capture, CaptureSettings, read_capture
from avmsf.cli.fit import Options as FitOptions
from avmsf.cli.modes import Options as ModesOptions
from avmsf.errors import AvmsfError, CaptureError, FitError, FolderInUseError, SceneError, SimulationError
from avmsf.fem.candidate_bodies import CandidateBodies
from avmsf.field.config import FitConfig
from avmsf.field.store import load
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import PRESETS, BodyConfig, LiftConfig, PipelineConfig, ViewsConfig
from avmsf.pipeline.fit import RECORD, fit_in_stages, with_record
from avmsf.pipeline.stages import Pipeline, Stage, StageFolder
from avmsf.pipeline.views import find_source
from factories.plate_capture import fill_plate
from factories.plate_field import plate_impacts
from factories.raising import raises


class Maker:
    """Writes its words, and counts how often it was asked to."""

    def __init__(self, words: str = "made") -> None:
        self.words, self.runs = words, 0

    def __call__(self, path: Path) -> None:
        self.runs += 1
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(self.words)


def stage(make: Callable[[Path], object], *, name: str = "cloud.ply", **recipe: object) -> Stage:
    return Stage(name, make, recipe=lambda: recipe)


def test_an_unchanged_recipe_runs_once_and_another_again(tmp_path: Path) -> None:
    make, folder = Maker(), StageFolder(tmp_path / "kept")
    first, second = (folder.keep(stage(make, steps=3)) for _ in range(2))
    assert (make.runs, first.fresh, second.fresh) == (1, True, False)
    assert second.digest == first.digest
    assert second.seconds == pytest.approx(first.seconds, abs=1e-3)  # seconds; the record rounds to milliseconds
    # Tuples are the lists that they are read back as.
    for recipe in ({"steps": 4}, {"steps": 4, "more": None}, {}, {"sizes": (1, 2)}):
        assert [folder.keep(stage(make, **recipe)).fresh for _ in range(2)] == [True, False]


def test_a_stage_is_made_once_after_those_that_it_depends_on_and_again_when_these_change(tmp_path: Path) -> None:
    read, log = list[str](), list[str]()

    def join(path: Path, *inputs: Path) -> None:
        read.extend(each.name for each in inputs)
        path.write_text("".join(each.read_text() for each in inputs))

    def run(words: str) -> Pipeline:
        stages = (Stage("b.txt", join, ("a.txt", "c.txt")), Stage("a.txt", Maker(words)), Stage("c.txt", Maker("c")))
        listener = ProgressListener(ready=lambda name, seconds: log.append(name if seconds is None else f"{name} made"))
        return Pipeline(StageFolder(tmp_path), stages, listener=listener)

    pipeline = run("a")
    assert pipeline["b.txt"].path.read_text() == "ac"
    assert not run("a")["b.txt"].fresh
    assert read == ["a.txt", "c.txt"]
    assert list(pipeline.made) == ["a.txt", "c.txt", "b.txt"]
    assert log == ["a made", "c made", "b made", "a", "c", "b"]
    (tmp_path / "a.txt").write_text("changed")
    (tmp_path / "a.txt.stage.json").unlink()
    assert run("other")["b.txt"].path.read_text() == "otherc"


def test_an_output_that_was_changed_or_lost_is_made_again(tmp_path: Path) -> None:
    make, folder = Maker(), StageFolder(tmp_path)
    kept = folder.keep(stage(make))
    kept.path.write_text("changed")
    assert folder.keep(stage(make)).fresh
    assert kept.path.read_text() == "made"
    kept.path.unlink()
    assert folder.keep(stage(make)).fresh


def test_a_stage_that_fails_midway_runs_again_even_under_an_older_recipe(tmp_path: Path) -> None:
    make, folder = Maker("old"), StageFolder(tmp_path)
    folder.keep(stage(make, steps=1))

    def fail(path: Path) -> None:
        path.write_text("half of the new")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        folder.keep(stage(fail, steps=2))
    assert folder.keep(stage(make, steps=1)).fresh
    assert folder.path("cloud.ply").read_text() == "old"


def test_a_record_of_another_version_or_code_or_a_damaged_one_does_not_count(tmp_path, monkeypatch):
    make, folder = Maker(), StageFolder(tmp_path)
    folder.keep(stage(make))
    monkeypatch.setattr("avmsf.__version__", "0.0.0")
    assert folder.keep(stage(make)).fresh
    monkeypatch.setattr("avmsf.pipeline.stages.source_digest", lambda module: "other code")
    assert folder.keep(stage(make)).fresh
    assert not folder.keep(stage(make)).fresh
    (tmp_path / "cloud.ply.stage.json").write_text("[]")
    assert folder.keep(stage(make)).fresh


def test_a_folder_counts_by_the_names_and_contents_of_its_files(tmp_path: Path) -> None:
    def make(path: Path) -> None:
        path.mkdir(exist_ok=True)
        (path / "a.png").write_text("a")

    folder = StageFolder(tmp_path)
    kept = folder.keep(stage(make, name="frames"))
    assert not folder.keep(stage(make, name="frames")).fresh
    (kept.path / "a.png").rename(kept.path / "b.png")
    assert folder.keep(stage(make, name="frames")).fresh


def test_an_interrupted_stage_finds_its_checkpoint_unless_its_recipe_has_changed(tmp_path: Path) -> None:
    folder = StageFolder(tmp_path)
    checkpoint = folder.checkpoint("cloud.ply")

    def stop(path: Path) -> None:
        checkpoint.write_text("halfway")
        raise KeyboardInterrupt

    found: list[bool] = []

    def go_on(path: Path) -> None:
        found.append(checkpoint.exists())
        path.write_text("done")

    for begun, ended in ((1, 1), (2, 3)):
        with pytest.raises(KeyboardInterrupt):
            folder.keep(stage(stop, steps=begun))
        folder.keep(stage(go_on, steps=ended))
        assert not checkpoint.exists()
    assert found == [True, False]


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    make = Maker()
    (tmp_path / "cloud.ply.stage.json").mkdir()
    with raises(CaptureError, file=tmp_path / "cloud.ply.stage.json"):
        StageFolder(tmp_path).keep(stage(make))
    assert make.runs == 0


@pytest.mark.slow
def test_a_field_does_not_depend_on_why_there_are_no_bodies_and_is_made_again_once_there_are(tmp_path, monkeypatch):
    capture = read_capture(fill_plate(tmp_path / "plate"))
    failures: list[Exception | None] = []

    def bodies(*arguments: Any, **named: Any) -> CandidateBodies:
        failures.append(failures[0])
        if failures[0] is not None:
            raise failures[0]
        return candidate_bodies(*arguments, **named)

    monkeypatch.setattr(module, "candidate_bodies", bodies)
    settings = FitConfig(steps=2, fft_sizes=(1024, 256))
    config = PipelineConfig(body=BodyConfig(wall=0.004, shapes=8, dofs=1000), fit=settings, modes=6)
    folder, told = StageFolder(tmp_path / "cache"), list[str]()
    listener = ProgressListener(ready=lambda name, seconds: told.append(name))

    def run(failure: Exception | None = None) -> bool:
        """Return whether the field was made now."""
        failures[:] = [failure]
        made = module.fit_in_stages(capture, config, folder, listener=listener)
        return made.stages["field.safetensors"].fresh

    assert run(SimulationError("3.1 GB are free"))
    assert not run(SimulationError("2.9 GB are free"))
    assert "bodies" not in told
    assert run()
    assert load(folder.path("field.safetensors")).origin.report["unavailable"] == {}
    assert "bodies" in told
    assert not run()
    # Bodies were not asked for.
    assert failures == [None]


def test_a_fit_is_refused_before_it_reads_what_another_one_writes(tmp_path, monkeypatch):
    monkeypatch.setattr(StageFolder, "lock", partialmethod(StageFolder.lock, wait=0.0))
    capture, folder = read_capture(fill_plate(tmp_path / "plate")), StageFolder(tmp_path / "cache")
    with folder.lock("avmsf fit mug"), ThreadPoolExecutor(1) as other:
        refused = other.submit(fit_in_stages, capture, PipelineConfig("smooth", modes=4), folder).exception()
    assert isinstance(refused, FolderInUseError)
    assert refused.value["command"] == "avmsf fit mug"
    assert sorted(each.name for each in (tmp_path / "cache").iterdir()) == ["stages.lock"]


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
    for config, name in ((ViewsConfig, "count"), (LiftConfig, "reach")):
        with raises(SceneError, name=name, value=-1):
            config(**{name: -1})
    with raises(SceneError, name="seed", value=2**63):
        LiftConfig(seed=2**63)
    with raises(AvmsfError, name="fit"):
        FitOptions.parse(["mug", "--preset", "quick"])
    with raises(FitError, name="time_zero", value="onset"):
        avmsf.fit(Capture("plate", plate_impacts()), config=PRESETS["paper"], progress=False)


def test_a_field_knows_the_configuration_that_made_it() -> None:
    field = load(Path(__file__).parents[1] / "field" / "data" / "format-8" / "mixture.safetensors")
    config = PRESETS["paper"]
    now = with_record(field, config, {"scene": asdict(config.scene)}).origin.report[RECORD]
    assert {**now, "fit": asdict(config.fit)} == {**asdict(config), "encoder": None}


def test_photographs_count_by_content_wherever_the_camera_file_names_them(tmp_path: Path) -> None:
    (tmp_path / "train").mkdir()
    image = tmp_path / "train" / "a.png"
    image.write_bytes(b"1")
    frame = {"file_path": "./train/a", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": [frame]}))
    before = find_source(tmp_path, CaptureSettings()).digest
    # What another command wrote there is none of them.
    (tmp_path / "gaussians.ply").touch()
    assert find_source(tmp_path, CaptureSettings()).digest == before
    image.write_bytes(b"2")
    assert find_source(tmp_path, CaptureSettings()).digest != before


def test_a_mesh_counts_with_materials_and_textures_in_any_folder(tmp_path: Path) -> None:
    (tmp_path / "look").mkdir()
    (tmp_path / "surface.obj").write_text("mtllib look/card.mtl\nusemtl skin\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    library, texture = tmp_path / "look" / "card.mtl", tmp_path / "look" / "skin.png"
    library.write_text("newmtl skin\nmap_Kd skin.png\n")
    digests = []
    for changed in (texture, texture, library):
        with open(changed, "a") as file:
            file.write("#")
        digests.append(find_source(tmp_path, CaptureSettings()).digest)
    assert len({*digests}) == 3
