"""Time alignment: coherence, delays and errors with starts by threshold and aligned, and with known jitter."""

import math
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf.capture import Capture, CaptureSettings, Impacts, read_capture
from avmsf.capture.audio import read_recording
from avmsf.capture.prepare import margin_length, prepare
from avmsf.capture.table import parse_row, read_rows
from avmsf.errors import CaptureWarning
from avmsf.evaluation.scores import evaluate
from avmsf.evaluation.splits import split
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.attention import Attention
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.trainer import GainEstimator
from avmsf.modal.extraction.alignment import Alignment, align, coherence, strongest_modes
from avmsf.modal.extraction.extract import Extraction, extract_modes
from avmsf.modal.extraction.quality import measure_quality
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import BodyConfig
from avmsf.simulate.ground_truth import read_truth
from avmsf.simulate.recipe import EXAMPLE_FOLDER
from benchmarks.field import QUICK_LOOK, filled_estimator
from benchmarks.look import slab
from benchmarks.material import STRUCK, example_capture, shared_data, surface_features
from benchmarks.modes import AIRCRAFT, LEAST_SHARE, count_modes, tree_frequencies
from benchmarks.report import Options, Report, Table, log

STARTS = (0, 18, 37)
COUNTS = {"aircraft_response": (8, 15, 28), "ruler10": (5, 7), "tree43": (12, 20, 40)}
"""Training contacts of each measured capture."""
JITTERS = ("0", "1", "3", "1 ms")
"""Standard deviations of the starts, samples unless in ms."""
DRAWS = 3
"""Draws of the jitter."""
NOISES = (-20.0, -40.0, -60.0)
"""Levels of noise beneath synthetic recordings, dB."""
CONVENTIONS = (
    "before: every sound starts at the onset that a threshold finds in its own file, as nothing was known of the "
    "others. after: default settings, recordings aligned with the training ones.",
    "coherence: length of the sum of exp(2 i phase) over recordings, added up over modes with the weights "
    "|amplitude|^2 / damping, of the modes extracted; 1 is one phase a mode.",
    "error: relative STFT error at held-out contacts, mean of farthest-point splits from contacts 0, 18 and 37 (as "
    "far as there are so many), all settings CaptureSettings().",
    "rms: root mean square error of the delays against known ones, samples, but for what all have in common; refused: "
    "recordings that are named as not aligned. With jitter: errors are means over draws, the rms the "
    "worst draw's, refused the sum; the ratio is of mean errors, its standard error from their scatter.",
)

Figures = dict[str, float]


def measure(options: Options) -> Report:
    """Return the figures of the chosen parts."""
    report = Report(CONVENTIONS)
    for part in options.parts:
        report += PARTS[part](options)
    return report


def by_threshold(folder: Path) -> Impacts:
    """Read a capture with each sound from its own onset on, final, whatever the others say."""
    settings = CaptureSettings()
    rows, _ = read_rows(folder)
    strikes = [parse_row(row, settings) for row in rows]
    prepared = [
        prepare(read_recording(folder / strike.file, strike.file), settings, newtons=strike.newtons)
        for strike in strikes
    ]
    rate = prepared[0].rate
    length = min(round(settings.kept_seconds(rate) * rate), *(len(each.sound) for each in prepared))
    directions = [strike.direction for strike in strikes]
    return Impacts(
        contacts=torch.tensor([strike.contact for strike in strikes], dtype=torch.float64),
        sounds=torch.from_numpy(np.stack([each.sound[:length] for each in prepared]).astype(np.float32)),
        sample_rate=rate,
        names=tuple(strike.file for strike in strikes),
        directions=None if None in directions else torch.tensor(directions, dtype=torch.float32),
    )


def coherence_of(modes: Extraction) -> float:
    """Return the coherence of an extraction's amplitudes."""
    return coherence(-1j * modes.gains.to(torch.complex128), modes.bank.damping)


