"""The command `avmsf`: one module for each subcommand, and what they have in common.

What goes in are words; what comes out are files, text on the standard error and results on the standard output, as
tables for people or with `--json` as one object. Each module of a verb has `Options`, a frozen dataclass of which tyro
makes the command line, and `run(options)`, which imports what computes, calls the package and prints: start reading
with `render`. `options` parses and checks before anything is loaded, and reads `--set` and `--config`, `paths` says
what files and folders have to be, `many` runs a verb for each of several inputs, `contacts` reads positions, `report`
says what fields are, `edits` edits them and says how, `output` prints.
"""

import os
import shutil
import signal
import sys
import textwrap
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any

import avmsf
from avmsf._utils.text import printable
from avmsf.cli.output import display, print_json, say, show_plainly
from avmsf.errors import NO_MEMORY, AvmsfError, lacks_memory

VERBS = {
    "check": "Check the recordings of a capture: levels, noise, clipping, onsets, second impacts and alignment.",
    "modes": "List the modes of an object: frequencies, dampings and levels, from all recordings of a capture.",
    "fit": "Fit a sound field to a capture and write it to one file.",
    "render": "Write the sounds of impacts anywhere on the object as wav files.",
    "info": "Describe a field, Gaussians, features or a mesh, and draw them with --plots.",
    "locate": "Find where on the object the impact of a recording was, with a heat map and the uncertainty.",
    "edit": "Change a field's material, size, pitch or decay, or optimize it towards a text prompt or recordings.",
    "suggest": "Suggest where to record next: the contacts that reduce the expected error of the field most.",
    "evaluate": "Evaluate methods at held-out contacts, on all objects of a dataset.",
    "simulate": "Simulate objects, their recordings and images, as capture folders with ground truth.",
    "export": "Write a field for other tools: web page, glTF, Faust, samplers, modal analysis.",
    "studio": "Open a web page that plays an object, locates impacts, edits fields and records captures.",
    "demo": "Run a complete example: from photographs and recordings of a mug to its sound field, sounds and images.",
}
"""Each verb's module in this package, and the first sentence of its help, in the order of the work."""
BAD_INPUT = 2
"""The exit code of input that cannot be used."""
INTERRUPTED, CLOSED, TERMINATED = 130, 141, 143
"""The exit codes that shells give a command ended by Ctrl-C, by the end of who reads its output, and by SIGTERM."""
_WIDEST = 120
"""Columns of the list of verbs, at most."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb and return its exit code.

    It is 0, 1 where methods of `evaluate` failed, 2 for input that cannot be used, 130 after Ctrl-C, 141 where nobody
    reads the output any more, 143 after SIGTERM.
    Raises SystemExit(0), as command lines do, for a verb's help.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            # Python has no stream where the descriptor is closed, as by `>&-`; the next file would take its place.
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w", encoding="utf-8"))
    words = list(sys.argv[1:] if arguments is None else arguments)
    before = display.shown, display.verbose, display.json
    display.json = "--json" in words
    try:
        try:
            return _run(words)
        finally:
            display.shown, display.verbose, display.json = before
            # What is still buffered would otherwise fail after the end of this function.
            sys.stdout.flush()
    except BrokenPipeError:
        # Whoever read the output has closed it, as `head` does; Python would complain again when it flushes.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return CLOSED


def _run(words: list[str]) -> int:
    """Run the verb that comes first in the words and return its exit code, as `main` does."""
    if words[:1] == ["--version"]:
        print(avmsf.__version__)
        return 0
    if not words or words[0] not in VERBS:
        return _explain(words)
    # Threads that wait actively for each other make many small sums several times slower where other programs run.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    name, goes_on = f"avmsf {words[0]}: ", ""
    with warnings.catch_warnings(), _interrupting() as received:
        try:
            # A verb imports what computes when it runs: help and mistakes are answered before torch is loaded.
            options = options_of(words[0], words[1:])
            options.check_inputs()
            goes_on = "; repeat the command to continue" if options.resumes else ""
            display.shown, display.verbose = not options.only_results, options.verbose
            show_plainly()
            display.doing("loading")
            code: int = import_module(f"avmsf.cli.{words[0]}").run(options)
            return code
        except KeyboardInterrupt:
            say(f"{name}interrupted{goes_on}", always=True)
            return TERMINATED if signal.SIGTERM in received else INTERRUPTED
        except Exception as error:
            if lacks_memory(error):
                return _fail(AvmsfError(NO_MEMORY), name)
            if isinstance(error, FileNotFoundError):
                # Inputs that are missing are refused before: this is a fault of the package.
                raise
            if isinstance(error, OSError) and isinstance(error.filename, str | Path):
                # What the system refuses at a path: its name is too long, or a folder may not be searched.
                wanted, advice = "a readable or writable path", "check its name and its permissions"
                return _fail(AvmsfError.expected(wanted, error.strerror, file=error.filename, advice=advice), name)
            if isinstance(error, AvmsfError):
                return _fail(error, name)
            raise
        finally:
            display.close()


def options_of(verb: str, words: Sequence[str]) -> Any:
    """Return a verb's options that the words spell. Raises SystemExit for help, InputError for other words."""
    return import_module(f"avmsf.cli.{verb}").Options.parse(words)


def _fail(error: AvmsfError, place: str = "") -> int:
    """Print an error on one line, and with --json as an object; return its exit code."""
    message = printable(" ".join(str(error).split()))
    say(f"{place}{message}", always=True)
    print_json({"error": {"message": message, **error.attributes}})
    return BAD_INPUT


@contextmanager
def _interrupting() -> Iterator[list[int]]:
    """Let SIGTERM interrupt a verb as Ctrl-C does; yields the signals that have come.

    A SIGTERM that is ignored, or handled outside of Python, stays so.
    """
    received: list[int] = []
    before = signal.getsignal(signal.SIGTERM)
    if threading.current_thread() is not threading.main_thread() or before in (None, signal.SIG_IGN):
        yield received
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        received.append(number)
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)
    try:
        yield received
    finally:
        signal.signal(signal.SIGTERM, before)


def _explain(words: list[str]) -> int:
    """Print the list of verbs and return 0, or print that there is no such verb and return 2."""
    if words and words[0] not in ("-h", "--help"):
        return _fail(AvmsfError.unknown(words[0], VERBS, name="avmsf"))
    indent = max(map(len, VERBS)) + 4
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    print("usage: avmsf COMMAND [OPTIONS]\n")
    print("The sound of an impact anywhere on an object, from a few recordings.")
    print("`avmsf COMMAND --help` explains a command; `avmsf demo` runs a complete example.\n")
    for name, sentence in {**VERBS, "--help": "Print this list.", "--version": "Print the version."}.items():
        print(textwrap.fill(sentence, width, initial_indent=f"  {name:{indent - 2}}", subsequent_indent=" " * indent))
    return 0
