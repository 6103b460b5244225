"""The recipe of elastic shapes: what it refuses, what it reports, and how far it carries."""

import math
from dataclasses import dataclass, field, replace
from functools import cache

import pytest
import torch

from avmsf.capture.impacts import Impacts
from avmsf.capture.surface import Surface
from avmsf.errors import FitError
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit, gain_case
from avmsf.field.modalbasis import ModalBasis
from avmsf.field.physics import Physics, gain_variance
from avmsf.field.recipes import GainCase, ThinPlate
from avmsf.modal.bank import ModalBank
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.least_squares import fit_sine_gains
from avmsf.modal.residual import Residual
from avmsf.modal.synthesis import synthesise_phased
from avmsf.pipeline.physics import physics_of
from avmsf.scene.features import FeatureField
from avmsf.simulate.nominal import NominalBodies, NominalBody
from made_dome import STIFFER, WALLS, bodies, dome, points, truth

RATE, SAMPLES, LEVEL = 12000.0, 2400, 0.01
CONFIG = FitConfig(warmup_steps=0, steps=6, fft_sizes=(1024, 256), early=1024, damping="shared")


def recipe() -> Physics:
    return Physics(NominalBodies(bodies(), {}))


@dataclass
class Finer:
    """Makes bodies finer in name alone, and remembers which."""

    fineness: str = ""
    asked: list[NominalBody] = field(default_factory=list)

    def __call__(self, body: NominalBody) -> NominalBody:
        self.asked.append(body)
        return replace(body, fine=True)

    def digest(self) -> str:
        return self.fineness


def features() -> FeatureField:
    return FeatureField.from_points(points())


def modes_of(contacts: torch.Tensor, directions: torch.Tensor) -> tuple[ModalBank, torch.Tensor]:
    """Return what of the dome's modes lies below half the sample rate, and their gains."""
    elastic = truth(WALLS[1])
    heard = torch.nonzero(elastic.frequency < 0.45 * RATE).flatten()
    gains = elastic.gains(contacts, directions)[:, heard]
    frequency = elastic.frequency[heard]
    return ModalBank(frequency, 8.0 + 0.004 * frequency), (gains / 3.0).float()


@cache
def recorded(count: int, seed: int = 0) -> tuple[Impacts, Extraction]:
    """Return blows on the dome, noise and all, with its modes as extracted from them."""
    generator = torch.Generator().manual_seed(seed)
    contacts = points()[torch.randperm(len(points()), generator=generator)[:count]]
    directions = -truth(WALLS[1]).normals(contacts)
    bank, gains = modes_of(contacts, directions)
    still = torch.zeros_like(bank.frequency)
    sounds = synthesise_phased(gains, bank.frequency, bank.damping, still, samples=SAMPLES, sample_rate=RATE)
    sounds = sounds + LEVEL * torch.randn(sounds.shape, generator=generator)
    names = tuple(f"dome/{row:02d}" for row in range(count))
    impacts = Impacts(contacts, sounds, RATE, names, directions.float())
    found = fit_sine_gains(sounds, bank, sample_rate=RATE)
    residual = Residual(torch.full((65,), LEVEL))
    return impacts, Extraction(bank, found, residual, torch.zeros_like(found))


def case(count: int = 12, **changes) -> GainCase:
    impacts, modes = recorded(count)
    return gain_case(replace(impacts, **changes), features(), modes, CONFIG)


def test_fitted_end_to_end_it_foretells_what_splines_cannot():
    impacts, modes = recorded(10)
    others, _ = recorded(40, seed=3)
    _, gains = modes_of(others.contacts, others.directions.double())
    errors = {}
    for gain_recipe in (recipe(), ThinPlate()):
        field = fit(impacts, features(), modes, CONFIG, gains=gain_recipe)
        found = field.gains(others.contacts, directions=others.directions)
        turned = found * torch.cos(field.phase).float()
        errors[gain_recipe.name] = float((turned - gains).square().mean() / gains.square().mean()) ** 0.5
        if gain_recipe.name == "physics":
            assert field.gain_field.kind == "physics"
            assert field.origin.report["gains"] == "physics"
            assert field.origin.report["body"] == bodies()[1].name
            assert field.origin.report["factor"] == pytest.approx(STIFFER, rel=0.06)
            assert field.origin.report["suspects"] == {}
    assert errors["physics"] < 0.5 * errors["spline"]


