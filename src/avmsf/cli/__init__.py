"""The command `avmsf`: one module for each subcommand, and what they have in common."""

import _thread
import os
import shutil
import signal
import sys
import textwrap
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from importlib import import_module
from itertools import takewhile
from types import FrameType
from typing import Any, TextIO

import avmsf
from avmsf._utils.text import printable
from avmsf.cli.printing import display, print_json, say
from avmsf.errors import NO_MEMORY, AvmsfError, AvmsfWarning, lacks_memory

VERBS = {
    "check": "Check the recordings of a capture: levels, noise, clipping, onsets, second impacts and alignment.",
    "modes": "List the modes of an object: frequencies, dampings and levels, from all recordings of a capture.",
    "fit": "Fit a sound field to a capture and write it to one file.",
    "render": "Write the sounds of impacts anywhere on the object as wav files.",
    "info": "Describe a field, Gaussians or features, and draw them with --plots.",
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
RENAMED = {
    "play": "studio",
    "dataset": "check",
    "lift": "fit --until features",
    "features": "fit --until features",
    "splat": "fit --until gaussians",
    "surface": "fit --until surface",
    "reconstruct": "fit",
    "view-cloud": "info",
    "show": "info",
    "efficiency": "evaluate shots",
    "help": "--help",
    "version": "--version",
    "-V": "--version",
}
"""What does the work of verbs of earlier versions, and of words that other programs know."""
CLOSED = 141
"""The exit code that shells give a command whose output nobody reads any more."""
INTERRUPTED = 130
"""The exit code that shells give a command ended by Ctrl-C."""
TERMINATED = 143
"""The exit code that shells give a command ended by SIGTERM."""
BAD_INPUT = 2
"""The exit code of input that cannot be used."""
_COMMON = frozenset({"--quiet", "--verbose", "--json"})
"""Options that may also stand before the verb."""
_OUTPUTS = ("output", "plots")
"""Options that name what a verb writes."""
_WIDEST = 120
"""Columns of the list of verbs, at most."""
_AGAIN = 0.05
"""Seconds after which an interruption that was dropped is raised again: a finalizer ends sooner, or it is repeated."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb and return its exit code: 0, 2 for input that cannot be used, 130 after Ctrl-C, 143 after SIGTERM.

    Raises SystemExit, as command lines do, for a verb's help (0) and for options that cannot be understood (2).
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            # Python has no stream where the descriptor is closed, as by `>&-`; the next file would take its place.
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w", encoding="utf-8"))
    try:
        try:
            return _run(_verb_first(sys.argv[1:] if arguments is None else arguments))
        finally:
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
    with warnings.catch_warnings(), _interrupting() as received:
        try:
            # A verb imports what computes when it runs: help and mistakes are answered before torch is loaded.
            options = options_of(words[0], words[1:])
            options.check_inputs()
            display.quiet, display.verbose = options.quiet, options.verbose
            verb = import_module(f"avmsf.cli.{words[0]}")
            _show_plainly()
            display.doing("loading")
            paths = [path for name in _OUTPUTS if (path := getattr(options, name, None)) is not None]
            for folder in dict.fromkeys(path.parent for path in paths if not path.parent.exists()):
                say(f"creating folder {folder}")
            code: int = verb.run(options)
        except Exception as error:
            if not isinstance(error, AvmsfError) and not lacks_memory(error):
                raise
            known = error if isinstance(error, AvmsfError) else AvmsfError(NO_MEMORY)
            say(f"avmsf {words[0]}: {_sentence(known)}", always=True)
            return _report_error(known, words)
        except SystemExit as ending:
            if ending.code == BAD_INPUT:
                # Of options that cannot be understood, which the standard error has explained.
                advice = f"see `avmsf {words[0]} --help`"
                _report_error(
                    AvmsfError.expected("options that can be read", got="others", name=words[0], advice=advice), words
                )
            raise
        except KeyboardInterrupt:
            say(f"avmsf {words[0]}: interrupted", always=True)
            code = INTERRUPTED
        finally:
            display.close()
            display.quiet = display.verbose = False
        return TERMINATED if code == INTERRUPTED and signal.SIGTERM in received else code


def options_of(verb: str, words: Sequence[str]) -> Any:
    """Return a verb's options that the words spell. Raises SystemExit for help and for words that are no options."""
    return import_module(f"avmsf.cli.{verb}").Options.parse(words)


def _report_error(error: AvmsfError, words: Sequence[str]) -> int:
    """Return the exit code of an error; where the words ask for JSON, print it as an object to the standard output."""
    if "--json" in words:
        print_json({"error": {"message": _sentence(error), **error.attributes}})
    return BAD_INPUT


def _sentence(error: AvmsfError) -> str:
    """Return the message of an error on one line."""
    return printable(" ".join(str(error).split()))


@contextmanager
def _interrupting() -> Iterator[list[int]]:
    """Let SIGTERM interrupt a verb as Ctrl-C does, and let neither be lost; yields the signals that have come.

    Python raises KeyboardInterrupt wherever the main thread is. In a finalizer, or in a function that compiled code
    calls back, it reports the exception and drops it; then the verb would go on, so it is raised once more.
    A SIGTERM that the parent process has told this one to ignore stays ignored, and one that is handled outside of
    Python stays handled there.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        received.append(number)
        raise KeyboardInterrupt

    def raise_again() -> None:
        if running:
            _thread.interrupt_main()

    def retry(unraisable: "sys.UnraisableHookArgs") -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            # Raised at once, it would be dropped with what this hook raises.
            timer = threading.Timer(_AGAIN, raise_again)
            timer.daemon = True
            timer.start()
        else:
            report(unraisable)

    report, sys.unraisablehook = sys.unraisablehook, retry
    running = [True]
    before = signal.getsignal(signal.SIGTERM)
    if before not in (None, signal.SIG_IGN):
        signal.signal(signal.SIGTERM, interrupt)
    try:
        yield received
    finally:
        running.clear()
        if before is not None:
            signal.signal(signal.SIGTERM, before)
        sys.unraisablehook = report


def _verb_first(words: Sequence[str]) -> list[str]:
    """Return the words with options of all verbs that stand before the verb behind it."""
    before = list(takewhile(_COMMON.__contains__, words))
    verb, rest = words[len(before) : len(before) + 1], words[len(before) + 1 :]
    return [*verb, *before, *rest]


def _explain(words: list[str]) -> int:
    """Print the list of verbs and return 0, or print that there is no such verb and return 2."""
    if words and words[0] not in ("-h", "--help"):
        given = None if words[0] in _COMMON else words[0]
        near = [RENAMED[words[0]]] if words[0] in RENAMED else get_close_matches(words[0], VERBS, n=1)
        advice = f"did you mean {near[0]}? `avmsf --help` lists all" if near else "`avmsf --help` lists all"
        error = AvmsfError.expected("a command", given, name="avmsf", advice=advice)
        print(_sentence(error), file=sys.stderr)
        return _report_error(error, words)
    indent = max(map(len, VERBS)) + 4
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    rows = {**VERBS, "--help": "Print this list.", "--version": "Print the version."}
    print("usage: avmsf COMMAND [OPTIONS]\n")
    print("The sound of an impact anywhere on an object, from a few recordings.")
    print("`avmsf COMMAND --help` explains a command; `avmsf demo` runs a complete example.")
    print("--quiet, --verbose and, but for demo, --json may stand before or after the command.\n")
    separator = "\n" + " " * indent
    for name, sentence in rows.items():
        lines = textwrap.wrap(sentence, max(30, width - indent))
        print(f"  {name:{indent - 2}}{separator.join(lines)}")
    return 0


def _show_plainly() -> None:
    """Let what a user should know appear as a sentence, without Python's file, line and category."""
    others, shown = warnings.showwarning, set[str]()

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if issubclass(category, AvmsfWarning):
            if str(message) in shown:
                return
            shown.add(str(message))
            print(f"note: {printable(str(message))}", file=sys.stderr)
        else:
            others(message, category, filename, lineno, file, line)

    warnings.simplefilter("always", AvmsfWarning)
    warnings.showwarning = show
