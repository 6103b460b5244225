"""Which settings of the network the quick recipe has, and what others would do: without any test contact.

Two plates that no other benchmark strikes, and parts of the aircraft's training contacts of the `field` benchmark, are
split once more; what is held out here trains there. The warm-up alone is run, which is where the settings act.
"""

from dataclasses import replace

from avmsf.capture import Impacts
from avmsf.evaluation.simple_methods import MeanWaveform
from avmsf.evaluation.splits import evaluate, split
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.recipes import Attention
from avmsf.modal.extraction.extract import Extraction, extract_modes
from benchmarks.material import PlateCase, capture_in_place, surface_features
from benchmarks.report import Options, Report, Table, log
from tests.oracles.plate import Plate

PARTS = ("network",)
GLASS = PlateCase(
    Plate(length=0.3, width=0.22, thickness=0.005, young=6.2e10, density=2600.0, poisson=0.2, alpha=8.0, beta=1e-7),
    3e-4,
)
WOOD = PlateCase(
    Plate(length=0.2, width=0.17, thickness=0.004, young=1.1e10, density=750.0, poisson=0.25, alpha=30.0, beta=1e-6),
    6e-4,
)
AIRCRAFT = ((28, 18, 14), (28, 37, 14), (15, 18, 8), (28, 0, 9))
"""Training contacts of `field`, their start, and how many of them are trained on here."""
BASE = FitConfig(steps=0, damping="shared", residual=False)
VARIANTS = {
    "chosen": BASE,
    "hidden 256": replace(BASE, hidden=256),
    "2 layers": replace(BASE, layers=2),
    "4 layers": replace(BASE, layers=4),
    "8 clusters": replace(BASE, clusters=8),
    "32 clusters": replace(BASE, clusters=32),
    "1 band": replace(BASE, bands=1),
    "feature scale 2": replace(BASE, feature_scale=2.0),
    "feature scale 8": replace(BASE, feature_scale=8.0),
    "weight decay .3": replace(BASE, weight_decay=0.3),
    "weight decay 3": replace(BASE, weight_decay=3.0),
    "warm-up rate 1e-3": replace(BASE, warmup_rate=1e-3),
    "500 steps": replace(BASE, warmup_steps=500),
    "paper's network": replace(
        BASE, clusters=128, bands=4, width=128, hidden=256, layers=2, feature_scale=1.0, weight_decay=0.0
    ),
}
SEEDS = (0, 1)

Case = tuple[Impacts, Impacts, Extraction, FeatureField]


def measure(options: Options) -> Report:
    """Return the mean held-out error of every variant."""
    cases = _cases(options)
    variants = dict(list(VARIANTS.items())[:2]) if options.quick_look else VARIANTS
    rows: list[list[str | float]] = []
    figures = {}
    for name, config in variants.items():
        small = replace(config, warmup_steps=20) if options.quick_look else config
        errors = [_error(case, small) for case in cases]
        figures[f"settings.{name.replace(' ', '_')}"] = sum(errors) / len(errors)
        rows.append([name, *errors, figures[f"settings.{name.replace(' ', '_')}"]])
        log(f"{name}: {rows[-1][-1]:.4f}")
    nearby = [evaluate(MeanWaveform(train), test).mean()["relative_stft"] for train, test, _, _ in cases]
    rows.append(["knn3_waveform", *nearby, sum(nearby) / len(nearby)])
    columns = ("variant", "glass", "wood", *(f"aircraft {part} of {count}" for count, _, part in AIRCRAFT), "mean")
    convention = (
        "error: relative STFT error of the warm-up, no residual, shared damping, mean of seeds 0 and 1, on contacts "
        "held out of training contacts; each variant differs from the chosen settings in what it is named for."
    )
    return Report(
        (convention,), (Table("settings of the network", (*columns[: len(cases) + 1], "mean"), rows),), figures
    )


def _cases(options: Options) -> list[Case]:
    cases = []
    for plate in (GLASS, WOOD):
        train, test = split(plate.strikes(60, seconds=1.0, highest=6000.0), 15)
        cases.append((train, test, extract_modes(train), plate.features()))
    if options.quick_look:
        return cases[:1]
    capture = capture_in_place("aircraft_response")
    features = surface_features(capture)
    for count, start, part in AIRCRAFT:
        train, test = split(split(capture.impacts, count, start=start)[0], part)
        modes = extract_modes(train)
        cases.append((modes.aligned(train), modes.aligned(test), modes, features))
    return cases


def _error(case: Case, config: FitConfig) -> float:
    train, test, modes, features = case
    fields = [fit(train, features, modes, replace(config, seed=seed), gains=Attention()) for seed in SEEDS]
    return sum(evaluate(field, test).mean()["relative_stft"] for field in fields) / len(fields)