def _captures(options: Options) -> Report:
    """Coherence and delays of measured captures, all recordings."""
    rows: list[list[str | float]] = []
    figures: Figures = {}
    for name in (*COUNTS, "bowl_clips"):
        before, after = (
            _bowl(name) if name == "bowl_clips" else (by_threshold(shared_data() / name), _read(name).impacts)
        )
        modes = extract_modes(after)
        assert modes.alignment is not None
        delays = modes.alignment.delays
        values = {
            "before": coherence_of(extract_modes(before)),
            "after": coherence_of(modes),
            "shortest": float(delays.min()),
            "longest": float(delays.max()),
            "refused": float((modes.alignment.agreement < 0.5).sum()),
        }
        log(f"{name}: {values}")
        rows.append([name, float(len(after)), *values.values()])
        figures |= {f"align.{name}.{key}": value for key, value in values.items()}
    figures["align.coherence_before"] = figures["align.aircraft_response.before"]
    figures["align.coherence_after"] = figures["align.aircraft_response.after"]
    columns = ("capture", "recordings", "before", "after", "shortest delay", "longest", "refused")
    return Report(tables=(Table("coherence and delays, samples", columns, rows),), figures=figures)


def _errors(options: Options) -> Report:
    """Held-out errors of gain models without and with a body, and of the network, before and after."""
    rows: list[list[str | float]] = []
    figures: Figures = {}
    for name, counts in COUNTS.items():
        capture = _read(name)
        pair = {"before": by_threshold(shared_data() / name), "after": capture.impacts}
        methods = _methods(capture, options)
        for count in counts[:1] if options.quick_look else counts:
            starts = STARTS[:1] if options.quick_look else [start for start in STARTS if start < len(capture.impacts)]
            errors = {
                (when, method): float(
                    np.mean([_error(impacts, capture, count, start, make, options) for start in starts])
                )
                for method, make in methods.items()
                for when, impacts in pair.items()
            }
            log(f"{name} {count}: {errors}")
            rows += [
                [f"{name}, {count} contacts, {method}", errors["before", method], errors["after", method]]
                for method in methods
            ]
            figures |= {f"align.{name}.{count}.{method}.{when}": error for (when, method), error in errors.items()}
            if name == "aircraft_response":
                figures[f"align.aircraft_{count}"] = errors["after", "auto"]
    table = Table("held-out error, starts by threshold and aligned", ("capture and method", "before", "after"), rows)
    return Report(tables=(table,), figures=figures)


def _jitter(options: Options) -> Report:
    """Errors with artificial jitter of the starts, on the simulated mug and on the plate."""
    with tempfile.TemporaryDirectory() as cache:
        return _jitter_with(options, Path(cache))


