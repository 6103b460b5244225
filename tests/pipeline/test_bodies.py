"""Bodies behind a surface as hypotheses: what they predict, and which of them is made finer."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import pytest
import torch
import trimesh

from avmsf.capture.impacts import Impacts
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import FitError, SceneError, SimulationError
from avmsf.features.feature_field import FeatureField
from avmsf.fem import body_meshes
from avmsf.fem.body_meshes import shape_solid
from avmsf.fem.candidate_bodies import CandidateBodies, CandidateBody
from avmsf.field.config import FitConfig, GainModelName
from avmsf.field.fit import fit
from avmsf.field.gains.data import GainData, gain_data, gain_variance
from avmsf.field.gains.estimator import MixtureEstimator, estimator_for
from avmsf.field.quality import ProbableBody
from avmsf.mesh.level_set import difference
from avmsf.mesh.surface import Surface
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.least_squares import fit_sine_gains
from avmsf.modal.modes import ModalBank, synthesize
from avmsf.modal.residual_noise import Residual
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import BodyConfig
from factories.known_bodies import KnownBodies
from factories.made_dome import STIFFER, WALLS, bodies, dome, points, truth
from factories.raising import raises

RATE, SAMPLES, LEVEL = 12000.0, 2400, 0.01
CONFIG = FitConfig(warmup_steps=0, steps=6, fft_sizes=(1024, 256), early=1024, damping="shared")


class Asked(KnownBodies):
    """Makes bodies finer in name alone, and remembers which were asked for."""

    def __init__(self, *known: CandidateBody) -> None:
        super().__init__(known or bodies())
        self.asked: list[CandidateBody] = []

    def refined(self, body: CandidateBody) -> CandidateBody:
        self.asked.append(body)
        return replace(body, fine=True)


def estimator(*known: CandidateBody, kinds: tuple[str, ...] = ()) -> MixtureEstimator:
    """Return the estimator of these bodies, or of all the dome's."""
    candidates = KnownBodies(known or bodies())
    return MixtureEstimator(kinds, candidates) if kinds else MixtureEstimator(bodies=candidates)


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
    """Return impacts on the dome, noise and all, with its modes as extracted from them."""
    generator = torch.Generator().manual_seed(seed)
    contacts = points()[torch.randperm(len(points()), generator=generator)[:count]]
    directions = -truth(WALLS[1]).normals(contacts)
    bank, gains = modes_of(contacts, directions)
    still = torch.zeros_like(bank.frequency)
    sounds = synthesize(gains, bank.frequency, bank.damping, still, samples=SAMPLES, sample_rate=RATE)
    sounds = sounds + LEVEL * torch.randn(sounds.shape, generator=generator)
    names = tuple(f"dome/{row:02d}" for row in range(count))
    impacts = Impacts(contacts, sounds, RATE, names, directions.float())
    found = fit_sine_gains(sounds, bank, sample_rate=RATE)
    residual = Residual(torch.full((65,), LEVEL))
    return impacts, Extraction(bank, found + 0j, residual)


def case(count: int = 12, **changes: torch.Tensor | None) -> GainData:
    impacts, modes = recorded(count)
    return gain_data(replace(impacts, **changes), features(), modes, CONFIG)


@pytest.mark.slow
def test_bodies_halve_the_error_between_impacts() -> None:
    impacts, modes = recorded(10)
    others, _ = recorded(40, seed=3)
    _, gains = modes_of(others.contacts, others.directions.double())

    def error(gain_recipe: MixtureEstimator) -> float:
        fitted = fit(impacts, features(), modes, CONFIG, gains=gain_recipe)
        found = fitted.gains(others.contacts, directions=others.directions) * torch.cos(fitted.phase).float()
        return float((found - gains).square().mean() / gains.square().mean()) ** 0.5

    assert error(estimator()) < 0.5 * error(MixtureEstimator())


def test_the_true_wall_and_its_stiffness_are_the_most_probable() -> None:
    candidates = Asked()
    first, *others = MixtureEstimator(bodies=candidates).solve(case())[0].report["bodies"]
    assert first["body"] == bodies()[1].name
    # Factors of the grid are 5 % apart.
    assert first["frequency_factor"] == pytest.approx(STIFFER, rel=0.06)
    assert first["weight"] > 10 * max(each["weight"] for each in others)
    # Fine bodies are not computed again.
    assert candidates.asked == []


def test_a_mesh_in_centimeters_is_said_to_be() -> None:
    """Read in meters, it has frequencies a hundredth of the object's."""
    slow = [replace(each, elastic=replace(each.elastic, frequency=each.elastic.frequency / 100)) for each in bodies()]
    candidates = KnownBodies(slow)
    candidates.unit_ratios = CaptureSettings().unit_ratios(8.0)
    report = MixtureEstimator(bodies=candidates).solve(case())[0].report
    assert (report["bodies"][0]["body"], report["bodies"][0]["unit"]) == (bodies()[1].name, "cm")
    assert report["bodies"][0]["frequency_factor"] == pytest.approx(STIFFER, rel=0.06)
    found = ProbableBody.of(report)
    assert found is not None
    assert 'unit = "cm"' in found.warning


