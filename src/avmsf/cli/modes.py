"""`avmsf modes`: the modes that a capture's recordings have in common."""

from dataclasses import asdict, dataclass, replace

import tyro

from avmsf._utils.text import counted
from avmsf.capture.settings import settings_of
from avmsf.cli.options import Common, Flag, Int, expect_capture
from avmsf.cli.output import command, doing, finish, say, show
from avmsf.cli.paths import CaptureFolder, PlotsFolder
from avmsf.modal.config import ExtractionMethod
from avmsf.pipeline.config import PRESETS, PipelineConfig, Preset, TimeZero

_EXPLANATION = (
    "±: spread over recordings. energy: share of all. phase: coherence over recordings, 1 if the same in all. orders: "
    "part of the model orders that find the pole. left out: energy explained by leave-one-out, 50 % by chance."
)


@dataclass(frozen=True)
class Options(Common):
    """List the modes of an object: frequencies, dampings and levels, from all recordings of a capture."""

    capture: tyro.conf.Positional[CaptureFolder]
    """Folder with impacts.csv and the recordings that it names."""
    extraction: ExtractionMethod | None = None
    """How modes are extracted, by default high-resolution: ESPRIT in subbands, which separates modes a few hertz apart.
    short-time: the paper's method, bin by bin of a short-time spectrum."""
    modes: Int = None
    """Maximum number of modes, by default 128."""
    time_zero: TimeZero | None = None
    """Start of the sounds: onset, or peak (paper); by default that of capture.toml."""
    preset: Preset = "default"
    """Defaults of all settings; paper: the published method, from the peak on."""
    all: Flag = False
    """List all modes, not only those of most energy."""
    plots: PlotsFolder = None
    """Draw the modes to modes.png in this folder."""

    def _check(self) -> None:
        _ = self.pipeline
        expect_capture(self.capture)

    @property
    def pipeline(self) -> PipelineConfig:
        """The settings of the preset, with those that are given."""
        names = ("extraction", "modes", "time_zero")
        given = {name: value for name in names if (value := getattr(self, name)) is not None}
        return replace(PRESETS[self.preset], **given)


def run(options: Options) -> int:
    """Print the modes."""
    from avmsf.capture import read_capture
    from avmsf.cli.report import levels, mode_rows, mode_table
    from avmsf.modal.extraction.alignment_report import AlignmentReport
    from avmsf.modal.extraction.esprit import stable_orders
    from avmsf.modal.extraction.extract import FINDERS, extract_modes
    from avmsf.modal.extraction.quality import measure_quality

    config = options.pipeline
    capture = read_capture(options.capture, settings_of(options.capture).starting(config.time_zero))
    impacts = capture.impacts
    count = counted(len(impacts), "recording")
    doing(f"finding the modes of {count}, {impacts.duration:.3g} s at {impacts.sample_rate:g} Hz")
    extraction = extract_modes(impacts, FINDERS[config.extraction](modes=config.modes))
    level = levels(extraction.gains.abs().square().mean(0).sqrt())
    sounds, rate = extraction.aligned(impacts).sounds, impacts.sample_rate
    quality = measure_quality(sounds, extraction, sample_rate=rate)
    stable = stable_orders(extraction.at_common_poles(sounds, sample_rate=rate), extraction.bank, sample_rate=rate)
    modes, supporting = mode_rows(extraction.bank, level, quality.is_mode, (quality, stable))
    aligned = AlignmentReport.of(extraction, impacts)
    shifts = None if extraction.shifts is None else extraction.shifts.relative
    shifted = "" if shifts is None else f"frequencies differ between recordings by {100 * shifts:.2g} %, fitted in each"
    lines = [mode_table(f" of {capture.name}, {count}", modes, len(supporting), every=options.all), _EXPLANATION]
    show("\n".join([*lines, *([] if aligned is None else aligned.sentences()), *([shifted] if shifted else [])]))
    if options.plots is not None:
        from avmsf.plotting.pictures import draw_modes, save_picture

        picture = options.plots / "modes.png"
        poles = len(modes) + len(supporting)
        drawn = f"{counted(poles, 'pole')} of {capture.name}, of them {counted(len(modes), 'mode')}"
        save_picture(draw_modes(extraction.bank, level, is_mode=quality.is_mode, title=drawn), picture)
        say(f"wrote {picture}")
    values = {
        "capture": capture.name,
        "recordings": len(impacts),
        "sample_rate": impacts.sample_rate,
        "seconds": impacts.duration,
        "method": config.extraction,
        "alignment": None if aligned is None else asdict(aligned),
        "frequency_shift": shifts,
        "modes": modes,
        "supporting_poles": supporting,
    }
    return finish("", values, command("avmsf fit", options.capture, "-o field.safetensors"))
