"""Localisation judged where every answer is known: images under symmetries, chance, likeness, errors and regions."""

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from avmsf.baselines.diffsound.locator import DiffSoundLocator
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError, LocationError
from avmsf.evaluation.localization import LocatingScores, judge_locating
from avmsf.evaluation.localization_baselines import NearestSpectrum, random_distance
from avmsf.evaluation.symmetric_contacts import Images, symmetries_of
from avmsf.field.sound_field import Origin, SoundField
from avmsf.localization.contact_map import ContactMap
from avmsf.localization.locator import Locator
from avmsf.modal.residual_noise import Residual
from avmsf.modal.synthesis import synthesize
from avmsf.plotting.contacts import contact_colors, draw_contact, write_contact_cloud
from avmsf.plotting.pictures import save_picture
from avmsf.simulate.shapes.shape import Symmetry
from avmsf.symmetry.symmetries import MirrorSymmetry, RotationalSymmetry, Symmetries
from factories.made_fields import BANK, positional
from factories.raising import raises

RATE, SAMPLES = 8000.0, 3000
STRUCK = (68, 60, 102, 8)
PLACE = torch.tensor([0.3, 0.1, 0.2], dtype=torch.float64)
AXES = torch.eye(3, dtype=torch.float64)


def turning(axis: Tensor, order: int | None) -> RotationalSymmetry:
    return RotationalSymmetry(axis, torch.zeros(3, dtype=torch.float64), order, error=0.0, missing=0.0)


def mirror(normal: Tensor, point: Tensor | None = None) -> MirrorSymmetry:
    return MirrorSymmetry(normal, torch.zeros(3, dtype=torch.float64) if point is None else point, 0.0, 0.0)


def found(*each: RotationalSymmetry | MirrorSymmetry) -> Symmetries:
    turns = tuple(one for one in each if isinstance(one, RotationalSymmetry))
    mirrors = tuple(one for one in each if isinstance(one, MirrorSymmetry))
    return Symmetries(turns, mirrors, spacing=0.0, tolerance=0.0, rejected=math.inf)


@pytest.mark.parametrize(
    ("symmetries", "order"),
    [
        (found(), 1),
        (found(mirror(AXES[0])), 2),
        (found(mirror(AXES[0]), mirror(AXES[1])), 4),
        (found(turning(AXES[2], 3)), 3),
        (found(turning(AXES[2], 12), mirror(AXES[2])), 24),
        (found(turning(AXES[2], 4), turning(AXES[0], 4)), 24),
        (found(turning(AXES[2], 4), turning(AXES[0], 4), mirror(AXES[0])), 48),
    ],
    ids=["none", "mirror", "plate", "three-fold", "gear", "turned cube", "cube"],
)
def test_a_group_has_as_many_images_as_its_order(symmetries: Symmetries, order: int) -> None:
    images = Images.of(symmetries).at(PLACE)
    assert len(images) == order
    assert torch.equal(images[0], PLACE)
    apart = torch.cdist(images, images) + torch.eye(order, dtype=torch.float64)
    assert float(apart.min()) > 0.01
    # Motions about the middle keep the distance from it.
    assert torch.allclose(images.norm(dim=1), PLACE.norm().expand(order), atol=1e-12)


def test_images_lie_where_the_object_is() -> None:
    middle = torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64)
    images = Images.of(found(mirror(AXES[0], middle))).at(PLACE)
    assert images[1].tolist() == pytest.approx([-0.1, 0.1, 0.2])


def test_an_axis_of_any_angle_makes_circles_and_two_make_a_ball() -> None:
    circle = Images.of(found(turning(AXES[2], None), mirror(AXES[2]))).at(PLACE)
    radius = float(PLACE[:2].norm())
    assert torch.allclose(circle[:, :2].norm(dim=1), torch.full((len(circle),), radius).double())
    assert sorted({round(value, 9) for value in circle[:, 2].tolist()}) == [-0.2, 0.2]
    anywhere = torch.tensor([[-radius * math.sin(1.0), radius * math.cos(1.0), 0.2]], dtype=torch.float64)
    assert float(torch.cdist(anywhere, circle).min()) < 0.005 * radius
    ball = Images.of(found(turning(AXES[2], None), turning(AXES[0], None))).at(PLACE)
    size = float(PLACE.norm())
    directions = torch.nn.functional.normalize(
        torch.randn(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)), dim=1
    )
    assert torch.allclose(ball.norm(dim=1), torch.full((len(ball),), size).double())
    assert float(torch.cdist(size * directions, ball).amin(1).max()) < 0.03 * size


