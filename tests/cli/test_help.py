"""What `--help` prints of every verb, and settings by name."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from avmsf.cli import VERBS, main
from avmsf.cli.edit import Options as EditOptions
from avmsf.cli.evaluate import Options as EvaluateOptions
from avmsf.cli.fit import Options as FitOptions
from avmsf.cli.options import Configured
from avmsf.cli.simulate import Options as SimulateOptions
from avmsf.errors import AvmsfError
from avmsf.evaluation.registry import METHODS, PROTOCOLS
from avmsf.simulate.recipe import named_recipe
from factories.raising import raises

Streams = pytest.CaptureFixture[str]
MOST_LINES = 50
"""Of a help at 80 columns."""


@pytest.mark.parametrize("verb", VERBS)
def test_a_help_fits_on_one_screen(verb: str, capsys: Streams, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit, match="0"):
        main([verb, "--help"])
    out = capsys.readouterr().out
    # tyro folds the texts of options, not the paragraphs above them.
    assert sum(-(-len(line) // 80) for line in out.splitlines()) <= MOST_LINES
    options = re.findall(r"^│ -[-\w]", out, re.MULTILINE)
    assert len(options) <= 25
    assert VERBS[verb] in " ".join(out.split())
    # An argument before it takes nothing out of it.
    with pytest.raises(SystemExit, match="0"):
        main([verb, "edit", "--help"])
    assert capsys.readouterr().out.endswith(out)


def test_the_help_of_a_protocol_begins_with_what_it_does_and_its_methods(capsys: Streams) -> None:
    with pytest.raises(SystemExit, match="0"):
        main(["evaluate", "edit", "data", "--help"])
    title, methods = capsys.readouterr().out.split("\n\n")[:2]
    assert " ".join(title.split()) == f"edit: {PROTOCOLS['edit'].title}"
    named = {*re.findall(r"[-\w]+", methods)}
    assert {name for name in METHODS if name in named} == {"unedited", "generation"} | {
        f"edit-{each}" for each in ("independent", "published", "hierarchical", "searched", "physics")
    }


@pytest.mark.parametrize(
    ("options", "needed", "words"),
    [
        (FitOptions, ["mug"], "--preset paper --set time_zero=null --set modes=5 --seed 3 --set fft_sizes=512,256"),
        (SimulateOptions, [], "--set noise_db=None --set mesh=a.obj -o x mug-ceramic --impacts 5 --set hammer.mass=1"),
        (EvaluateOptions, ["farthest", "data"], "--set geometry=noisy --set body.wall=0"),
        (EditOptions, ["field", "-o", "new"], "--set prompt.generated=x.wav --set model_seconds=Infinity"),
    ],
)
def test_settings_are_printed_as_a_file_that_gives_them_back(
    options: type[Configured], needed: list[str], words: str, tmp_path: Path, capsys: Streams
) -> None:
    with pytest.raises(SystemExit, match="0"):
        options.parse([*words.split(), "--print-config"])
    file = tmp_path / "settings.toml"
    file.write_text(capsys.readouterr().out)
    assert options.parse([*needed, *words.split()]).all_settings != options.usual
    read = options.parse([*needed, "--config", str(file)])
    assert read.all_settings == options.parse([*needed, *words.split()]).all_settings


@pytest.mark.parametrize("words", [["--set", "kind=bowl"], ["--kind", "bowl"], ["--seed", "0"]])
def test_the_objects_of_a_set_stay_what_they_are(words: list[str], tmp_path: Path) -> None:
    with raises(AvmsfError, name=words[-1].partition("=")[0] if "--set" in words else words[0].lstrip("-")):
        SimulateOptions.parse(["sim-20", "-o", str(tmp_path / "x"), *words]).check_inputs()
    recipe = named_recipe("mug-ceramic")
    made = SimulateOptions.parse(["sim-20", "--impacts", "5"]).applied(recipe)
    assert made == replace(recipe, impacts=5)


@pytest.mark.parametrize(
    "words", [["--gain-model", "smooth", "--set", "gain_model=visual"], ["--seed", "1", "--set", "fit.seed=2"]]
)
def test_a_setting_is_given_once(words: list[str]) -> None:
    with raises(AvmsfError, name=words[-1].partition("=")[0]):
        _ = FitOptions.parse(["mug", *words]).all_settings


def test_options_that_are_settings_now_lead_to_these() -> None:
    for options, needed, old, new in (
        (FitOptions, ["mug"], "--body.wall", "--set body.wall="),
        (EvaluateOptions, ["farthest", "x"], "--geometry", "--set geometry="),
        (EditOptions, ["field", "-o", "new"], "--steps", "--set guide.steps="),
    ):
        with raises(AvmsfError) as caught:
            options.parse([*needed, old, "3"])
        assert new in str(caught.value)


@pytest.mark.parametrize(
    ("setting", "value"),
    [("steps=3", "steps"), ("splat.stepz=4", "splat.stepz"), ("splat.steps=x", "x"), ("splat", "splat")],
)
def test_a_setting_has_one_name_and_a_value_of_its_type(setting: str, value: str) -> None:
    with raises(AvmsfError, value=value):
        _ = FitOptions.parse(["mug", "--set", setting]).all_settings


def test_values_are_numbers_words_truth_values_and_lists_of_these() -> None:
    words = ["fft_sizes=512,256", "background=1,0,0.5", "lift.symmetry=false", "body.wall=0", "views.source=mesh"]
    made = FitOptions.parse(["mug", *(each for word in words for each in ("--set", word))]).all_settings
    assert (made.fit.fft_sizes, made.scene.splat.background) == ((512, 256), (1.0, 0.0, 0.5))
    assert (made.scene.lift.symmetry, made.body.wall, made.scene.views.source) == (False, 0.0, "mesh")
