"""`avmsf modes`: the modes that a capture's recordings have in common."""

from dataclasses import asdict

from avmsf._utils.text import counted
from avmsf.capture import read_capture
from avmsf.cli.alignment import AlignmentReport
from avmsf.cli.mode_table import amplitudes, levels, listed, mode_rows, mode_table, quality_rows
from avmsf.cli.options.checks import read_settings
from avmsf.cli.options.modes import Options
from avmsf.cli.printing import console, next_command, print_json, say
from avmsf.modal.extraction.extract import extract_modes
from avmsf.modal.extraction.quality import measure_quality
from avmsf.pipeline.record import capture_settings_of, finder_of

_EXPLANATION = (
    "±: spread over recordings. energy: share of all. phase: coherence over recordings, 1 if the same in all. orders: "
    "part of the model orders that find the pole. left out: energy explained by leave-one-out, 50 % by chance."
)


def run(options: Options) -> int:
    """Print the modes."""
    known = read_settings(options.capture, options.settings)
    capture = read_capture(options.capture, capture_settings_of(options.pipeline, known))
    impacts = capture.impacts
    count = counted(len(impacts), "recording")
    say(f"finding the modes of {count}, {impacts.duration:.3g} s at {impacts.sample_rate:g} Hz")
    extraction = extract_modes(impacts, finder_of(options.pipeline))
    level = levels(amplitudes(extraction))
    rows = mode_rows(extraction.bank, level)
    quality = measure_quality(extraction.aligned(impacts).sounds, extraction, sample_rate=impacts.sample_rate)
    every = list(zip(rows, quality_rows(quality), quality.is_mode.tolist(), strict=True))
    modes, supporting = ([(row, how) for row, how, is_mode in every if is_mode is part] for part in (True, False))
    of = f" of {capture.name}, {counted(len(impacts), 'recording')}"
    title, most, rest = listed(of, [row for row, _ in modes], len(supporting))
    screen = console(errors=options.json)
    screen.print(mode_table(title, most, {row.number: how for row, how in modes}))
    screen.print(f"{rest}{'. ' if rest else ''}{_EXPLANATION}", soft_wrap=True)
    aligned = AlignmentReport.of(extraction, impacts)
    for sentence in [] if aligned is None else aligned.sentences():
        screen.print(sentence, soft_wrap=True)
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
                "modes": [asdict(row) | asdict(how) for row, how in modes],
                "supporting_poles": [asdict(row) | asdict(how) for row, how in supporting],
            }
        )
    next_command("avmsf fit", options.capture, "-o field.safetensors")
    return 0
