"""`avmsf modes`: the modes that a capture's recordings have in common."""

from dataclasses import asdict, dataclass, replace
from typing import Annotated

import tyro

from avmsf._utils.text import counted
from avmsf.cli.common import Printing, expect_capture, read_settings
from avmsf.cli.paths import CaptureFolder, PlotsFolder, SettingsFile
from avmsf.cli.printing import doing, next_command, print_json, say, show
from avmsf.modal.config import ExtractionMethod
from avmsf.pipeline.config import PRESETS, PipelineConfig, Preset, TimeZero

_EXPLANATION = (
    "±: spread over recordings. energy: share of all. phase: coherence over recordings, 1 if the same in all. orders: "
    "part of the model orders that find the pole. left out: energy explained by leave-one-out, 50 % by chance."
)


@dataclass(frozen=True)
class Options(Printing):
    """List the modes of an object: frequencies, dampings and levels, from all recordings of a capture."""

    capture: tyro.conf.Positional[CaptureFolder]
    """Folder with impacts.csv and the recordings that it names."""
    extraction: ExtractionMethod | None = None
    """How modes are extracted, by default high-resolution: ESPRIT in subbands, which separates modes a few hertz apart.
    short-time: the paper's method, bin by bin of a short-time spectrum."""
    modes: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Maximum number of modes, by default 128."""
    time_zero: TimeZero | None = None
    """Start of the sounds: onset, or peak (paper); by default that of capture.toml."""
    preset: Preset = "default"
    """Defaults of all settings; paper: the published method, from the peak on."""
    settings: SettingsFile = None
    """Use this capture.toml instead of the folder's own."""
    plots: PlotsFolder = None
    """Draw the modes to modes.png in this folder."""

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        _ = self.pipeline
        expect_capture(self.capture, self.settings)

    @property
    def pipeline(self) -> PipelineConfig:
        """The settings of the preset, with those that are given."""
        names = ("extraction", "modes", "time_zero")
        given = {name: value for name in names if (value := getattr(self, name)) is not None}
        return replace(PRESETS[self.preset], **given)


def run(options: Options) -> int:
    """Print the modes."""
    from avmsf.capture import read_capture
    from avmsf.cli.alignment import AlignmentReport
    from avmsf.cli.report import levels, mode_rows, mode_table
    from avmsf.modal.extraction.extract import extract_modes
    from avmsf.modal.extraction.finders import finder_named
    from avmsf.modal.extraction.quality import measure_quality

    config = options.pipeline
    settings = read_settings(options.capture, options.settings).starting(config.time_zero)
    capture = read_capture(options.capture, settings)
    impacts = capture.impacts
    count = counted(len(impacts), "recording")
    doing(f"finding the modes of {count}, {impacts.duration:.3g} s at {impacts.sample_rate:g} Hz")
    extraction = extract_modes(impacts, finder_named(config.extraction, config.modes))
    level = levels(extraction.gains.abs())
    quality = measure_quality(extraction.aligned(impacts).sounds, extraction, sample_rate=impacts.sample_rate)
    columns = {
        "frequency_spread_hertz": quality.frequency_spread,
        "damping_spread_per_second": quality.damping_spread,
        "stable_orders": quality.stable_orders,
        "phase_coherence": quality.coherence,
        "energy_share": quality.energy_share,
        "explained_left_out": quality.explained_left_out,
    }
    rows = mode_rows(extraction.bank, level)
    rows = [row | {name: float(column[place]) for name, column in columns.items()} for place, row in enumerate(rows)]
    every = list(zip(rows, quality.is_mode.tolist(), strict=True))
    modes, supporting = ([row for row, is_mode in every if is_mode is part] for part in (True, False))
    aligned = AlignmentReport.of(extraction, impacts)
    lines = [mode_table(f" of {capture.name}, {count}", modes, len(supporting)), _EXPLANATION]
    show("\n".join([*lines, *([] if aligned is None else aligned.sentences())]), json=options.json)
    if options.plots is not None:
        from avmsf.plotting.pictures import draw_modes, save_picture

        picture = options.plots / "modes.png"
        drawn = f"{counted(len(rows), 'pole')} of {capture.name}, of them {counted(len(modes), 'mode')}"
        save_picture(draw_modes(extraction.bank, level, is_mode=quality.is_mode, title=drawn), picture)
        say(f"wrote {picture}")
    if options.json:
        print_json(
            {
                "capture": capture.name,
                "recordings": len(impacts),
                "sample_rate": impacts.sample_rate,
                "seconds": impacts.duration,
                "method": options.pipeline.extraction,
                "alignment": None if aligned is None else asdict(aligned),
                "modes": modes,
                "supporting_poles": supporting,
            }
        )
    next_command("avmsf fit", options.capture, "-o field.safetensors")
    return 0
