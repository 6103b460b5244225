"""Time alignment: coherence, delays and errors with starts by threshold and aligned, and with known jitter."""

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.capture import CaptureSettings, Impacts, read_capture
from avmsf.capture.audio import read_recording
from avmsf.capture.prepare import margin_length, prepare
from avmsf.capture.table import parse_row, read_rows
from avmsf.evaluation.scores import evaluate
from avmsf.evaluation.splits import split
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.attention import Attention
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.training import GainEstimator
from avmsf.modal.extraction.alignment import Alignment, align, coherence, strongest_modes
from avmsf.modal.extraction.extract import Extraction, extract_modes
from avmsf.modal.extraction.quality import measure_quality
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import BodyConfig
from avmsf.simulate.ground_truth import read_truth
from avmsf.simulate.recipe import EXAMPLE_FOLDER
from benchmarks import objects
from benchmarks.look import slab
from benchmarks.processes import timed
from benchmarks.records import Measurement, Record, Settings, records
from tests.oracles.known_modes import AIRCRAFT, LEAST_SHARE, count_modes, tree_frequencies

ALIGNED = ("aircraft_response", "ruler10", "tree43")
JITTERS = ("0", "1", "3", "1 ms")
"""Standard deviations of the starts, samples unless in ms."""
DRAWS = 3
NOISES = (-20.0, -40.0, -60.0)
"""Levels of noise beneath synthetic recordings, dB."""


def _by_threshold(name: str) -> Impacts:
    """Read a capture with each sound from its own onset on, final, whatever the others say."""
    settings, folder = CaptureSettings(), objects.shared_data() / name
    rows = [parse_row(row, settings) for row in read_rows(folder)[0]]
    prepared = [prepare(read_recording(folder / row.file, row.file), settings, newtons=row.newtons) for row in rows]
    rate = prepared[0].rate
    length = min(round(settings.kept_seconds(rate) * rate), *(len(each.sound) for each in prepared))
    directions = [row.direction for row in rows]
    return Impacts(
        contacts=torch.tensor([row.contact for row in rows], dtype=torch.float64),
        sounds=torch.from_numpy(np.stack([each.sound[:length] for each in prepared]).astype(np.float32)),
        sample_rate=rate,
        names=tuple(row.file for row in rows),
        directions=None if None in directions else torch.tensor(directions, dtype=torch.float32),
    )


def _bowl() -> tuple[Impacts, Impacts]:
    """Return the clips of a bowl by threshold, final, and with what lies around them."""
    settings = CaptureSettings()
    paths = sorted((objects.shared_data() / "bowl_clips").glob("*.wav"))
    recordings = [read_recording(path) for path in paths]
    prepared, rate = [prepare(each, settings) for each in recordings], recordings[0].sample_rate
    samples, margin = round(settings.kept_seconds(rate) * rate), margin_length(rate)
    before, sounds, after = (
        torch.from_numpy(np.stack(parts).astype(np.float32))
        for parts in (
            [each.before[-margin:] for each in prepared],
            [each.sound[:samples] for each in prepared],
            [each.sound[samples : samples + margin] for each in prepared],
        )
    )
    final = Impacts(torch.zeros(len(paths), 3), sounds, rate, tuple(path.name for path in paths))
    return final, replace(final, before=before, after=after)


def _captures(settings: Settings) -> Iterator[Record]:
    """Coherence and delays of measured captures, all recordings.

    before: every sound starts at the onset that a threshold finds in its own file; after: default settings, aligned.
    coherence: length of the sum of exp(2 i phase) over recordings, added up over modes with the weights
    |amplitude|^2 / damping, of the modes extracted; 1 is one phase a mode. unaligned: recordings named as such.
    """
    for name in (*ALIGNED, "bowl_clips"):
        before, after = _bowl() if name == "bowl_clips" else (_by_threshold(name), objects.measured(name).impacts)
        modes = extract_modes(after)
        assert modes.alignment is not None
        delays = modes.alignment.delays
        values = {
            "coherence_before": _coherence(extract_modes(before)),
            "coherence_after": _coherence(modes),
            "shortest_delay": float(delays.min()),
            "longest_delay": float(delays.max()),
            "unaligned": int((modes.alignment.agreement < 0.5).sum()),
        }
        yield from records(values, object=name)


def _coherence(modes: Extraction) -> float:
    return coherence(-1j * modes.gains.to(torch.complex128), modes.bank.damping)


