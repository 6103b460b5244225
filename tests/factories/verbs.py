"""A verb of the command line, run in this process."""

from importlib import import_module

from avmsf.cli import options_of
from avmsf.cli.output import display


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
