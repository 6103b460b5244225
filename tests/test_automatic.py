"""The choice between gain models: by their errors at training contacts left out, and by nothing else."""

from dataclasses import dataclass, replace
from functools import cache

import pytest
import torch

from avmsf.bench.metrics import relative_stft_error
from avmsf.capture.impacts import Impacts
from avmsf.errors import FitError
from avmsf.field.automatic import Automatic
from avmsf.field.fit import fit, gain_case
from avmsf.field.recipes import SHARED, Attention, GainCase, GainRecipe, ThinPlate
from avmsf.field.refinement import RefinedGains
from avmsf.field.thinplategains import ThinPlateGains
from avmsf.field.training import TrainableGains
from avmsf.modal.bank import ModalBank
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.residual import Residual
from avmsf.modal.synthesis import synthesise, synthesise_phased
from avmsf.scene.features import FeatureField
from plate_field import QUICK
from test_physics import CONFIG as DOME_CONFIG
from test_physics import features as dome_features
from test_physics import recipe as dome_physics
from test_physics import recorded as recorded_dome

RATE, SAMPLES = 8000.0, 1200
BANK = ModalBank(
    torch.tensor([310.0, 620.0, 1150.0, 1900.0], dtype=torch.float64),
    torch.tensor([20.0, 30.0, 45.0, 60.0], dtype=torch.float64),
)
CONFIG = replace(QUICK, clusters=4, hidden=24, warmup_steps=60, warmup_rate=1e-2, steps=2, residual=False)


@dataclass(frozen=True, eq=False)
class Made:
    """An object that was struck, and struck once more elsewhere."""

    train: Impacts
    test: Impacts
    modes: Extraction
    features: FeatureField

    def case(self) -> GainCase:
        return gain_case(self.train, self.features, self.modes, CONFIG)


