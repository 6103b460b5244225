"""What a capture's owner knows about its recordings: the contents of `capture.toml`, every key optional."""

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from avmsf._utils.text import RecordError, read_toml, record_of
from avmsf.errors import CaptureError

SETTINGS, TABLE = "capture.toml", "impacts.csv"
"""Names of the files in a capture folder."""
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048}
OBJECT_SIZES = (0.01, 5.0)
"""Meters across of objects whose impacts are recorded."""
USUAL_SECONDS = 3.0
TIME_ZEROS = ("onset", "peak")
_POINTS = "a list of points [x, y, z], such as [[0, 0, 0], [0.3, 0, 0]]"
NORMALIZATIONS = ("auto", "peak", "deconvolve", "none", "done")


@dataclass(frozen=True)
class CaptureSettings:
    """How to read a capture folder. Raises `CaptureError` for values out of range."""

    name: str | None = None
    """Name of the object; by default that of the folder."""
    unit: str = "m"
    """Unit of the coordinates in impacts.csv: m, cm, mm, in or ft."""
    surface_unit: str | None = None
    """Unit of the surface's coordinates; by default `unit`. Where no unit is stated, or m alone as `unit`, a fit infers
    from the frequencies whether it is another; stated here, it does not."""
    views_unit: str = "m"
    """Unit of the cameras' positions, where there are photographs."""
    surface: str | None = None
    """Surface file in the folder; by default the first of surface.obj, .ply, .glb, .stl."""
    response_channel: int | None = None
    """Channel of the wav files that holds the sound, counted from 1 as in sound editors. Not needed for mono files and
    for files whose channels hold one sound up to a constant factor, rounding and dither."""
    force_channel: int | None = None
    """Channel that holds the hammer's force, counted from 1, where there is one."""
    force_scale: float = 1.0
    """Newtons for each unit of the force channel; 1 for float files in newtons. Where impacts.csv also gives
    force_newtons, that is the peak, and the channel gives only the shape."""
    seconds: float | None = None
    """Length to use from the onset, in seconds as recorded (before any speed-up); by default `kept_seconds`."""
    playback_speed: float = 1.0
    """Factor on the files' sample rate; nothing is resampled. Above 1, slow vibrations sound like a smaller object."""
    normalize: str = "auto"
    """peak: divide by the peak force. deconvolve: divide the spectrum by the force's. none: leave as recorded. done:
    the files are divided already, by the force_newtons of the table if it has them. auto: peak where a force is known
    by channel or column, else none."""
    regularization: float = 1e-4
    """For deconvolve: the power, relative to the greatest of the force's spectrum, below which the force is regarded as
    absent. Larger values reduce noise and high frequencies."""
    highpass: float = 0.0
    """Cutoff in Hz, as recorded, of a highpass against rumble: 20 leaves all audible frequencies. 0 filters nothing,
    since a large structure may vibrate that low. The hammer's force is never filtered. `check` proposes a value where
    rumble dominates the noise before the impacts."""
    held: tuple[tuple[float, float, float], ...] = ()
    """Points at which the object was held or stood, such as its feet, in `unit`; for elastic mode shapes."""
    align: bool = True
    """Find where the impact begins in each file, and align the recordings with one another. Recordings that all start
    with the impact, as impulse responses do, are detected and not cut. False uses every file from its first sample:
    for recordings that have one time zero already."""
    time_zero: str = "onset"
    """Where a sound starts, with `align`: onset, where the impact begins; peak, at its largest sample, as in the paper.
    Recordings that start at their peaks are not aligned with one another."""

    def __post_init__(self) -> None:
        units, positive, channel = f"one of {', '.join(METRES)}", "a number above 0", "a channel from 1 on"
        response, force = self.response_channel, self.force_channel
        for key, valid, expected in (
            ("unit", self.unit in METRES, units),
            ("surface_unit", self.surface_unit in (None, *METRES), units),
            ("views_unit", self.views_unit in METRES, units),
            ("held", all(len(each) == 3 and all(map(math.isfinite, each)) for each in self.held), _POINTS),
            ("seconds", self.seconds is None or 0 < self.seconds < math.inf, positive),
            ("playback_speed", 0 < self.playback_speed < math.inf, positive),
            ("regularization", 0 < self.regularization < math.inf, positive),
            ("highpass", 0 <= self.highpass < math.inf, "a frequency in Hz, or 0 for none"),
            ("force_scale", 0 < abs(self.force_scale) < math.inf, "newtons for each unit of the channel"),
            ("response_channel", response is None or response >= 1, channel),
            ("force_channel", force is None or force >= 1, channel),
            ("force_channel", force is None or force != response, "another channel than response_channel"),
            ("time_zero", self.time_zero in TIME_ZEROS, f"one of {', '.join(TIME_ZEROS)}"),
            ("normalize", self.normalize in NORMALIZATIONS, f"one of {', '.join(NORMALIZATIONS)}"),
            ("force_channel", self.normalize != "deconvolve" or force, 'the hammer\'s, for normalize = "deconvolve"'),
        ):
            if not valid:
                raise CaptureError.expected(expected, getattr(self, key), name=key)

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

    def starting(self, time_zero: str | None) -> "CaptureSettings":
        """Return the settings with another start of sounds, from peaks even without `align`; the same for None."""
        if time_zero is None:
            return self
        return replace(self, time_zero=time_zero, align=self.align or time_zero == "peak")

    @property
    def meters(self) -> float:
        """Meters in one unit of the contacts' coordinates."""
        return METRES[self.unit]

    @property
    def held_at(self) -> list[tuple[float, float, float]]:
        """The points at which the object was held, meters."""
        return [(x * self.meters, y * self.meters, z * self.meters) for x, y, z in self.held]

    @property
    def surface_meters(self) -> float:
        """Meters in one unit of the surface's coordinates."""
        return METRES[self.surface_unit or self.unit]

    def unit_ratios(self, extent: float) -> dict[str, float]:
        """Return the units that a surface `extent` meters across may be in, with the lengths of each over the present.

        The present unit comes first. Others make it an object of usual size, and there are none where one is stated.
        """
        present = self.surface_unit or self.unit
        ratios = {unit: length / self.surface_meters for unit, length in METRES.items()}
        usual = {unit: each for unit, each in ratios.items() if OBJECT_SIZES[0] <= each * extent <= OBJECT_SIZES[1]}
        return {present: 1.0} | ({} if self.unit_stated else usual)

    @property
    def unit_stated(self) -> bool:
        """Whether the surface's unit is stated: any unit, or another of the contacts or the cameras than m."""
        return self.surface_unit is not None or {self.unit, self.views_unit} != {"m"}

    @property
    def views_meters(self) -> float:
        """Meters in one unit of the cameras' positions."""
        return METRES[self.views_unit]

    @classmethod
    def read(cls, path: str | Path) -> "CaptureSettings":
        """Read a TOML file of these keys; `CaptureError` names the file, the key and what was expected."""
        path = Path(path)
        try:
            return record_of(cls, read_toml(path), added=asdict(cls()))
        except FileNotFoundError as error:
            raise CaptureError.expected("a file of capture settings", file=path) from error
        except (CaptureError, RecordError) as error:
            raise CaptureError(f"{path}: {error}", file=path, name=error.name, value=error.value) from error
        except (OSError, ValueError) as error:
            raise CaptureError.expected("a TOML file", got=f"one that cannot be read: {error}", file=path) from error


def unit_named(meters: float) -> str | None:
    """Return the unit of a length, meters, if it is one."""
    return next((unit for unit, length in METRES.items() if abs(length / meters - 1) < 1e-6), None)


def settings_of(folder: Path) -> CaptureSettings:
    """Read the folder's `capture.toml`, or return the defaults where there is none."""
    path = folder / SETTINGS
    return CaptureSettings.read(path) if path.is_file() else CaptureSettings()