def test_symmetries_of_made_shapes_carry_over() -> None:
    known = Symmetry("a pot", axis=AXES[2], order=None, mirrors=AXES[:1], point=PLACE)
    carried = symmetries_of(known)
    assert [each.order for each in carried.rotations] == [None]
    assert torch.equal(carried.rotations[0].point, PLACE)
    assert torch.equal(carried.mirrors[0].normal, AXES[0])
    assert not symmetries_of(Symmetry("none"))


def test_chance_is_the_mean_distance_from_the_nearest_right_place() -> None:
    points = torch.tensor([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    right = torch.tensor([[0.0, 3.0, 0.0], [10.0, 0.0, 0.0]])
    assert random_distance(points, right[:1]) == pytest.approx((3 + 5 + math.sqrt(109)) / 3)
    assert random_distance(points, right) == pytest.approx((3 + 5 + 0) / 3)
    # More points than are looked at at once.
    assert random_distance(points.repeat(1000, 1), right) == pytest.approx(8 / 3)


@cache
def locator() -> Locator:
    zero = torch.zeros(len(BANK), dtype=torch.float64)
    field = SoundField(BANK, positional(), zero, Residual(torch.full((9,), 1e-3)), RATE, SAMPLES, Origin("plate"))
    return Locator.of(field)


@cache
def strikes() -> Impacts:
    gains = locator().gains[list(STRUCK)].to(torch.complex128)
    sounds = synthesize(
        gains.real, BANK.frequency, BANK.damping, samples=SAMPLES, sample_rate=RATE, quadrature=gains.imag
    )
    noise = torch.randn(sounds.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    sounds = sounds + 1e-3 * sounds.abs().max() * noise
    return Impacts(locator().points[list(STRUCK)].double(), sounds.float(), RATE, ("d.wav", "c.wav", "b.wav", "a.wav"))


def test_the_most_alike_spectrum_is_a_sounds_own_however_loud() -> None:
    alike = NearestSpectrum(strikes())
    generator = torch.Generator().manual_seed(1)
    for row, sound in enumerate(strikes().sounds):
        level = 1e-3 * float(sound.abs().max())
        other = -300.0 * (sound + level * torch.randn(SAMPLES, generator=generator))
        assert alike.row(other) == row
        assert torch.equal(alike.place(other), strikes().contacts[row])
    with raises(EvaluationError, name="sound", value=0.0):
        alike.row(torch.zeros(SAMPLES))


def test_silent_strikes_are_nobodys_nearest_and_are_placed_by_chance() -> None:
    quiet = strikes().sounds.clone()
    quiet[1] = 0.0
    alike = NearestSpectrum(replace(strikes(), sounds=quiet))
    assert [alike.row(sound) for sound in strikes().sounds[[0, 2, 3]]] == [0, 2, 3]
    assert alike.row(strikes().sounds[1]) != 1
    judged = judge_locating(locator(), strikes(), replace(strikes(), sounds=quiet), name="plate")
    for method in ("nearest", "cosine", "posterior"):
        assert judged.figures(method)["refused"] == 0.25
    assert judged.figures("random")["refused"] == 0.0
    (row,) = (each for each in judged.rows if each.method == "nearest" and each.refusal)
    assert row.place is None
    assert row.rmed == next(each.rmed for each in judged.rows if each.method == "random" and each.truth == row.truth)


@cache
def scores() -> LocatingScores:
    test, train = strikes(), strikes().take([2, 3])
    images = Images.of(found(mirror(AXES[0])))
    return judge_locating(locator(), train, test, name="plate", images=images, scale=0.5, settings={"seed": 7})


def test_an_exact_field_finds_every_strike() -> None:
    for method in ("cosine", "posterior"):
        assert scores().figures(method)["rmed"] == pytest.approx(0.0, abs=1e-6)
    means = scores().figures("posterior")
    assert means["covered"] == means["covered_modulo"] == 1.0
    # The field's own contacts, left out, are badly foretold by the others: the region is as wide as that makes it.
    assert 0.0 < means["region"] < 0.6
    assert [row.recording for row in scores().rows[::4]] == ["a.wav", "b.wav", "c.wav", "d.wav"]
    assert all(row.explained is not None and row.explained > 0.99 for row in scores().rows if row.method == "cosine")


def test_baselines_are_as_far_off_as_they_are() -> None:
    points = locator().points.double()
    diagonal = float((points.amax(0) - points.amin(0)).norm())
    assert scores().diagonal == pytest.approx(diagonal)
    nearest = [row for row in scores().rows if row.method == "nearest"]
    # Two of the strikes are in the training set.
    assert [row.rmed for row in nearest[:2]] == pytest.approx([0.0, 0.0], abs=1e-9)
    chance = [random_distance(points, contact[None]) for contact in strikes().contacts]
    assert scores().figures("random")["rmed"] == pytest.approx(sum(chance) / 4 / diagonal, rel=1e-9)
    for method in ("random", "nearest"):
        means = scores().figures(method)
        assert means["rmed_modulo"] <= means["rmed"]
        assert means["contact_error"] == pytest.approx(means["rmed"] * diagonal / 0.5)
    assert "covered" not in scores().figures("nearest")


def test_only_the_symmetry_makes_a_mirrored_place_right() -> None:
    contacts = strikes().contacts * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    images = Images.of(found(mirror(AXES[0])))
    means = judge_locating(
        locator(), strikes(), strikes(), name="plate", images=images, truth=contacts, methods=("posterior",)
    ).figures("posterior")
    assert means["rmed"] > 0.1
    assert means["rmed_modulo"] == pytest.approx(0.0, abs=1e-6)
    assert means["covered"] < means["covered_modulo"] == 1.0


def test_what_the_locator_refuses_counts_as_chance_and_says_why() -> None:
    noise = torch.randn(1, SAMPLES, generator=torch.Generator().manual_seed(5))
    test = Impacts(strikes().contacts[:1], noise, RATE, ("noise.wav",))
    judged = judge_locating(locator(), strikes(), test, name="plate")
    posterior, chance = judged.rows[3], judged.rows[0]
    assert (posterior.method, chance.method) == ("posterior", "random")
    assert posterior.rmed == chance.rmed
    assert posterior.place is None
    assert posterior.refusal is not None
    assert "noise" in posterior.refusal
    assert "covered" not in judged.figures("posterior")


class Simulated(DiffSoundLocator):
    """Places every sound at one point, and refuses silence."""

    def __init__(self) -> None:
        object.__setattr__(self, "points", PLACE[None])

    def place(self, sound: Tensor) -> Tensor:
        if not bool(sound.any()):
            raise LocationError("silent")
        return self.points[0]


def test_diffsound_is_judged_where_its_locator_is_given() -> None:
    quiet = strikes().sounds.clone()
    quiet[1] = 0.0
    test = replace(strikes(), sounds=quiet)
    judged = judge_locating(
        locator(), strikes(), test, name="plate", methods=("random", "diffsound"), diffsound=Simulated()
    )
    rows = {row.recording: row for row in judged.rows if row.method == "diffsound"}
    chance = {row.recording: row.rmed for row in judged.rows if row.method == "random"}
    for row, (name, contact) in enumerate(zip(strikes().names, strikes().contacts.double(), strict=True)):
        apart = float((contact - PLACE).norm()) / judged.diagonal
        assert rows[name].rmed == pytest.approx(chance[name] if row == 1 else apart)
        assert rows[name].refusal == ("silent" if row == 1 else None)
    with pytest.raises(EvaluationError):
        judge_locating(locator(), strikes(), strikes(), name="plate", methods=("diffsound",))


def test_rows_are_written_with_all_that_decided_them(tmp_path: Path) -> None:
    scores().write(tmp_path / "deep" / "plate.json")
    read = json.loads((tmp_path / "deep" / "plate.json").read_text())
    assert read["settings"] == {"seed": 7}
    assert read["level"] == 0.9
    assert read["means"]["random"]["rmed"] == pytest.approx(scores().figures("random")["rmed"])
    assert [row["rmed"] for row in read["rows"]] == [row.rmed for row in scores().rows]
    assert read["version"]


def test_what_cannot_be_judged_is_refused() -> None:
    with raises(EvaluationError, name="methods", value=("guess",)):
        judge_locating(locator(), strikes(), strikes(), name="plate", methods=("guess",))
    slow = Impacts(strikes().contacts, strikes().sounds, 4000.0, strikes().names)
    with raises(EvaluationError, name="sample_rate", value=4000.0):
        judge_locating(locator(), strikes(), slow, name="plate")
    with raises(EvaluationError, name="truth", value=1):
        judge_locating(locator(), strikes(), strikes(), name="plate", truth=strikes().contacts[:1])
    with raises(EvaluationError, name="method", value="guess"):
        scores().figures("guess")
    one = replace(locator(), points=locator().points[:1].expand_as(locator().points))
    with raises(EvaluationError, name="scale", value=(0.0, 0.0)):
        judge_locating(one, strikes(), strikes(), name="plate")
    for size in (0.0, -1.0, math.nan):
        with raises(EvaluationError, name="scale") as caught:
            judge_locating(locator(), strikes(), strikes(), name="plate", scale=size)
        assert caught.value.value[1] is size


def test_errors_are_parts_of_the_boxs_diagonal() -> None:
    # A box of .3 x .4 x 1.2, whose diagonal is 1.3; from one of its ends the strikes are at known distances.
    points = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.4, 1.2]])
    far = replace(locator(), points=points[:1].expand(len(locator().points), 3).clone())
    far.points[-1] = points[1]
    truth = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.3], [0.03, 0.04, 0.0], [0.0, 0.65, 0.0]], dtype=torch.float64)
    judged = judge_locating(far, strikes(), strikes(), name="box", truth=truth, methods=("cosine",), scale=0.5)
    assert judged.diagonal == pytest.approx(1.3)
    expected = dict(zip(strikes().names, [0.0, 1.0, 0.05 / 1.3, 0.5], strict=True))
    assert {row.recording: row.rmed for row in judged.rows} == pytest.approx(expected, abs=1e-6)
    assert judged.figures("cosine")["contact_error"] == pytest.approx((1.3 + 0.05 + 0.65) / 4 / 0.5)


