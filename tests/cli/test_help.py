"""What `--help` prints of every verb, and hints for names of earlier versions."""

from collections.abc import Callable

import pytest

from avmsf.cli import RENAMED, main
from avmsf.cli.options.edit import Options as EditOptions
from avmsf.cli.options.fit import Options as FitOptions
from avmsf.cli.options.simulate import Options as SimulateOptions
from avmsf.errors import AvmsfError
from factories.raising import raises

Streams = pytest.CaptureFixture[str]


def test_an_option_may_have_another_name_than_its_attribute() -> None:
    edit = EditOptions.parse(["field", "-o", "new", "--to-material", "wood", "--scale", "2"])
    assert (edit.change.material, edit.change.size) == ("wood", 2.0)


@pytest.mark.parametrize(
    ("parse", "words", "option", "value"),
    [
        (FitOptions.parse, "mug", "--lift.feature-size", 0.0),
        (FitOptions.parse, "mug", "--splat.wrong-masks", 2.0),
        (EditOptions.parse, "field -o new", "--free-modes", 0),
        (EditOptions.parse, "field -o new", "--contacts-per-step", 0),
        (SimulateOptions.parse, "", "--elastic-modes", 0),
        (SimulateOptions.parse, "", "--impacts", 1),
    ],
)
def test_an_error_names_a_setting_as_its_option(
    parse: Callable[[list[str]], object], words: str, option: str, value: float
) -> None:
    name = option.removeprefix("--").rpartition(".")[2].replace("-", "_")
    with raises(AvmsfError, name=name, value=value):
        parse([*words.split(), option, str(value)])


@pytest.mark.parametrize("word", RENAMED)
def test_verbs_of_earlier_versions_lead_to_those_of_today(word: str, capsys: Streams) -> None:
    assert main([word]) == 2
    assert RENAMED[word] in capsys.readouterr().err


def test_an_option_of_an_earlier_version_leads_to_that_of_today(capsys: Streams) -> None:
    assert main(["render", "field.safetensors", "--at", "0", "0", "0", "-o", "s"]) == 2
    assert "--position" in capsys.readouterr().err