def _errors(settings: Settings) -> Iterator[Record]:
    """Relative STFT error at held-out contacts, starts by threshold (before) and aligned (after).

    Means of farthest-point splits from contacts 0, 18 and 37, as far as there are so many. no_body: kernels of
    positions; auto: a solid body too; network: the attention network, quick settings.
    """
    config = objects.QUICK_FIT if settings.quick else FitConfig()
    for name in ALIGNED:
        capture = objects.measured(name)
        methods: dict[str, GainEstimator] = {"no_body": MixtureEstimator()}
        if capture.surface is not None:
            methods["auto"] = objects.solid_estimator(capture.surface, settings)
        methods["network"] = Attention()
        pair = {"before": _by_threshold(name), "after": capture.impacts}
        for count in settings.some(objects.COUNTS[name]):
            for method, estimator in methods.items():
                errors = {}
                for when, impacts in pair.items():
                    features = objects.features_of(replace(capture, impacts=impacts))
                    starts = settings.some([start for start in objects.STARTS if start < len(impacts)])
                    splits = (split(impacts, count, start=start) for start in starts)
                    errors[when] = float(np.mean([_error(*each, features, estimator, config) for each in splits]))
                yield from records(errors, group=f"{count}.{method}", object=name)


def _error(train: Impacts, test: Impacts, features: FeatureField, estimator: GainEstimator, config: FitConfig) -> float:
    modes = extract_modes(train)
    field = fit(modes.aligned(train), features, modes, config, gains=estimator)
    return evaluate(field, modes.aligned(test)).mean()["relative_stft"]


def _jitter(settings: Settings) -> Iterator[Record]:
    """Errors with artificial jitter of the starts, on the simulated mug and on the plate, 12 training contacts.

    no_body, auto: means over the draws; ratio: of the mean error to that without jitter, the worse of the two, and its
    standard error, from the scatter of the draws; rms: of the delays, but for what all have in common, worst draw;
    unaligned: recordings named as not aligned, all draws.
    """
    capture, truth = objects.example_capture(), read_truth(EXAMPLE_FOLDER)
    assert truth.starts is not None
    plate = objects.STRUCK.strikes(20 if settings.quick else 40, seconds=1.0)
    # The plate's files: silence before the impact, which begins at their last sample.
    silence = torch.zeros(len(plate), 2 * margin_length(plate.sample_rate))
    body = BodyConfig(dofs=5000) if settings.quick else BodyConfig()
    mug = MixtureEstimator(bodies=candidate_bodies(objects.surface_of(capture), body, impacts=capture.impacts))
    flat = objects.solid_estimator(slab(objects.STRUCK.plate), settings)
    cases = {
        "mug": (_wide(EXAMPLE_FOLDER, truth.starts), objects.features_of(capture), mug),
        "plate": (replace(plate, before=silence, after=silence), objects.STRUCK.features(), flat),
    }
    config = objects.QUICK_FIT if settings.quick else FitConfig()
    for name, (files, features, estimator) in cases.items():
        still: dict[str, Float64[Tensor, " draws"]] | None = None
        exact: Float64[Tensor, " contacts"] | None = None
        for jitter in JITTERS:
            drawn: dict[str, list[float]] = defaultdict(list)
            away = []
            for seed in settings.some(range(DRAWS)):
                moved, starts = jittered(files, jitter, seed=seed)
                train, test = split(moved, 12)
                for method, gains in (("no_body", MixtureEstimator()), ("auto", estimator)):
                    drawn[method].append(_error(train, test, features, gains, config))
                found = align(moved)
                assert found is not None
                # Contact times differ, and with them the delays even of recordings that start with their impacts.
                exact = found.delays - starts if exact is None else exact
                away.append(_rms(found, starts + exact))
            errors = {method: torch.tensor(values, dtype=torch.float64) for method, values in drawn.items()}
            still = still or errors
            ratio, uncertainty = max(_ratio(errors[method], still[method]) for method in errors)
            values = {method: float(each.mean()) for method, each in errors.items()}
            values |= {"ratio": ratio, "ratio_uncertainty": uncertainty, "rms": max(each[0] for each in away)}
            yield from records({**values, "unaligned": sum(each[1] for each in away)}, group=jitter, object=name)


def _ratio(errors: Float64[Tensor, " draws"], still: Float64[Tensor, " draws"]) -> tuple[float, float]:
    """Return the ratio of two mean errors and its standard error, from the scatter of the draws; NaN for one draw."""
    ratio = float(errors.mean() / still.mean())
    if len(errors) < 2:
        return ratio, math.nan
    relative = (float(each.std() / each.mean()) / math.sqrt(len(each)) for each in (errors, still))
    return ratio, ratio * math.hypot(*relative)