def _jitter_with(options: Options, cache: Path) -> Report:
    rows: list[list[str | float]] = []
    figures: Figures = {}
    capture = example_capture()
    truth = read_truth(EXAMPLE_FOLDER)
    assert truth.starts is not None
    assert capture.surface is not None
    plate = STRUCK.strikes(20 if options.quick_look else 40, seconds=1.0)
    # The plate's files: silence before the impact, which begins at their last sample.
    silence = torch.zeros(len(plate), 2 * margin_length(plate.sample_rate))
    body = BodyConfig(dofs=3000) if options.quick_look else BodyConfig()
    mug = MixtureEstimator(bodies=candidate_bodies(capture.surface, body, impacts=capture.impacts, cache=cache))
    cases: dict[str, tuple[Impacts, FeatureField, GainEstimator]] = {
        "mug": (_wide(EXAMPLE_FOLDER, truth.starts), surface_features(capture), mug),
        "plate": (
            replace(plate, before=silence, after=silence),
            STRUCK.features(),
            filled_estimator(slab(STRUCK.plate), options),
        ),
    }
    config = QUICK_LOOK if options.quick_look else FitConfig()
    draws = 1 if options.quick_look else DRAWS
    for name, (files, features, estimator) in cases.items():
        still: dict[str, Float64[Tensor, " draws"]] | None = None
        exact: Float64[Tensor, " contacts"] | None = None
        for jitter in JITTERS:
            errors: dict[str, list[float]] = {"no_body": [], "auto": []}
            away = []
            for seed in range(draws):
                moved, starts = jittered(files, jitter, seed=seed)
                train, test = split(moved, 12)
                modes, found = extract_modes(train), align(moved)
                assert found is not None
                train, test = modes.aligned(train), modes.aligned(test)
                for method, recipe in (("no_body", MixtureEstimator()), ("auto", estimator)):
                    scores = evaluate(fit(train, features, modes, config, gains=recipe), test)
                    errors[method].append(scores.mean()["relative_stft"])
                # Contact times differ, and with them the delays even of recordings that start with their impacts.
                exact = found.delays - starts if exact is None else exact
                away.append(_rms(found, starts + exact))
            drawn = {method: torch.tensor(values, dtype=torch.float64) for method, values in errors.items()}
            still = still or drawn
            ratio, uncertainty = max(_ratio(drawn[method], still[method]) for method in drawn)
            means = {method: float(values.mean()) for method, values in drawn.items()}
            rms, refused = max(each[0] for each in away), sum(each[1] for each in away)
            rows.append([f"{name}, jitter {jitter}", *means.values(), ratio, uncertainty, rms, refused])
            key = f"align.{name}.jitter {jitter}"
            figures |= {f"{key}.{method}": error for method, error in means.items()}
            figures |= {f"{key}.rms": rms, f"{key}.ratio": ratio, f"{key}.ratio_uncertainty": uncertainty}
            log(f"{name}, jitter {jitter}: {errors}, ratio {ratio:.3f} +- {uncertainty:.3f}, rms {rms:.3f}")
    columns = ("object and jitter", "no_body", "auto", "worst ratio to jitter 0", "standard error", "rms", "refused")
    return Report(tables=(Table("held-out error with artificial jitter", columns, rows),), figures=figures)


def _ratio(errors: Float64[Tensor, " draws"], still: Float64[Tensor, " draws"]) -> tuple[float, float]:
    """Return the ratio of two mean errors and its standard error, from the scatter of the draws; NaN for one draw."""
    ratio = float(errors.mean() / still.mean())
    if len(errors) < 2:
        return ratio, math.nan
    relative = (float(each.std() / each.mean()) / math.sqrt(len(each)) for each in (errors, still))
    return ratio, ratio * math.hypot(*relative)


def _modes(options: Options) -> Report:
    """Count the known modes of measured captures that are found, and the others."""
    rows: list[list[str | float]] = []
    figures: Figures = {}
    for key, name, known, share in (
        ("aircraft", "aircraft_response", AIRCRAFT, LEAST_SHARE),
        ("tree", "tree43", tree_frequencies(), 0.0),
    ):
        impacts = _read(name).impacts
        modes = extract_modes(impacts)
        counted = count_modes(impacts, modes, known, least_share=share)
        quality = measure_quality(modes.aligned(impacts).sounds, modes, sample_rate=impacts.sample_rate)
        called = float(quality.is_mode.sum())
        rows.append(
            [name, float(len(modes.bank)), called, float(len(known)), float(counted.found), float(counted.extra)]
        )
        figures |= {f"modes.{key}_found": float(counted.found), f"modes.{key}_extra": float(counted.extra)}
    columns = ("capture", "poles", "modes", "known", "found", "extra")
    title = f"modes; extra ones of the aircraft count from {LEAST_SHARE:.0%} of the energy"
    return Report(tables=(Table(title, columns, rows),), figures=figures)