def test_suspects_are_named_and_all_bodies_told():
    impacts, _ = recorded(12)
    directions = impacts.directions.clone()
    directions[5] *= -1
    report = recipe().start(case(directions=directions), "shared").report
    assert list(report["suspects"]) == ["dome/05"]
    assert "dome/05 fits best" in report["suspects"]["dome/05"]
    assert "with its direction reversed" in report["suspects"]["dome/05"]
    assert report["bodies"][0]["lag"] == 0.0
    assert {each["body"] for each in report["bodies"]} <= {body.name for body in bodies()}


def test_the_chosen_body_alone_is_made_finer():
    finer = Finer()
    started = replace(recipe(), finer=finer).start(case(), "shared")
    assert finer.asked == [bodies()[1]]
    assert started.report["body"] == finer.asked[0].name


def test_the_body_that_is_made_finer_is_the_chosen_one_and_no_namesake():
    finer = Finer()
    # Both are walls of 4 mm by name; the wrong one comes first.
    bad, good = (replace(body, wall=wall) for body, wall in zip(bodies()[:2], (0.00404, 0.00396), strict=True))
    assert bad.name == good.name
    report = Physics(NominalBodies((bad, good), {}), finer).start(case(), "shared").report
    assert finer.asked == [good]
    assert report["wall"] == 0.00396
    assert {each["wall"] for each in report["bodies"]} <= {0.00404, 0.00396}


def test_a_body_that_stayed_coarse_is_told():
    assert recipe().start(case(), "shared").report["fine"]
    coarse = tuple(replace(body, fine=False) for body in bodies()[1:2])
    assert not Physics(NominalBodies(coarse, {})).start(case(), "shared").report["fine"]


def test_another_fineness_is_another_recipe():
    digests = {replace(recipe(), finer=each).digest() for each in (None, Finer("20000"), Finer("40000"))}
    assert len(digests) == 3


def test_a_suspect_is_neither_trained_on_nor_moved():
    impacts, _ = recorded(12)
    directions = impacts.directions.clone()
    directions[5] *= -1
    started = recipe().start(case(directions=directions), "shared")
    assert started.heeded(12) == [row for row in range(12) if row != 5]
    with torch.no_grad():
        started.shift += 1.0
    moved = started.finished(torch.arange(started.shift.shape[1])).values - started.field.values
    assert float(moved[5].abs().max()) == 0.0
    assert float(moved[4, :, 0].min()) > 0.0
    assert recipe().start(case(), "shared").heeded(12) == list(range(12))


def test_blows_along_which_nothing_moves_are_refused():
    still = [replace(each, elastic=replace(each.elastic, shapes=0.0 * each.elastic.shapes)) for each in bodies()[:1]]
    moving = replace(still[0].elastic, shapes=still[0].elastic.shapes + torch.tensor([0.0, 1.0, 0.0]))
    known = Physics(NominalBodies((replace(still[0], elastic=moving),), {}))
    along = torch.tensor([1.0, 0.0, 0.0]).expand(12, 3)
    with pytest.raises(FitError, match=r"no elastic shape of the body, .*, moves along the blows at all: check nx"):
        known.start(case(directions=along), "shared")


def test_reasons_against_other_bodies_are_told():
    known = Physics(NominalBodies(bodies()[1:2], {None: "the mesh is open"}))
    refused = known.start(case(), "shared").report["bodies_refused"]
    assert refused == [{"body": "filled", "wall": None, "reason": "the mesh is open"}]


def test_bodies_that_differ_have_different_digests():
    assert recipe().digest() == recipe().digest()
    assert Physics(NominalBodies(bodies()[:2], {})).digest() != recipe().digest()


def test_a_case_without_directions_is_struck_straight_in():
    started = recipe().start(case(directions=None), "shared")
    found = started.finished(torch.arange(3))
    assert isinstance(found, ModalBasis)
    straight = -truth(WALLS[1]).normals(recorded(12)[0].contacts)
    assert float((found.directions * straight).sum(1).min()) > 0.99


def test_fewer_than_three_strikes_are_refused():
    with pytest.raises(FitError, match=r"physics needs 3 strikes or more .*found 2: strike more places"):
        recipe().start(case(2), "shared")
    assert recipe().start(case(3), "shared").report["body"]