@cache
def contact() -> ContactMap:
    return locator().locate(strikes().sounds[0])


def test_colors_grow_with_probability() -> None:
    sharper = contact().probability ** 10
    colors = contact_colors(replace(contact(), probability=sharper / sharper.sum()))
    brightness = colors.sum(1)
    assert int(brightness.argmax()) == contact().most_probable == STRUCK[0]
    order = torch.argsort(sharper)
    assert bool((brightness[order].diff() >= -1e-6).all())
    # Viridis begins with a dark purple.
    assert colors[int(brightness.argmin())].tolist() == pytest.approx([0.267, 0.005, 0.329], abs=1e-3)


def test_a_cloud_holds_what_was_found(tmp_path: Path) -> None:
    write_contact_cloud(contact(), tmp_path / "blow.ply")
    read = trimesh.load(tmp_path / "blow.ply")
    assert np.allclose(read.vertices, contact().points.numpy())
    assert np.array_equal(read.colors[:, :3], (255 * contact_colors(contact())).round().numpy().astype(np.uint8))
    columns = read.metadata["_ply_raw"]["vertex"]["data"]
    assert np.allclose(columns["probability"], contact().probability.numpy())
    assert np.allclose(columns["cosine_distance"], contact().distance.numpy(), atol=1e-6)


def test_a_picture_shows_both_maps_and_the_marks(tmp_path: Path) -> None:
    figure = draw_contact(contact(), title="hit.wav", others=contact().points[:2], truth=contact().points[5])
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert len(titles) == 12
    assert any("elevation -" in title for title in titles)
    assert "blue: " in figure.get_suptitle()
    assert "red: " in figure.get_suptitle()
    assert "red: " not in draw_contact(contact(), title="hit.wav", sides=((0.0, 25.0),)).get_suptitle()
    save_picture(figure, tmp_path / "hit.png")
    assert (tmp_path / "hit.png").read_bytes().startswith(b"\x89PNG")