def _delays(options: Options) -> Report:
    """Delays of synthetic recordings of three and of six modes, and the time that a hundred recordings take."""
    rows: list[list[str | float]] = []
    worst, refusals = 0.0, 0.0
    for modes in (3, 6):
        for noise in NOISES:
            errors = []
            for seed in range(2 if options.quick_look else 10):
                impacts, starts = synthetic(12, modes, jitter=2.0, noise_db=noise, seed=seed)
                rms, refused = _rms(align(impacts), starts)
                errors.append(rms)
                refusals += refused
            rows.append([f"{modes} modes, noise {noise:g} dB", float(np.mean(errors)), max(errors)])
            worst = max(worst, max(errors))
    many, _ = synthetic(100, 24, jitter=2.0, noise_db=-40.0, seed=0, seconds=1.0)
    align(many.take(range(4)))
    begun = time.perf_counter()
    align(many)
    seconds = time.perf_counter() - begun
    begun = time.perf_counter()
    strongest_modes(many)
    extracting = time.perf_counter() - begun
    figures = {"align.delay_rms": worst, "align.delay_refused": refusals, "align.seconds_100": seconds}
    figures["align.seconds_100_without_modes"] = seconds - extracting
    rows.append(["100 recordings of 1 s: seconds, and without the search for modes", seconds, seconds - extracting])
    return Report(
        tables=(Table("delays, samples: mean and worst rms", ("case", "mean", "worst"), rows),), figures=figures
    )


def synthetic(
    contacts: int, modes: int, *, jitter: float, noise_db: float, seed: int, seconds: float = 0.5
) -> tuple[Impacts, Float64[Tensor, " contacts"]]:
    """Return recordings of damped sines with drawn frequencies, phases and gains, and where their impacts fall."""
    generator = torch.Generator().manual_seed(seed)
    rate, lead = 44100.0, margin_length(44100.0)
    frequency = 300 * torch.exp(math.log(20.0) * torch.rand(modes, dtype=torch.float64, generator=generator))
    damping = 5 + frequency / 100
    phase = 2 * math.pi * torch.rand(modes, dtype=torch.float64, generator=generator)
    gains = torch.randn(contacts, modes, dtype=torch.float64, generator=generator)
    starts = jitter * torch.randn(contacts, dtype=torch.float64, generator=generator)
    samples = round(seconds * rate)
    times = (torch.arange(-lead, samples + lead, dtype=torch.float64) - starts[:, None]) / rate
    files = torch.zeros_like(times)
    for mode in range(modes):
        wave = torch.exp(-damping[mode] * times.clamp(min=0)) * torch.sin(
            2 * math.pi * frequency[mode] * times + phase[mode]
        )
        files += gains[:, mode, None] * wave * (times >= 0)
    noise = torch.randn(files.shape, dtype=torch.float64, generator=generator)
    files = (files + files.square().mean().sqrt() * 10 ** (noise_db / 20) * noise).float()
    impacts = Impacts(
        contacts=torch.zeros(contacts, 3),
        sounds=files[:, lead : lead + samples].contiguous(),
        sample_rate=rate,
        names=tuple(f"{row:03d}.wav" for row in range(contacts)),
        before=files[:, :lead].contiguous(),
        after=files[:, lead + samples :].contiguous(),
    )
    return impacts, starts


def jittered(files: Impacts, jitter: str, *, seed: int = 0) -> tuple[Impacts, Float64[Tensor, " contacts"]]:
    """Return recordings read at starts that are off by a normal number, with margins, and how much earlier that is.

    All of them by the same part of a sample more, except in the first draw: impacts do not fall on samples.
    """
    deviation = float(jitter.removesuffix(" ms")) * (1e-3 * files.sample_rate if jitter.endswith("ms") else 1.0)
    generator = torch.Generator().manual_seed(seed)
    delays = deviation * torch.randn(len(files), dtype=torch.float64, generator=generator)
    if seed:
        delays = delays + torch.rand(1, dtype=torch.float64, generator=generator)
    assert files.before is not None
    assert files.after is not None
    lead, tail, samples = files.before.shape[1] // 2, files.after.shape[1] // 2, files.sounds.shape[1]
    whole = torch.cat([files.before, files.sounds, files.after], dim=1)
    inner = replace(
        files,
        sounds=whole[:, lead : lead + lead + samples + tail],
        before=whole[:, :lead],
        after=whole[:, lead + lead + samples + tail :],
    )
    sounds = inner.delayed(delays).sounds
    moved = replace(
        files, sounds=sounds[:, lead : lead + samples], before=sounds[:, :lead], after=sounds[:, lead + samples :]
    )
    return moved, -delays