def test_strikes_in_one_place_are_refused():
    contacts = points()[:1] + 1e-4 * torch.randn(12, 3, generator=torch.Generator().manual_seed(0))
    with pytest.raises(FitError, match=r"all 12 strikes lie within .* on an object of 0\.\d+ m: strike it in several"):
        recipe().start(case(contacts=contacts), "shared")


@pytest.mark.parametrize("length", [0.0, math.nan])
def test_directions_of_no_length_are_refused_by_name(length: float):
    directions = recorded(12)[0].directions.clone()
    directions[7] = length
    with pytest.raises(FitError, match="dome/07: its direction is a vector of length zero: give the way the hammer"):
        recipe().start(case(directions=directions), "shared")


def test_the_variance_by_noise_is_the_scatter_of_least_squares_gains():
    """Over 3000 draws of white noise, each mode alone: a variance of so many is good to 3 %."""
    still, draws = torch.zeros(1, dtype=torch.float64), 3000
    noise = LEVEL * torch.randn(draws, SAMPLES, generator=torch.Generator().manual_seed(2))
    gains = torch.zeros(draws, 1)
    impacts = Impacts(torch.zeros(draws, 3), noise, RATE, tuple(str(row) for row in range(draws)))
    for frequency, damping in ((800.0, 3.0), (2500.0, 60.0)):
        bank = ModalBank(still + frequency, still + damping)
        modes = Extraction(bank, gains, Residual(torch.full((65,), LEVEL)), gains)
        made = GainCase(impacts, features(), modes, still, gains, CONFIG)
        scatter = float(fit_sine_gains(noise, bank, sample_rate=RATE).double().square().mean())
        assert float(gain_variance(made)) == pytest.approx(scatter, rel=0.1)


def with_body(moved) -> Physics:
    """Return the recipe of a body whose surface lies where `moved` says."""
    body = bodies()[1]
    return Physics(NominalBodies((replace(body, elastic=replace(body.elastic, nodes=moved(body.elastic.nodes))),), {}))


ELSEWHERE = {
    r"multiplied by 1000 they lie within .*: is the surface's unit mm\? State each one's unit": lambda x: 1000.0 * x,
    r"multiplied by 39.37 .*: is the surface's unit inches\?": lambda x: x / 0.0254,
    r"with \(x, y, z\) taken as .* another axis point up\? Undo this": lambda x: (
        x[:, [0, 2, 1]] * x.new_tensor([1, -1, 1])
    ),
    r"no change of unit, axes or origin .*; bring both into one frame": lambda x: (
        x @ torch.linalg.qr(torch.tensor([[1.0, 2, 3], [3, 1, -2], [1, -4, 1]]).double()).Q + 0.07
    ),
}


@pytest.mark.parametrize("message", ELSEWHERE)
def test_a_body_in_another_unit_or_frame_than_the_contacts_is_refused_with_what_would_fit(message: str):
    with pytest.raises(FitError, match=f"physics needs contacts on the surface .*{message}"):
        with_body(ELSEWHERE[message]).start(case(), "shared")


def test_points_of_features_in_another_frame_are_refused():
    elsewhere = FeatureField.from_points(1000.0 * points())
    with pytest.raises(FitError, match=r"physics needs points of the features on the surface .* divided by 1000"):
        recipe().start(replace(case(), features=elsewhere), "shared")


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, 12])
def test_rough_surfaces_thick_glue_and_a_wrong_row_are_not_refused(count: int):
    generator = torch.Generator().manual_seed(4)
    contacts = recorded(count)[0].contacts
    size = float((points().amax(0) - points().amin(0)).norm())
    rough = with_body(lambda x: x + 0.02 * size * torch.randn(x.shape, generator=generator, dtype=x.dtype))
    above = contacts + 0.03 * size * torch.tensor([0.0, 0.0, 1.0])
    above[-1] += 0.5 * size
    for known, each in ((rough, contacts), (recipe(), above)):
        assert known.start(case(count, contacts=each), "shared").report["body"]


def test_contacts_elsewhere_are_refused_before_any_body_is_made():
    told: list[str] = []
    surface = Surface(1000.0 * dome().vertices, dome().faces)
    with pytest.raises(FitError, match=r"is the surface's unit mm\?"):
        physics_of(surface, impacts=recorded(12)[0], tell=told.append)
    assert told == []
