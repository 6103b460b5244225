"""What a capture's owner knows about its recordings: the contents of `capture.toml`, every key optional."""

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields
from difflib import get_close_matches
from pathlib import Path
from types import NoneType
from typing import Any, get_args

from avmsf._utils.text_files import read_toml
from avmsf.errors import CaptureError

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048}
USUAL_SECONDS = 3.0
TIME_ZEROS = ("onset", "peak")
NORMALIZATIONS = ("auto", "peak", "deconvolve", "none", "done")


@dataclass(frozen=True)
class CaptureSettings:
    """How to read a capture folder. Raises `CaptureError` for values that cannot be meant."""

    name: str | None = None
    """What the object is called; the folder's name where it is not given."""
    unit: str = "m"
    """Unit of the coordinates in impacts.csv: m, cm, mm, in or ft."""
    surface_unit: str | None = None
    """Unit of the surface's coordinates; the same as `unit` where it is not given."""
    views_unit: str = "m"
    """Unit of the cameras' positions, where there are photographs."""
    surface: str | None = None
    """Surface file in the folder; the first of surface.obj, .ply, .glb, .stl where it is not given."""
    response_channel: int | None = None
    """Channel of the wav files that holds the sound, counted from 1 as sound editors count. Mono files need none, nor
    do files whose channels hold one sound up to a constant factor, rounding and dither."""
    force_channel: int | None = None
    """Channel that holds the hammer's force, counted from 1, where there is one."""
    force_scale: float = 1.0
    """Newtons for each unit of the force channel; 1 for float files that hold newtons. Where impacts.csv gives
    force_newtons as well, that is the peak, and the channel gives the shape alone."""
    seconds: float | None = None
    """How much to keep from the onset, in seconds as recorded (before any speed-up); `kept_seconds` where it is not
    given."""
    playback_speed: float = 1.0
    """The capture's sample rate is the files' rate times this; nothing is resampled. Above 1, slow vibrations sound
    as a smaller object would."""
    normalize: str = "auto"
    """peak: divide by the peak force. deconvolve: divide the spectrum by the force's. none: leave as recorded. done:
    the files are divided already, by the force_newtons that the table keeps, where it has them. auto: peak where a
    force is known by channel or column, else none."""
    regularization: float = 1e-4
    """For deconvolve: the power, relative to the greatest of the force's spectrum, below which the force counts as
    absent. Larger is quieter and duller."""
    highpass: float = 0.0
    """Remove rumble below this frequency from the sound, Hz as recorded: 20 leaves all that is heard. 0 leaves it
    as it is, for a large structure may ring as low as that. The hammer's force is never filtered. `check` proposes a
    value where rumble dominates the noise before the impacts."""
    align: bool = True
    """Find where the impact begins in each file, and align the recordings with one another. Recordings that all start
    with the impact, as impulse responses do, are recognized and not cut. False takes every file from its first sample
    as it is: for recordings that have one time zero already."""
    time_zero: str = "onset"
    """Where a sound starts, with `align`: onset, where the impact begins; peak, at its largest sample, as in the paper.
    Recordings that start at their peaks are not aligned with one another."""

    def __post_init__(self) -> None:
        for key in ("unit", "surface_unit", "views_unit"):
            if getattr(self, key) not in (*METRES, *((None,) if key == "surface_unit" else ())):
                raise CaptureError(f"{key} is {getattr(self, key)!r}; expected one of {', '.join(METRES)}")
        for key in ("seconds", "playback_speed", "regularization"):
            value = getattr(self, key)
            if value is not None and not (value > 0 and math.isfinite(value)):
                raise CaptureError(f"{key} is {value!r}; expected a number above 0")
        if not 0 <= self.highpass < math.inf:
            raise CaptureError(f"highpass is {self.highpass!r}; expected a frequency in Hz, or 0 for none")
        if self.force_scale == 0 or not math.isfinite(self.force_scale):
            raise CaptureError(f"force_scale is {self.force_scale!r}; expected newtons for each unit of the channel")
        for key in ("response_channel", "force_channel"):
            value = getattr(self, key)
            if value is not None and value < 1:
                raise CaptureError(f"{key} is {value}; channels count from 1, as in a sound editor")
        if self.force_channel is not None and self.force_channel == self.response_channel:
            raise CaptureError(f"force_channel and response_channel are both {self.force_channel}")
        if self.time_zero not in TIME_ZEROS:
            raise CaptureError(f"time_zero is {self.time_zero!r}; expected one of {', '.join(TIME_ZEROS)}")
        if self.normalize not in NORMALIZATIONS:
            raise CaptureError(f"normalize is {self.normalize!r}; expected one of {', '.join(NORMALIZATIONS)}")
        if self.normalize == "deconvolve" and self.force_channel is None:
            raise CaptureError('normalize = "deconvolve" needs the hammer\'s pulse: say which force_channel holds it')

    def kept_seconds(self, rate: float) -> float:
        """Return how many seconds are kept from the onset of files of this sample rate, Hz.

        Where `seconds` is not given that is 3 s, and at rates below 44.1 kHz as many samples: what is sampled slowly
        rings for long (a structure of 19 Hz at 400 Hz still after 6 s).
        """
        return max(USUAL_SECONDS, USUAL_SECONDS * 44100.0 / rate) if self.seconds is None else self.seconds

    @property
    def from_peaks(self) -> bool:
        """Whether sounds start at their largest samples."""
        return self.align and self.time_zero == "peak"

    @property
    def meters(self) -> float:
        """Meters in one unit of the contacts' coordinates."""
        return METRES[self.unit]

    @property
    def surface_meters(self) -> float:
        """Meters in one unit of the surface's coordinates."""
        return METRES[self.surface_unit or self.unit]

    @property
    def views_meters(self) -> float:
        """Meters in one unit of the cameras' positions."""
        return METRES[self.views_unit]

    @classmethod
    def read(cls, path: str | Path) -> "CaptureSettings":
        """Read a TOML file of these keys; `CaptureError` names the file, the key and what was expected."""
        path = Path(path)
        try:
            table = read_toml(path)
        except FileNotFoundError as error:
            raise CaptureError(f"{path}: there is no such file of capture settings") from error
        except (OSError, ValueError) as error:
            raise CaptureError(f"{path}: not a TOML file that can be read: {error}") from error
        return cls.of(table, name=str(path))

    @classmethod
    def of(cls, values: Mapping[str, Any], *, name: str) -> "CaptureSettings":
        """Return settings of these keys' plain values; `CaptureError` gives `name`, the key and what was expected."""
        known = {field.name: get_args(field.type) or (field.type,) for field in fields(cls)}
        typed: dict[str, Any] = {}
        for key, value in values.items():
            if key not in known:
                raise CaptureError(f"{name}: unknown key {key!r}{_nearest_key(key, list(known))}")
            typed[key] = _typed(value, known[key], f"{name}: {key}")
        try:
            return cls(**typed)
        except CaptureError as error:
            raise CaptureError(f"{name}: {error}") from error


def _typed(value: object, kinds: tuple[object, ...], where: str) -> object:
    """Return the value as one of the kinds; whole numbers serve as numbers, and `true` as neither."""
    if float in kinds and type(value) is int and abs(value) <= sys.float_info.max:
        return float(value)
    if type(value) not in kinds:
        words = {str: "text", int: "a whole number", float: "a number", bool: "true or false"}
        expected = " or ".join(word for kind, word in words.items() if kind in kinds and kind is not NoneType)
        raise CaptureError(f"{where} is {value!r}; expected {expected}")
    return value


def _nearest_key(key: str, known: list[str]) -> str:
    found = get_close_matches(key, known, n=1, cutoff=0.6)
    return f" (did you mean {found[0]}?)" if found else f"; expected some of {', '.join(known)}"