def _wide(folder: Path, starts: Float64[Tensor, " contacts"]) -> Impacts:
    """Return a simulated capture with every sound from its true start on, and twice the usual margins.

    Its files are divided by the forces already.
    """
    impacts = read_capture(folder).impacts
    margin = 2 * margin_length(impacts.sample_rate)
    files = [torch.from_numpy(read_recording(folder / name).response()).float() for name in impacts.names]
    samples = (
        min(len(file) - math.ceil(float(start)) for file, start in zip(files, starts.tolist(), strict=True)) - margin
    )
    rows = [
        Impacts(
            impacts.contacts[:1],
            torch.nn.functional.pad(file, (margin, 0))[None],
            impacts.sample_rate,
            ("whole",),
        )
        .delayed(torch.tensor([start], dtype=torch.float64))
        .sounds[0, : samples + 2 * margin]
        for file, start in zip(files, starts.tolist(), strict=True)
    ]
    whole = torch.stack(rows)
    return replace(
        impacts,
        sounds=whole[:, margin : margin + samples],
        before=whole[:, :margin],
        after=whole[:, margin + samples :],
    )


def _rms(found: Alignment | None, starts: Float64[Tensor, " contacts"]) -> tuple[float, float]:
    """Return the error of the delays of aligned recordings, and how many are not."""
    assert found is not None
    away = (found.delays - starts)[found.agreement >= 0.5]
    return float((away - away.median()).square().mean().sqrt()), float((found.agreement < 0.5).sum())


def _read(name: str) -> Capture:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CaptureWarning)
        return read_capture(shared_data() / name, CaptureSettings())


def _bowl(name: str) -> tuple[Impacts, Impacts]:
    """Return the bowl's clips by threshold, final, and with what lies around them."""
    settings = CaptureSettings()
    paths = sorted((shared_data() / name).glob("*.wav"))
    recordings = [read_recording(path) for path in paths]
    prepared, rate = [prepare(each, settings) for each in recordings], recordings[0].sample_rate
    samples, margin = round(settings.kept_seconds(rate) * rate), margin_length(rate)
    final = Impacts(
        contacts=torch.zeros(len(paths), 3),
        sounds=torch.from_numpy(np.stack([each.sound[:samples] for each in prepared]).astype(np.float32)),
        sample_rate=rate,
        names=tuple(path.name for path in paths),
    )
    before, after = (
        torch.from_numpy(np.stack(parts).astype(np.float32))
        for parts in (
            [each.before[-margin:] for each in prepared],
            [each.sound[samples : samples + margin] for each in prepared],
        )
    )
    return final, replace(final, before=before, after=after)


def _methods(capture: Capture, options: Options) -> dict[str, Callable[[], GainEstimator]]:
    made: dict[str, Callable[[], GainEstimator]] = {"no_body": MixtureEstimator}
    if capture.surface is not None:
        estimator = filled_estimator(capture.surface, options)
        made["auto"] = lambda: estimator
    return made | {"network": Attention}


def _error(
    impacts: Impacts, capture: Capture, count: int, start: int, make: Callable[[], GainEstimator], options: Options
) -> float:
    train, test = split(impacts, count, start=start)
    modes = extract_modes(train)
    train, test = modes.aligned(train), modes.aligned(test)
    features = FeatureField.from_contacts(impacts.contacts) if capture.surface is None else surface_features(capture)
    config = QUICK_LOOK if options.quick_look else FitConfig()
    return evaluate(fit(train, features, modes, config, gains=make()), test).mean()["relative_stft"]


PARTS = {"captures": _captures, "modes": _modes, "delays": _delays, "jitter": _jitter, "errors": _errors}