def test_the_most_probable_body_alone_is_made_finer_and_not_its_namesake() -> None:
    # Both are walls of 4 mm by name; the wrong one comes first.
    bad, good = (
        replace(body, thickness=wall, fine=False) for body, wall in zip(bodies()[:2], (0.00404, 0.00396), strict=True)
    )
    assert bad.name == good.name
    candidates = Asked(bad, good)
    first, second = MixtureEstimator(bodies=candidates).solve(case())[0].report["bodies"]
    assert candidates.asked == [good]
    assert (first["wall_thickness"], first["refined"]) == (0.00396, True)
    assert (second["wall_thickness"], second["refined"]) == (0.00404, False)


def test_estimators_of_other_bodies_or_elements_have_other_digests() -> None:
    assert estimator().digest() == estimator().digest()
    finer = [KnownBodies(bodies()) for _ in range(2)]
    finer[0].dofs, finer[1].dofs = 20_000, 40_000
    made = (estimator(), estimator(*bodies()[:2]), *(MixtureEstimator(bodies=each) for each in finer))
    assert len({each.digest() for each in made}) == len(made)


def test_the_variance_by_noise_is_the_scatter_of_least_squares_gains() -> None:
    """Over 3000 draws of white noise, each mode alone: a variance of so many is good to 3 %."""
    still, draws = torch.zeros(1, dtype=torch.float64), 3000
    noise = LEVEL * torch.randn(draws, SAMPLES, generator=torch.Generator().manual_seed(2))
    gains = torch.zeros(draws, 1)
    impacts = Impacts(torch.zeros(draws, 3), noise, RATE, tuple(str(row) for row in range(draws)))
    for frequency, damping in ((800.0, 3.0), (2500.0, 60.0)):
        bank = ModalBank(still + frequency, still + damping)
        modes = Extraction(bank, torch.complex(gains, gains), Residual(torch.full((65,), LEVEL)))
        made = GainData(impacts, features(), modes, still, gains, CONFIG)
        scatter = float(fit_sine_gains(noise, bank, sample_rate=RATE).double().square().mean())
        assert float(gain_variance(made)) == pytest.approx(scatter, rel=0.1)


def moved_body(move: Callable[[torch.Tensor], torch.Tensor]) -> CandidateBody:
    """Return the true wall's body with its surface elsewhere."""
    body = bodies()[1]
    return replace(body, elastic=replace(body.elastic, nodes=move(body.elastic.nodes)))


def test_a_body_that_the_contacts_do_not_lie_on_takes_no_part_and_the_remedy_is_told() -> None:
    body = moved_body(lambda x: 1000.0 * x)
    report = estimator(body).solve(case())[0].report
    assert report["bodies"] == []
    with raises(FitError, name="contacts") as caught:
        estimator(body, kinds=("elastic",)).solve(case())
    assert report["unavailable"]["elastic"] == str(caught.value)
    assert 'unit "mm"' in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, 12])
def test_bodies_take_part_despite_rough_surfaces_thick_glue_and_a_wrong_row(count: int) -> None:
    generator = torch.Generator().manual_seed(4)
    contacts = recorded(count)[0].contacts
    size = float((points().amax(0) - points().amin(0)).norm())
    rough = moved_body(lambda x: x + 0.02 * size * torch.randn(x.shape, generator=generator, dtype=x.dtype))
    above = contacts + 0.03 * size * torch.tensor([0.0, 0.0, 1.0])
    above[-1] += 0.5 * size
    for body, each in ((rough, contacts), (bodies()[1], above)):
        assert estimator(body).solve(case(count, contacts=each))[0].report["bodies"]


def no_symmetries() -> None:
    return None


def walled() -> CandidateBodies:
    return candidate_bodies(dome(), BodyConfig(wall=0.004))


@pytest.mark.parametrize(
    ("config", "name", "value"),
    [(BodyConfig(wall=3.0), "wall", 3.0), (BodyConfig(wall=0.0), "wall", 0.0), (BodyConfig(dofs=5), "dofs", 5)],
    ids=repr,
)
def test_stated_settings_that_leave_no_body_are_refused(config: BodyConfig, name: str, value: float) -> None:
    def make() -> CandidateBodies:
        return candidate_bodies(dome(), config)

    models: tuple[GainModelName, ...] = ("auto", "elastic")
    for model in models:
        with raises(SimulationError, name=name, value=value):
            estimator_for(model, make, no_symmetries)
    estimator_for("smooth", make, no_symmetries)


def test_without_enough_memory_a_fit_has_no_elastic_family_and_no_stated_wall_is_blamed(monkeypatch):
    monkeypatch.setattr("avmsf.fem.body_meshes.free_memory", lambda: 1000.0)
    told: list[str] = []
    estimator_for("auto", walled, no_symmetries, log=told.append)
    assert told[0].startswith("no elastic mode shapes: ")
    assert "free for" in told[0]
    with raises(SimulationError, name="memory"):
        estimator_for("elastic", walled, no_symmetries)


