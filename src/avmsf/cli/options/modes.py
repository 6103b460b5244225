"""Options of `avmsf modes`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.cli.options.common import CaptureFolder, Printing, SettingsFile, parse_options
from avmsf.modal.config import ExtractionMethod


@dataclass(frozen=True)
class Options(Printing):
    """List the modes of an object: frequencies, dampings and levels, from all recordings of a capture."""

    capture: tyro.conf.Positional[CaptureFolder]
    """Folder with impacts.csv and the recordings that it names."""
    extraction: ExtractionMethod = "high-resolution"
    """How modes are extracted. high-resolution: ESPRIT in subbands, which separates modes a few hertz apart.
    short-time: the paper's method, bin by bin of a short-time spectrum."""
    modes: int = 128
    """Maximum number of modes."""
    settings: SettingsFile = None
    """Use this capture.toml instead of the folder's own."""
    picture: Annotated[Path | None, tyro.conf.arg(metavar="FILE.png")] = None
    """Draw the modes to this file, which ends in .png, .pdf or .svg."""


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return parse_options(Options, "modes", words)
