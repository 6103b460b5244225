"""The choice between gain fields: by what they foretell at training contacts left out, and by nothing else."""

from dataclasses import dataclass, field, replace
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
from avmsf.field.store import load, save
from avmsf.field.thinplategains import ThinPlateGains
from avmsf.field.training import TrainableGains
from avmsf.modal.bank import ModalBank
from avmsf.modal.extraction import Extraction
from avmsf.modal.residual import Residual
from avmsf.modal.synthesis import synthesise
from avmsf.scene.features import FeatureField
from plate_field import QUICK

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
    """Splines under another name, whose values are changed, that note what they are made from or will not be made."""

    label: str
    factor: float = 1.0
    most: int = 1000
    """Contacts from which on they cannot be had."""
    seen: list[tuple[str, ...]] = field(default_factory=list)

    @property
    def name(self) -> str:
        return self.label

    def start(self, case: GainCase, damping: str) -> TrainableGains:
        assert damping == SHARED
        self.seen.append(case.train.names)
        if len(case.train) >= self.most:
            raise FitError(f"{self.label} cannot be had of {len(case.train)} contacts")
        known = super().start(case, damping).finished(torch.arange(len(case.modes.bank)))
        assert isinstance(known, ThinPlateGains)
        return RefinedGains(known.with_values(self.factor * known.values), case.modes.bank)


@pytest.mark.parametrize(("kind", "best"), [("linear", "spline"), ("stuffs", "attention")])
def test_the_recipe_that_truly_foretells_best_is_chosen(kind, best):
    things = made(kind)
    told: list[str] = []
    recipes = {each.name: each for each in (Attention(), ThinPlate())}
    choice = Automatic(tuple(recipes.values()), tell=told.append).choose(things.case())
    errors, missing = choice.report["choice"]["errors"], choice.report["choice"]["missing"]
    assert choice.recipe is recipes[best]
    # What is solved for goes first; what is learnt step by step is given up once it can no longer win.
    assert told[:9] == [*(f"choice: spline, {number} of 8" for number in range(1, 9)), "choice: attention, 1 of 8"]
    if best == "attention":
        assert errors["attention"] < 0.7 * errors["spline"]
        assert told[-1] == "choice: attention, 8 of 8"
    else:
        assert errors.keys() == {"spline"}
        assert missing["attention"].startswith(f"given up after {len(told) - 8} of 8 parts: its error is ")
    # At forty contacts that took no part it is the better one as well.
    truly = {}
    for name, recipe in recipes.items():
        sounds = fit(things.train, things.features, things.modes, CONFIG, gains=recipe).render(things.test.contacts)
        truly[name] = float(relative_stft_error(sounds, things.test.sounds, fft_sizes=(1024, 256)).mean())
    assert truly[best] == min(truly.values()) < 0.7 * max(truly.values())


def test_the_error_is_the_mean_over_contacts_each_left_out():
    things = made("stuffs", 6)
    report = Automatic((ThinPlate(), Told("double", 2.0))).choose(things.case()).report["choice"]
    errors = []
    for row in range(6):
        others = [each for each in range(6) if each != row]
        case = things.case().take(others)
        known = ThinPlate().start(case, SHARED).finished(torch.arange(4)).at(things.train.contacts[row : row + 1])
        sound = synthesise(known.mean, BANK.frequency, BANK.damping, samples=SAMPLES, sample_rate=RATE)
        sizes = CONFIG.resolutions(RATE)[0]
        errors.append(float(relative_stft_error(sound, things.train.sounds[row : row + 1], fft_sizes=sizes)[0]))
    assert report["errors"]["spline"] == pytest.approx(sum(errors) / 6, rel=1e-4)
    assert report["errors"]["double"] > report["errors"]["spline"]
    assert report["missing"] == {}