def test_contacts_elsewhere_are_refused_before_any_body_is_computed() -> None:
    told: list[str] = []
    surface = Surface(1000.0 * dome().vertices, dome().faces)
    with raises(FitError, name="contacts") as caught:
        candidate_bodies(surface, impacts=recorded(12)[0], log=told.append)
    assert 'unit "mm"' in str(caught.value)
    assert told == []


SIDES = (0.08, 0.06, 0.05)


def box(inset: float, *, above: float = 0.0) -> Surface:
    """Return the block that the cup is cut from, each side but the upper one moved inwards."""
    low, high = (inset, inset, inset), (SIDES[0] - inset, SIDES[1] - inset, SIDES[2] + above)
    made = trimesh.creation.box(bounds=(low, high))
    return Surface(torch.tensor(made.vertices).float(), torch.tensor(made.faces))


@dataclass(frozen=True, eq=False)
class Cup:
    """A cup of flat sides whose wall is unknown; walls above `most` leave nothing of its cavity.

    It may be shut where views did not see that it `opens`.
    """

    most: float = 0.02
    thickness_range: tuple[float, float] | None = (0.006, 0.018)
    opens: bool = True
    shut: bool = False

    def as_seen(self) -> Surface:
        return box(0.0)

    def digest(self) -> str:
        return f"{self}"

    def closed(self) -> "Cup | None":
        return None if self.opens else replace(self, shut=True)

    def shell(self, thickness: float, *, faces: int) -> Surface:
        if thickness > self.most:
            raise SceneError("nothing is left of the cavity")
        return difference(self.as_seen(), box(thickness, above=-thickness if self.shut else 0.01))


@pytest.mark.slow
def test_walls_cover_the_range_thicker_ones_are_stiffer_and_a_cavity_that_no_view_saw_into_may_be_closed() -> None:
    found = CandidateBodies(Cup(opens=False), count=6, dofs=4000)
    filled, *walls = found.bodies
    assert filled.thickness is None
    assert [body.thickness for body in walls] == pytest.approx([0.006 * 3 ** (step / 4) for step in range(5)] * 2)
    lowest = [float(body.elastic.frequency[0]) for body in walls[:5]]
    assert lowest == sorted(lowest)
    # Of panels that bend, frequencies go with the thickness, 1.32 here; panels between thicker walls are
    # smaller, and coarse elements too stiff, more so in thinner walls.
    assert 1.2 < lowest[1] / lowest[0] < 1.6
    assert [body.closed for body in walls] == 5 * [False] + 5 * [True]
    for cup, box in zip(walls[:5], walls[5:], strict=True):
        assert cup.thickness == box.thickness
        # A lid stiffens the sides.
        assert float(cup.elastic.frequency[0]) < 0.8 * float(box.elastic.frequency[0])
    assert walls[5].name == "closed wall of 6 mm"
    [made] = found.with_thicknesses(walls[5], [0.007])
    assert (made.thickness, made.closed) == (0.007, True)
    assert found.refined(made).fine
    assert found.refined(made).closed


def test_walls_that_cannot_be_had_are_left_out() -> None:
    messages: list[str] = []
    cup = Cup(most=0.01, thickness_range=(0.009, 0.018))
    found = CandidateBodies(cup, count=4, dofs=2000, log=messages.append)
    assert [body.thickness for body in found.bodies] == [None, pytest.approx(0.009)]
    assert found.with_thicknesses(found.bodies[1], [0.012, 0.011]) == [None, None]
    # In the order of the thicknesses, whichever thread ends first.
    assert [each.partition(": ")[2].partition(":")[0] for each in messages[-2:]] == ["wall of 12 mm", "wall of 11 mm"]


def test_a_wall_thinner_than_tetrahedra_follow_is_refused_before_they_are_made(monkeypatch) -> None:
    monkeypatch.setattr(body_meshes, "fill", None)
    with pytest.raises(SimulationError) as error:
        shape_solid(Cup(), 0.001, 4000, log=lambda words: None)
    assert (error.value.name, error.value.value) == ("detail", 0.001)


@pytest.mark.slow
def test_the_thickness_is_searched_for_unless_it_is_known_or_there_is_no_cavity() -> None:
    config = BodyConfig(shapes=6, dofs=4000)
    searched = candidate_bodies(Cup(), config)
    assert searched.searches_thickness
    [body] = searched.with_thicknesses(searched.bodies[1], [0.007])
    assert body.thickness == 0.007
    known = candidate_bodies(Cup(), BodyConfig(wall=0.005, shapes=6, dofs=4000))
    assert (known.searches_thickness, [each.thickness for each in known.bodies]) == (False, [0.005])
    solid = candidate_bodies(Cup(thickness_range=None), config)
    assert (solid.searches_thickness, [each.thickness for each in solid.bodies]) == (False, [None])