def _modes(settings: Settings) -> Iterator[Record]:
    """Known modes of measured captures that are found, and extra ones; the aircraft's count from 1 % of the energy."""
    for name, known, share in (
        ("aircraft_response", AIRCRAFT, LEAST_SHARE),
        ("tree43", tree_frequencies(objects.shared_data()), 0.0),
    ):
        impacts = objects.measured(name).impacts
        extraction = extract_modes(impacts)
        counted = count_modes(impacts, extraction, known, least_share=share)
        quality = measure_quality(extraction.aligned(impacts).sounds, extraction, sample_rate=impacts.sample_rate)
        values = {"poles": len(extraction.bank), "modes": int(quality.is_mode.sum()), "known": len(known)}
        yield from records({**values, "found": counted.found, "extra": counted.extra}, object=name)


def _delays(settings: Settings) -> Iterator[Record]:
    """Delays of synthetic recordings of three and of six modes, and the seconds that a hundred recordings take.

    rms: of 12 recordings' delays against known ones, but for what all have in common, mean and worst of ten draws;
    unaligned: recordings named as not aligned, all draws. searching: without the search for modes.
    """
    for modes in (3, 6):
        for noise in NOISES:
            draws = []
            for seed in settings.some(range(10), 2):
                impacts, starts = synthetic(12, modes, jitter=2.0, noise_db=noise, seed=seed)
                draws.append(_rms(align(impacts), starts))
            errors = [rms for rms, _ in draws]
            values = {"mean_rms": float(np.mean(errors)), "worst_rms": max(errors)}
            values["unaligned"] = sum(unaligned for _, unaligned in draws)
            yield from records(values, group=f"{modes} modes, noise {noise:g} dB")
    many, _ = synthetic(100, 24, jitter=2.0, noise_db=-40.0, seed=0, seconds=1.0)
    align(many.take(range(4)))
    _, seconds = timed(lambda: align(many))
    _, extracting = timed(lambda: strongest_modes(many))
    yield from records({"seconds": seconds, "searching_seconds": seconds - extracting}, group="100 recordings")


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
        angle = 2 * math.pi * frequency[mode] * times + phase[mode]
        wave = torch.exp(-damping[mode] * times.clamp(min=0)) * torch.sin(angle)
        files += gains[:, mode, None] * wave * (times >= 0)
    noise = torch.randn(files.shape, dtype=torch.float64, generator=generator)
    files = (files + files.square().mean().sqrt() * 10 ** (noise_db / 20) * noise).float()
    names = tuple(f"{row:03d}.wav" for row in range(contacts))
    return _cut(Impacts(torch.zeros(contacts, 3), files, rate, names), files, lead, samples), starts


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
    sounds = _cut(files, whole, lead, lead + samples + tail).delayed(delays).sounds
    return _cut(files, sounds, lead, samples), -delays


def _cut(impacts: Impacts, whole: Float[Tensor, "contacts all"], lead: int, samples: int) -> Impacts:
    """Return impacts with sounds that start at `lead` of the whole recordings, and what lies around them."""
    parts = (part.contiguous() for part in whole.tensor_split((lead, lead + samples), dim=1))
    before, sounds, after = parts
    return replace(impacts, sounds=sounds, before=before, after=after)


def _wide(folder: Path, starts: Float64[Tensor, " contacts"]) -> Impacts:
    """Return a simulated capture with every sound from its true start on, and twice the usual margins.

    Its files are divided by the forces already.
    """
    impacts = read_capture(folder).impacts
    margin = 2 * margin_length(impacts.sample_rate)
    files = [torch.from_numpy(read_recording(folder / name).response()).float() for name in impacts.names]
    samples = min(len(file) - math.ceil(start) for file, start in zip(files, starts.tolist(), strict=True)) - margin
    rows = []
    for file, start in zip(files, starts, strict=True):
        padded = torch.nn.functional.pad(file, (margin, 0))[None]
        one = Impacts(impacts.contacts[:1], padded, impacts.sample_rate, ("whole",))
        rows.append(one.delayed(start[None]).sounds[0, : samples + 2 * margin])
    return _cut(impacts, torch.stack(rows), margin, samples)


def _rms(found: Alignment | None, starts: Float64[Tensor, " contacts"]) -> tuple[float, int]:
    """Return the error of the delays of aligned recordings, and how many are not."""
    assert found is not None
    away = (found.delays - starts)[found.agreement >= 0.5]
    return float((away - away.median()).square().mean().sqrt()), int((found.agreement < 0.5).sum())


PARTS: dict[str, Measurement] = {
    "captures": _captures,
    "modes": _modes,
    "delays": _delays,
    "jitter": _jitter,
    "errors": _errors,
}