@pytest.mark.parametrize("count", [4, 8, 10, 19])
def test_each_contact_is_left_out_once_and_no_others_are_seen(count):
    things, told = made("linear", count), Told("told")
    Automatic((told, ThinPlate())).choose(things.case())
    assert len(told.seen) == min(8, count)
    assert all(set(names) < set(things.train.names) for names in told.seen)
    left = [name for names in told.seen for name in things.train.names if name not in names]
    assert sorted(left) == sorted(things.train.names)
    assert {count - len(names) for names in told.seen} <= {-(-count // 8), count // 8, 1}


def test_a_silent_recording_is_learnt_from_and_has_no_error_of_its_own():
    things = made("linear", 5)
    silent = things.train.sounds.clone()
    silent[2] = 0.0
    changed = replace(things.case(), train=replace(things.train, sounds=silent))
    whole, part = (
        Automatic((ThinPlate(), Told("other"))).choose(case).report["choice"]["errors"]["spline"]
        for case in (things.case(), changed)
    )
    errors = []
    for row in (0, 1, 3, 4):
        case = things.case().take([each for each in range(5) if each != row])
        known = ThinPlate().start(case, SHARED).finished(torch.arange(4)).at(things.train.contacts[row : row + 1])
        sound = synthesise(known.mean, BANK.frequency, BANK.damping, samples=SAMPLES, sample_rate=RATE)
        truth = things.train.sounds[row : row + 1]
        errors.append(float(relative_stft_error(sound, truth, fft_sizes=CONFIG.resolutions(RATE)[0])[0]))
    # To a silent recording nothing is relative: it has no part in the mean.
    assert part == pytest.approx(sum(errors) / 4, rel=1e-4)
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
        # The first part that it was tried on has two of the ten contacts left out, the third one.
        "broken": "broken cannot be had of 9 contacts",
    }


def test_a_recipe_that_diverges_takes_no_part(tmp_path):
    things = made("linear")
    field = fit(
        things.train,
        things.features,
        things.modes,
        CONFIG,
        gains=Automatic((Told("diverging", float("nan")), ThinPlate())),
    )
    assert field.origin.report["gains"] == "spline"
    assert field.origin.report["choice"]["missing"] == {
        "diverging": "its error at contacts left out is nan: lower warmup_rate"
    }
    # A file holds no such number.
    save(field, tmp_path / "field")
    assert load(tmp_path / "field").origin.report == field.origin.report


def test_where_none_can_be_had_the_first_says_why():
    things = made("linear")
    candidates = (Told("one", most=1), Told("two", most=1))
    with pytest.raises(FitError, match="one cannot be had of 10 contacts"):
        fit(things.train, things.features, things.modes, CONFIG, gains=Automatic(candidates))
    report = Automatic(candidates).choose(things.case()).report["choice"]
    assert report["errors"] == {}
    assert report["missing"].keys() == {"one", "two"}


@pytest.mark.parametrize("count", [1, 2, 3])
def test_too_few_contacts_take_the_first_that_can_be_had(count):
    things = made("linear", count)
    candidates = (Told("broken", most=1), Told("told"), ThinPlate())
    choice = Automatic(candidates, {"physics": "no surface"}).choose(things.case())
    assert choice.recipe is candidates[1]
    assert choice.report["choice"] == {
        "errors": {},
        "missing": {"physics": "no surface", "broken": f"broken cannot be had of {count} contacts"},
    }
    # Nothing was left out: there is nothing to choose by.
    assert candidates[1].seen == [things.train.names]


def test_one_recipe_needs_no_choice():
    told = Told("told")
    choice = Automatic((told,)).choose(made("linear").case())
    assert choice.recipe is told
    assert len(told.seen) == 1


def test_the_choice_is_the_same_every_time_and_leaves_chance_alone():
    things = made("stuffs")
    torch.manual_seed(1)
    first = Automatic().choose(things.case())
    torch.manual_seed(2)
    before = torch.get_rng_state()
    again = Automatic().choose(things.case())
    assert torch.equal(torch.get_rng_state(), before)
    assert first.report == again.report
    assert first.recipe == again.recipe or first.recipe.name == again.recipe.name


def test_a_fit_chooses_unless_it_is_told_and_says_how():
    things = made("linear", 6)
    field = fit(things.train, things.features, things.modes, CONFIG)
    report = field.origin.report
    assert report["gains"] == field.gain_field.kind == "spline"
    assert report["choice"]["errors"].keys() == {"spline"}
    assert report["choice"]["missing"].keys() == {"attention"}
    assert isinstance(field.gain_field, ThinPlateGains)


def test_a_network_without_a_warm_up_is_not_judged_and_the_report_says_why():
    things = made("stuffs")
    case = replace(things.case(), config=replace(CONFIG, warmup_steps=0))
    choice = Automatic((Attention(), ThinPlate())).choose(case)
    assert choice.recipe.name == "spline"
    assert choice.report["choice"]["errors"].keys() == {"spline"}
    assert "not judged: warmup_steps is 0" in choice.report["choice"]["missing"]["attention"]
