"""What `--help` prints of every verb, and hints for names of earlier versions."""

from collections.abc import Callable
from pathlib import Path

import pytest

from avmsf.cli import RENAMED, main
from avmsf.cli.options.edit import Options as EditOptions
from avmsf.cli.options.fit import Options as FitOptions
from avmsf.cli.options.simulate import Options as SimulateOptions
from avmsf.errors import AvmsfError
from avmsf.pipeline.config import PRESETS
from factories.raising import raises

Streams = pytest.CaptureFixture[str]


@pytest.mark.parametrize(
    ("read", "setting", "value"),
    [
        (lambda words: FitOptions.parse(["mug", *words]).pipeline, "lift.feature_size", 0.0),
        (lambda words: FitOptions.parse(["mug", *words]).pipeline, "splat.wrong_masks", 2.0),
        (lambda words: EditOptions.parse(["field", "-o", "new", *words]).all_settings, "guide.free_modes", 0),
        (lambda words: EditOptions.parse(["field", "-o", "new", *words]).all_settings, "contacts_per_step", 0),
        (lambda words: SimulateOptions.parse(words).recipe, "elastic_modes", 0),
        (lambda words: SimulateOptions.parse(words).recipe, "impacts", 1),
    ],
)
def test_an_error_names_a_setting(read: Callable[[list[str]], object], setting: str, value: float) -> None:
    with raises(AvmsfError, name=setting.rpartition(".")[2], value=value):
        read(["--set", f"{setting}={value}"])


@pytest.mark.parametrize("word", RENAMED)
def test_verbs_of_earlier_versions_lead_to_those_of_today(word: str, capsys: Streams) -> None:
    assert main([word]) == 2
    assert RENAMED[word] in capsys.readouterr().err


def test_settings_are_printed_as_a_file_that_gives_them_back(tmp_path: Path, capsys: Streams) -> None:
    for words, preset in ((["--preset", "paper"], PRESETS["paper"]), (["--set", "splat.steps=7"], None)):
        with pytest.raises(SystemExit, match="0"):
            main(["fit", *words, "--print-config"])
        file = tmp_path / "settings.toml"
        file.write_text(capsys.readouterr().out)
        read = FitOptions.parse(["mug", "--config", str(file)]).pipeline
        assert read == (preset or FitOptions.parse(["mug", *words]).pipeline)


@pytest.mark.parametrize(
    ("setting", "value"),
    [("steps=3", "steps"), ("splat.stepz=4", "splat.stepz"), ("splat.steps=x", "x"), ("splat", "splat")],
)
def test_a_setting_has_one_name_and_a_value_of_its_type(setting: str, value: str) -> None:
    with raises(AvmsfError, value=value):
        _ = FitOptions.parse(["mug", "--set", setting]).pipeline


def test_values_are_numbers_words_truth_values_and_lists_of_these() -> None:
    words = ["fft_sizes=512,256", "background=1,0,0.5", "lift.symmetry=false", "body.wall=0", "views.source=mesh"]
    made = FitOptions.parse(["mug", *(each for word in words for each in ("--set", word))]).pipeline
    assert (made.fit.fft_sizes, made.scene.splat.background) == ((512, 256), (1.0, 0.0, 0.5))
    assert (made.scene.lift.symmetry, made.body.wall, made.scene.views.source) == (False, 0.0, "mesh")


def test_an_option_of_an_earlier_version_leads_to_that_of_today(capsys: Streams) -> None:
    assert main(["render", "field.safetensors", "--at", "0", "0", "0", "-o", "s"]) == 2
    assert "--position" in capsys.readouterr().err
