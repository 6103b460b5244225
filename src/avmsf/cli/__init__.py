"""The command `avmsf`: one module a verb, and what happens around all of them."""

import _thread
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib import import_module
from types import FrameType
from typing import TextIO

import tyro

import avmsf
from avmsf._utils.memory import NO_MEMORY, lacks_memory
from avmsf._utils.text import printable
from avmsf.cli.heartbeat import beating
from avmsf.errors import AvmsfError, AvmsfWarning

VERBS = {
    "check": "Say what each recording of a capture is worth, and what is wrong.",
    "modes": "List the modes that a capture's recordings have in common.",
    "fit": "Fit a sound field to a capture and write it to one file.",
    "splat": "Turn photographs, a video or a mesh into Gaussians, as a .ply file that any 3DGS viewer opens.",
    "lift": "Describe what each place of an object looks like, and make that obey the object's symmetries.",
    "surface": "Write an object's surface alone: its mesh, or without one what its views show.",
    "reconstruct": "Go all the way from a capture folder to a field: views, Gaussians, features, modes, gains.",
    "view-cloud": "Draw Gaussians or features from all sides: colours, features, clusters, symmetries.",
    "render": "Write the sounds of blows anywhere on the object as wav files.",
    "locate": "Say where on the object a recorded blow fell, with a heat map and how sure that is.",
    "edit": "Give a field another material, size, pitch or decay, or lead it towards words or a recording.",
    "studio": "Open a page where the object is struck and heard, blows are located, and captures are made.",
    "export": "Write a field for other tools: web page, glTF, Faust, samplers, modal analysis.",
    "suggest": "Say where to strike next: the contacts that lower the expected error of the whole field most.",
    "show": "Say what a field file holds, and draw it.",
    "dataset": "Say what of a dataset is there, object by object, and what is missing.",
    "simulate": "Simulate objects, how they sound and how they look, as capture folders with their truth.",
    "evaluate": "Judge methods by contacts that they were not trained on, on all objects of a dataset.",
    "efficiency": "Show how the error falls with the number of places learnt from, for several methods.",
    "demo": "Go all the way on a built-in example: photographs, Gaussians, shape, features, a field, sounds, pictures.",
}
"""Each verb's module in this package, and the first sentence of its help."""
CLOSED = 141
"""The exit code that shells give a command whose output nobody reads any more."""
INTERRUPTED = 130
"""The exit code that shells give a command ended by Ctrl-C."""
TERMINATED = 143
"""The exit code that shells give a command ended by SIGTERM."""
_WAITING = frozenset({"studio"})
"""Verbs that wait for their user most of the time."""
_AGAIN = 0.05
"""Seconds after which an interruption that was dropped is raised again: a finalizer ends sooner, or it is repeated."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb and return its exit code: 0, 2 for input that cannot be used, 130 after Ctrl-C, 143 after SIGTERM.

    Raises SystemExit, as command lines do, for help (0) and for arguments that cannot be understood (2).
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words[:1] == ["--version"]:
        print(avmsf.__version__)
        return 0
    if not words or words[0] not in VERBS:
        _explain(words)
        return 2
    # Threads that wait actively for each other make many small sums several times slower where other programs run.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    heart = nullcontext() if words[0] in _WAITING else beating(f"avmsf {words[0]}")
    with warnings.catch_warnings(), _interrupting() as received, heart:
        try:
            # Only the verb that is asked for is imported: torch takes seconds, and help on the whole needs none of it.
            with _loading():
                verb = import_module(f"avmsf.cli.{words[0].replace('-', '_')}")
            _show_plainly()
            options = verb.parse(words[1:])
            with _compilation_announced():
                code: int = verb.run(options)
        except BrokenPipeError:
            # Whoever read the output has closed it, as `head` does; Python would complain again when it flushes.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return CLOSED
        except Exception as error:
            if not isinstance(error, AvmsfError) and not lacks_memory(error):
                raise
            sentence = str(error) if isinstance(error, AvmsfError) else NO_MEMORY
            print(f"avmsf {words[0]}: {printable(' '.join(sentence.split()))}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print(f"avmsf {words[0]}: interrupted", file=sys.stderr)
            code = INTERRUPTED
        return TERMINATED if code == INTERRUPTED and signal.SIGTERM in received else code


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


@contextmanager
def _loading() -> Iterator[None]:
    """Tell a terminal that something goes on, for as long as it does."""
    if not sys.stderr.isatty():
        yield
        return
    print("loading ...", end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        print("\r           \r", end="", file=sys.stderr, flush=True)


def _compilation_announced() -> AbstractContextManager[None]:
    """Let the standard error say what is compiled, for it takes seconds; verbs that compile nothing import nothing."""
    module = sys.modules.get("avmsf.compiled")
    if module is None:
        return nullcontext()
    # Imports rich, which help on the whole does not need.
    from avmsf.cli.printing import say

    announced: AbstractContextManager[None] = module.announced(say)
    return announced


def _explain(words: list[str]) -> None:
    """Print the list of verbs, or say that there is no such verb; leaves by SystemExit."""
    listed: dict[str, Callable[[], None]] = {}
    for verb, summary in VERBS.items():

        def stand_in() -> None:
            pass

        stand_in.__doc__ = summary
        listed[verb] = stand_in
    tyro.extras.subcommand_cli_from_dict(
        listed,
        prog="avmsf",
        description="The sound of an object wherever it is struck, from a few taps. `avmsf VERB --help` explains each.",
        args=words or ["--help"],
    )


def _show_plainly() -> None:
    """Let what a user should know appear as a sentence, without Python's file, line and category."""
    others = warnings.showwarning

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if issubclass(category, AvmsfWarning):
            print(f"note: {printable(str(message))}", file=sys.stderr)
        else:
            others(message, category, filename, lineno, file, line)

    warnings.simplefilter("always", AvmsfWarning)
    warnings.showwarning = show
