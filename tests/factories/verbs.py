"""Verbs of the command line, run in this process, and their settings."""

import json
from importlib import import_module
from typing import Any

import pytest

from avmsf.cli import main, options_of
from avmsf.cli.output import display

Streams = pytest.CaptureFixture[str]


def run_verb(*words: str) -> int:
    """Run a verb as the command does, and raise its errors and interruptions."""
    options = options_of(words[0], words[1:])
    options.check_inputs()
    display.json = options.json
    try:
        code: int = import_module(f"avmsf.cli.{words[0]}").run(options)
    finally:
        display.json = False
    return code


def results_of(streams: Streams, *words: object, code: int | None = 0) -> tuple[Any, str]:
    """Run a command with --json that ends with a code, or any; return its results and what is on the standard error."""
    streams.readouterr()
    ended = main([*map(str, words), "--json"])
    assert code is None or ended == code
    out, err = streams.readouterr()
    return json.loads(out), err


def sets(settings: str) -> tuple[str, ...]:
    """Return the arguments --set NAME=VALUE of settings that blanks separate."""
    return tuple(word for each in settings.split() for word in ("--set", each))
