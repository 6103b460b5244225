"""The paper's preset trained to its end, and its error at held-out contacts on the way."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.datasets import CaptureCollection
from avmsf.evaluation.objects import ObjectInputs
from avmsf.evaluation.scores import evaluate
from avmsf.evaluation.simple_methods import MeanWaveform
from avmsf.evaluation.splits import split
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import PAPER, FitConfig
from avmsf.field.gains.attention import Attention
from avmsf.field.gains.data import gain_data
from avmsf.field.training import Targets, TrainingRun
from avmsf.modal.extraction.extract import extract_sounds
from avmsf.modal.extraction.finders import ShortTime
from avmsf.pipeline.config import DESCRIPTORS, PRESETS
from avmsf.simulate.recipe import named_recipe
from avmsf.simulate.simulation import simulate_object
from avmsf.simulate.simulation_folder import write_simulation
from benchmarks.material import shared_data
from benchmarks.report import Options, Report, Table, log

AIRCRAFT = "aircraft_response"
OBJECTS = (AIRCRAFT, "mug-ceramic", "jug-glass")
RATE, SECONDS = 16_000, 0.5
"""Of the simulated recordings: at 48 kHz and 2 s the 10,000 steps take more than five hours an object on two cores."""
PLACES = 8
EVERY = 500
"""Steps between two points of the curve."""
CONVENTIONS = (
    "paper: the preset `paper` for all its steps on one thread, 8 training places, descriptors in place of DINOv2's "
    "features, onto Gaussians of rendered views; recordings start at their peaks, and dampings are shared; simulated "
    f"objects at {RATE / 1000:g} kHz and {SECONDS:g} s. Relative STFT error at all other contacts; `mean of 3` is the "
    "mean of the three nearest recordings.",
)


@dataclass(frozen=True, eq=False)
class _AsTrained:
    """The sounds of a run as it stands."""

    run: TrainingRun
    features: FeatureField
    sample_rate: float

    def render(
        self, contacts: Float[Tensor, "contacts 3"], *, directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts samples"]:
        with torch.no_grad():
            return self.run.sounds(self.features.nearest(contacts))


def paper_runs(options: Options, folder: Path) -> Report:
    """Return the curves of the objects, and what other methods reach."""
    curves: dict[str, dict[int, float]] = {}
    rows: list[list[str | float]] = []
    figures: dict[str, float] = {}
    config = replace(PAPER, damping="shared")
    if options.quick_look:
        config = replace(config, warmup_steps=2, steps=2)
    for name in options.objects or OBJECTS[: 1 if options.quick_look else None]:
        dataset = CaptureCollection(_folder(name, folder), time_zero="peak")
        train, test = split(dataset.capture(name).impacts, PLACES)
        nearest = evaluate(MeanWaveform(train, count=3), test).mean()["relative_stft"]
        log(f"{name}: mean of 3: {nearest:.3f}")
        paper = replace(PRESETS["paper"].scene.lift, encoder=DESCRIPTORS)
        features = ObjectInputs(dataset, folder / "features", paper=paper).features(name, "paper")
        begun = time.perf_counter()
        curves[name] = dict(_curve(name, train, test, features, config))
        seconds = time.perf_counter() - begun
        last = list(curves[name].values())[-1]
        rows.append([name, nearest, last, min(curves[name].values()), seconds / 60])
        found = {"mean of 3": nearest, "paper": last, "minutes": seconds / 60}
        figures |= {f"paper.{name}.{key}": value for key, value in found.items()}
    columns = ("object", "mean of 3", "paper", "paper, best step", "minutes")
    steps = sorted({step for curve in curves.values() for step in curve})
    points: list[list[str | float]] = [
        [f"{step}", *(curve.get(step, float("nan")) for curve in curves.values())] for step in steps
    ]
    tables = (
        Table("held-out error, 8 training places", columns, rows),
        Table("held-out error of the preset `paper` over its steps, warm-up included", ("step", *curves), points),
    )
    return Report(CONVENTIONS, tables, figures)


def _folder(name: str, folder: Path) -> Path:
    """Return the folder that holds an object's folder."""
    if name == AIRCRAFT:
        return shared_data()
    made = folder / "paper"
    if not (made / name).exists():
        recipe = replace(named_recipe(name), sample_rate=RATE, seconds=SECONDS)
        write_simulation(simulate_object(recipe, name=name), made / name)
    return made


def _curve(
    name: str, train: Impacts, test: Impacts, features: FeatureField, config: FitConfig
) -> Iterator[tuple[int, float]]:
    """Yield steps and the error at held-out contacts."""
    modes = extract_sounds(train.sounds, sample_rate=train.sample_rate, method=ShortTime())
    data = gain_data(train, features, modes, config)
    network, rows = Attention().start(data)
    run, targets = TrainingRun(network, data), Targets.of(data, rows)
    end = config.warmup_steps + config.steps
    while True:
        if run.step % EVERY == 0 or run.step == end:
            # Drawing noise for an error must not change the training.
            state = run.generator.get_state()
            error = evaluate(_AsTrained(run, features, train.sample_rate), test).mean()["relative_stft"]
            run.generator.set_state(state)
            log(f"{name}, step {run.step} of {end}: {error:.3f}")
            yield run.step, error
        if run.step == end:
            return
        run.advance(targets)