@cache
def made(kind: str, count: int = 10) -> Made:
    """Return a sheet whose gains are linear in place, or are those of the one or the other of two stuffs."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(count + 40, 3, generator=generator) * torch.tensor([0.3, 0.2, 0.0])
    stuff = torch.where(torch.rand(count + 40, 1, generator=generator) < 0.5, -1.0, 1.0)
    if kind == "linear":
        gains = 1.0 + points @ torch.randn(3, len(BANK), generator=generator) * 10.0
        features = FeatureField(points, torch.ones(count + 40, 1), "test")
    else:
        gains = torch.where(stuff < 0, torch.tensor([1.0, 0.1, 0.6, 0.0]), torch.tensor([0.1, 1.0, 0.0, 0.6]))
        features = FeatureField(points, stuff, "test")
    sounds = synthesise(gains, BANK.frequency, BANK.damping, samples=SAMPLES, sample_rate=RATE)
    impacts = Impacts(points.double(), sounds, RATE, tuple(f"{row:02d}" for row in range(count + 40)))
    train = impacts.take(range(count))
    modes = Extraction(BANK, gains[:count], Residual(torch.zeros(17)), torch.zeros(count, len(BANK)))
    return Made(train, impacts.take(range(count, count + 40)), modes, features)


@dataclass(frozen=True, eq=False)
class Told(ThinPlate):
    """Splines under another name, whose values are changed, or that cannot be had."""

    label: str
    factor: float = 1.0
    most: int = 1000
    """Contacts from which on they cannot be had."""

    @property
    def name(self) -> str:
        return self.label

    def start(self, case: GainCase, damping: str) -> TrainableGains:
        assert damping == SHARED
        if len(case.train) >= self.most:
            raise FitError(f"{self.label} cannot be had of {len(case.train)} contacts")
        known = super().start(case, damping).finished(torch.arange(len(case.modes.bank)))
        assert isinstance(known, ThinPlateGains)
        return RefinedGains(known.with_values(self.factor * known.values), case.modes.bank)


def left_out_errors(case: GainCase, places: list[list[int]]) -> list[float]:
    """Return the error at each contact of splines that are solved without its place."""
    errors = []
    for rows in places:
        others = case.take([each for each in range(len(case.train)) if each not in rows])
        known = ThinPlate().start(others, SHARED).finished(torch.arange(len(BANK))).at(case.train.contacts[rows])
        sounds = synthesise(known.mean, BANK.frequency, BANK.damping, samples=SAMPLES, sample_rate=RATE)
        sizes = CONFIG.resolutions(RATE)[0]
        errors += relative_stft_error(sounds, case.train.sounds[rows], fft_sizes=sizes).tolist()
    return errors


@pytest.mark.parametrize("best", ["physics", "spline"])
def test_the_recipe_that_truly_predicts_best_is_chosen(best: str):
    """On a dome that rings as its shape does, and on one whose gains are linear in place."""
    train, modes = recorded_dome(12)
    others, _ = recorded_dome(40, seed=3)
    if best == "spline":
        slopes = torch.randn(3, len(modes.bank), generator=torch.Generator().manual_seed(1))
        still = torch.zeros_like(modes.bank.frequency)
        gains = [1.0 + impacts.contacts.float() @ slopes * 10.0 for impacts in (train, others)]
        options = {"samples": train.sounds.shape[1], "sample_rate": train.sample_rate}
        sounds = [synthesise_phased(each, modes.bank.frequency, modes.bank.damping, still, **options) for each in gains]
        train, others = replace(train, sounds=sounds[0]), replace(others, sounds=sounds[1])
        modes = replace(modes, gains=gains[0])
    recipes = {each.name: each for each in (dome_physics(), ThinPlate())}
    case = gain_case(train, dome_features(), modes, DOME_CONFIG)
    choice = Automatic(tuple(recipes.values())).choose(case)
    assert choice.recipe is recipes[best]
    errors = choice.report["choice"]["errors"]
    assert errors.keys() == recipes.keys()
    assert choice.report["choice"]["missing"] == {}
    # At forty contacts that took no part it is the better one as well, and about as good as was said.
    truly = {}
    for name, recipe in recipes.items():
        field = fit(train, dome_features(), modes, DOME_CONFIG, gains=recipe)
        sounds = field.render(others.contacts, directions=others.directions)
        truly[name] = float(relative_stft_error(sounds, others.sounds, fft_sizes=(1024, 256)).mean())
    assert truly[best] == min(truly.values()) < 0.9 * max(truly.values())
    assert errors[best] == min(errors.values()) < 0.9 * max(errors.values())


def test_the_error_is_the_mean_over_contacts_whose_place_is_left_out():
    things = made("stuffs", 9)
    # Two more blows at the first place: the others say nothing of it.
    case = things.case().take([*range(9), 0, 0])
    report = Automatic((ThinPlate(), Told("double", 2.0))).choose(case).report["choice"]
    errors = left_out_errors(case, [[0, 9, 10], *([row] for row in range(1, 9))])
    assert report["errors"]["spline"] == pytest.approx(sum(errors) / 11, rel=1e-4)
    assert report["errors"]["double"] > report["errors"]["spline"]
    assert report["missing"] == {}


def test_a_silent_recording_is_learnt_from_and_has_no_error_of_its_own():
    things = made("stuffs", 9)
    silent = things.train.sounds.clone()
    silent[2] = 0.0
    changed = replace(things.case(), train=replace(things.train, sounds=silent))
    whole, part = (Automatic().choose(case).report["choice"]["errors"]["spline"] for case in (things.case(), changed))
    errors = left_out_errors(things.case(), [[row] for row in range(9) if row != 2])
    # To a silent recording nothing is relative: it has no part in the mean.
    assert part == pytest.approx(sum(errors) / 8, rel=1e-4)
    assert part != pytest.approx(whole, rel=1e-3)


@pytest.mark.parametrize("first", [True, False])
def test_a_recipe_that_cannot_be_had_is_named_with_its_reason_and_takes_no_part(first):
    things, broken = made("linear"), Told("broken", most=9)
    candidates: tuple[GainRecipe, ...] = (broken, ThinPlate(), Told("halved", 0.5))
    unavailable = {"physics": "there is no surface"}
    choice = Automatic(candidates if first else candidates[::-1], unavailable).choose(things.case())
    assert choice.recipe.name == "spline"
    assert choice.report["choice"]["errors"].keys() == {"spline", "halved"}
    assert choice.report["choice"]["missing"] == {
        "physics": "there is no surface",
        "broken": "broken cannot be had of 10 contacts",
    }


def test_where_none_can_be_had_the_first_says_why():
    things = made("linear")
    candidates = (Told("one", most=1), Told("two", most=1))
    with pytest.raises(FitError, match="one cannot be had of 10 contacts"):
        fit(things.train, things.features, things.modes, CONFIG, gains=Automatic(candidates))
    report = Automatic(candidates).choose(things.case()).report["choice"]
    assert report["errors"] == {}
    assert report["missing"].keys() == {"one", "two"}


@pytest.mark.parametrize("places", [1, 2, 3])
@pytest.mark.parametrize("copies", [1, 4])
def test_too_few_places_take_the_first_that_can_be_had(places, copies):
    things = made("linear", places)
    candidates = (Told("broken", most=1), Told("told", 2.0), ThinPlate())
    case = things.case().take([*range(places)] * copies)
    choice = Automatic(candidates, {"physics": "no surface"}).choose(case)
    # Nothing was left out: there is nothing to choose by.
    assert choice.recipe is candidates[1]
    assert choice.report["choice"] == {
        "errors": {},
        "missing": {"physics": "no surface", "broken": f"broken cannot be had of {places * copies} contacts"},
    }


def test_a_network_is_taken_only_where_no_other_recipe_can_be_had():
    things = made("stuffs")
    assert Automatic((Attention(), ThinPlate())).choose(things.case()).recipe.name == "spline"
    choice = Automatic((Told("broken", most=1), Attention())).choose(things.case())
    assert choice.recipe.name == "attention"
    assert choice.report["choice"]["errors"] == {}
    assert choice.report["choice"]["missing"].keys() == {"broken"}


def test_the_choice_is_the_same_every_time_and_leaves_chance_alone():
    things = made("stuffs")
    torch.manual_seed(1)
    first = Automatic().choose(things.case())
    torch.manual_seed(2)
    before = torch.get_rng_state()
    again = Automatic().choose(things.case())
    assert torch.equal(torch.get_rng_state(), before)
    assert first.report == again.report


def test_a_fit_takes_splines_unless_it_is_told_and_says_how():
    things = made("linear", 6)
    field = fit(things.train, things.features, things.modes, CONFIG)
    report = field.origin.report
    assert report["gains"] == field.gain_field.kind == "spline"
    assert report["choice"]["errors"].keys() == {"spline"}
    assert report["choice"]["missing"] == {}
    assert isinstance(field.gain_field, ThinPlateGains)
