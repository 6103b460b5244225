"""Fits of Gaussians to photographs, and the similarity of images."""

import math
import os
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from avmsf.errors import CaptureWarning, SceneError
from avmsf.gaussians.cloud import GaussianCloud, rotation_matrices
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.fit import SplatProgress, splat
from avmsf.gaussians.rasterizer.rasterizers import NumbaRasterizer
from avmsf.gaussians.ssim import convolved_ssim, psnr, ssim
from avmsf.gaussians.start_points import StartPoints, photographed_colors, starting_cloud, visual_hull
from avmsf.gaussians.targets import choose_background, comparable_views, pyramid
from avmsf.photographs.cameras import View
from factories.ball_views import MIDDLE, RADIUS, ball_color, ball_normals, ball_view, ball_views
from factories.raising import raises, warns

QUICK = SplatConfig(steps=60, start_points=400, gaussians=600, densify_every=15)


def _mean_psnr(cloud: GaussianCloud, views: list[View], *, background: float = 0.0) -> float:
    back = torch.full((3,), background)
    images = [NumbaRasterizer()(cloud, view.camera, background=back).color for view in views]
    return sum(psnr(image, view.color) for image, view in zip(images, views, strict=True)) / len(views)


@pytest.mark.slow
def test_held_out_views_of_a_ball_are_predicted_and_its_gaussians_lie_on_it() -> None:
    views = ball_views(30)
    held, seen = views[::6], [view for place, view in enumerate(views) if place % 6]
    cloud = splat(seen, replace(QUICK, steps=200, start_points=800, gaussians=1500))
    # A gray ball of the right outline has 17 dB; 0.5 / 255 of rounding would allow 59.
    assert _mean_psnr(cloud, held) > 30.0
    # A Gaussian's middle lies under what it shows by about its width, of a pixel or two; 3 pixels are 14 % here.
    assert float(((cloud.centers - torch.tensor(MIDDLE)).norm(dim=1) / RADIUS - 1.0).abs().median()) < 0.14
    # Across the surface they are thin: their shortest axis is the ball's normal.
    axes = rotation_matrices(cloud.rotations)[torch.arange(len(cloud)), :, cloud.log_scales.argmin(1)]
    outwards = torch.nn.functional.normalize(cloud.centers - torch.tensor(MIDDLE), dim=1)
    assert float((axes * outwards).sum(1).abs().median()) > 0.9
    assert cloud.degree == 2
    assert not any(getattr(cloud, each.name).requires_grad for each in fields(cloud))


@pytest.mark.parametrize("background", ["found", "random"])
def test_an_interrupted_run_goes_on_to_the_same_bits(tmp_path: Path, background: str) -> None:
    views, place = ball_views(12), tmp_path / "kept" / "splat.ckpt"
    config = replace(QUICK, background=background)
    reports: list[SplatProgress] = []

    def interrupt(progress: SplatProgress) -> None:
        # After a split, and amid the next epoch of views.
        if progress.step == 40:
            raise KeyboardInterrupt

    def same(one: GaussianCloud, other: GaussianCloud) -> bool:
        return all(torch.equal(getattr(one, each.name), getattr(other, each.name)) for each in fields(GaussianCloud))

    with pytest.raises(KeyboardInterrupt):
        splat(views, config, checkpoint=place, progress=interrupt)
    resumed = splat(views, config, checkpoint=place, progress=reports.append)
    assert [each.step for each in reports] == [50, 60]
    assert all(each.steps == 60 and each.loss > 0 and math.isfinite(each.psnr) for each in reports)
    assert [each.seconds for each in reports] == sorted(each.seconds for each in reports)
    assert len(reports[-1].cloud) > 0
    assert same(resumed, splat(views, config))
    assert not same(resumed, splat(views, replace(config, seed=1)))
    # The finished run is kept too: what comes after it may fail.
    assert same(splat(views, config, checkpoint=place, progress=reports.append), resumed)
    assert len(reports) == 2
    for others, settings in ((views, replace(config, seed=5)), (views[1:], config)):
        with raises(SceneError, file=place, value=["view, initial point or setting"]):
            splat(others, settings, checkpoint=place)


def test_a_fit_does_not_depend_on_the_mode_of_gradients() -> None:
    with torch.no_grad():
        assert len(splat(ball_views(4), replace(QUICK, steps=1))) > 0


@pytest.mark.slow
def test_kernels_leave_torchs_number_of_threads_alone() -> None:
    code = "import torch; torch.set_num_threads(1); from factories.ball_views import ball_views; "
    code += "from avmsf.gaussians import SplatConfig, splat; splat(ball_views(4), SplatConfig(steps=1)); "
    code += "print(torch.get_num_threads())"
    paths = os.pathsep.join([str(Path(__file__).parents[1]), *filter(None, sys.path)])
    environment = {name: each for name, each in os.environ.items() if name != "NUMBA_NUM_THREADS"}
    said = subprocess.check_output([sys.executable, "-c", code], text=True, env=environment | {"PYTHONPATH": paths})
    assert said.strip() == "1"


def test_a_background_of_whole_numbers_is_a_color() -> None:
    assert choose_background([], replace(QUICK, background=(1, 1, 1))).dtype == torch.float32


def test_a_checkpoint_is_of_the_views_whatever_their_cameras_were_asked(tmp_path: Path) -> None:
    start = visual_hull(ball_views(12), points=200)
    views = [replace(view, camera=replace(view.camera)) for view in ball_views(12)]
    config = replace(QUICK, steps=2)
    first = splat(views, config, start=start, checkpoint=tmp_path / "splat.ckpt")
    assert all(view.camera.position.isfinite().all() for view in views)
    again = splat(views, config, start=start, checkpoint=tmp_path / "splat.ckpt")
    assert torch.equal(again.centers, first.centers)


def test_photographs_without_masks_start_from_points() -> None:
    views = ball_views(16, masked=False, background=0.6)
    normals = ball_normals(500)
    start = StartPoints(torch.tensor(MIDDLE) + RADIUS * normals, ball_color(normals))
    cloud = splat(views, replace(QUICK, steps=100), start=start)
    assert _mean_psnr(cloud, views, background=0.6) > 26.0


def test_before_random_colors_the_object_alone_is_fitted() -> None:
    views = []
    for place, view in enumerate(ball_views(16)):
        # A background that is another in every view and every pixel, as behind an object that turns.
        noise = torch.randint(256, (64, 64, 3), generator=torch.Generator().manual_seed(place), dtype=torch.uint8)
        image = torch.where(view.mask[..., None] > 127, view.image, noise)
        views.append(View(view.name, image, view.camera, view.mask))
    assert choose_background(views, QUICK) is None
    # Without the loss on the mask, the colors alone must say what is the object.
    cloud = splat(views, replace(QUICK, steps=120, mask_weight=0.0))
    assert _mean_psnr(cloud, ball_views(16)) > 24.0
    inside = [(view.mask > 127, view) for view in views]
    for mask, view in inside[:3]:
        alpha = NumbaRasterizer()(cloud, view.camera, background=torch.zeros(3)).alpha
        assert float(alpha[~mask].mean()) < 0.03
        assert float(alpha[mask].mean()) > 0.95


def test_the_background_is_the_plain_color_around_the_object() -> None:
    found = choose_background(ball_views(4, background=0.6), SplatConfig())
    # 0.6 is 153 of 255.
    torch.testing.assert_close(found, torch.full((3,), 0.6), rtol=0, atol=1e-6)
    unmasked = choose_background(ball_views(4, background=0.6, masked=False), SplatConfig())
    torch.testing.assert_close(unmasked, found)
    given = choose_background(ball_views(4), SplatConfig(background=(0.1, 0.2, 0.3)))
    assert given.tolist() == pytest.approx([0.1, 0.2, 0.3])


def test_views_that_cannot_be_compared_are_passed_over() -> None:
    views = ball_views(6)
    empty = replace(views[0], mask=torch.zeros(64, 64, dtype=torch.uint8))
    background = choose_background(views, replace(QUICK, background="random"))
    bare = replace(views[1], mask=None)
    with warns(CaptureWarning, name="masks", value=["01.png"]):
        kept = comparable_views([empty, bare, *views[2:]], background)
    assert [each.name for each in kept] == ["02.png", "03.png", "04.png", "05.png"]


def test_halved_photographs_are_means_that_the_halved_camera_sees() -> None:
    view = ball_view(ball_views(3, size=65)[1].camera)
    levels = pyramid(view, halvings=2)
    assert [(level.camera.width, level.camera.height) for level in levels] == [(65, 65), (32, 32), (16, 16)]
    mean = view.image.double().mean()
    assert all(float(level.image.double().mean() - mean) == pytest.approx(0.0, abs=1.0) for level in levels)
    even = ball_view(ball_views(2)[1].camera)
    small = pyramid(even, halvings=1)[1].image
    blocks = even.image.reshape(32, 2, 32, 2, 3).double().mean((1, 3))
    # Rounded to a level.
    assert float((small - blocks).abs().max()) <= 0.5
    point = torch.tensor([MIDDLE])
    full, small = (levels[place].camera.project(point)[0] / levels[place].camera.width for place in (0, 2))
    torch.testing.assert_close(full, small)


def test_gaussians_start_as_wide_as_their_neighbors_are_far() -> None:
    # On a cubic lattice the three nearest neighbors are one spacing away.
    axis = torch.arange(5.0) * 0.01
    points = torch.cartesian_prod(axis, axis, axis)
    cloud = starting_cloud(StartPoints(points, torch.full((125, 3), 0.25)), degree=1, scale=0.5, opacity=0.3)
    torch.testing.assert_close(cloud.log_scales.exp(), torch.full((125, 3), 0.005))
    torch.testing.assert_close(cloud.opacities, torch.full((125,), 0.3))
    camera = ball_views(1)[0].camera
    normals = ball_normals(125)
    normals[0] = torch.tensor([0.0, 0.0, -1.0])
    start = StartPoints(points, torch.full((125, 3), 0.25), normals)
    discs = starting_cloud(start, degree=1, scale=0.5, opacity=0.3, flatness=0.2)
    torch.testing.assert_close(discs.log_scales.exp(), torch.tensor([[0.005, 0.005, 0.001]]).repeat(125, 1))
    torch.testing.assert_close(rotation_matrices(discs.rotations)[:, :, 2], normals)
    # One of them alone, seen half a pixel off its middle both ways, has 5 mm at .3 m and the rasterizer's blur of .3
    # square pixels for its variance.
    alone = replace(cloud.take(torch.tensor([62])), centers=torch.tensor([MIDDLE]))
    shown = NumbaRasterizer()(alone, camera, background=torch.zeros(3)).color[32, 32]
    expected = 0.3 * 0.25 * math.exp(-0.25 / ((0.005 / 0.3 * 128) ** 2 + 0.3))
    torch.testing.assert_close(shown, torch.full((3,), expected), rtol=1e-3, atol=0)


def test_points_take_the_colors_that_photographs_show_of_their_side() -> None:
    normals = ball_normals(2000)
    points = torch.tensor(MIDDLE) + RADIUS * normals
    found = photographed_colors(points, ball_views(24), spacing=2.0 * RADIUS / 2000**0.5)
    # Depth cells and pixels of .3 / 128 m blur colors that change by 1.8 a radius at most.
    assert float((found - ball_color(normals)).abs().median()) < 0.05
    away = photographed_colors(torch.tensor([[9.0, 9.0, 9.0]]), ball_views(3), spacing=0.01)
    assert away.tolist() == [[0.5, 0.5, 0.5]]


SAME, LOST = StartPoints(torch.zeros(9, 3), torch.zeros(9, 3)), torch.full((9, 3), torch.nan)


@pytest.mark.parametrize(
    ("call", "name", "value"),
    [
        (lambda: SplatConfig(steps=0), "steps", 0),
        (lambda: SplatConfig(center_rate=0.0), "center_rate", 0.0),
        (lambda: SplatConfig(start_opacity=1.0), "start_opacity", 1.0),
        (lambda: SplatConfig(background=(0.5,)), "background", (0.5,)),
        (lambda: SplatConfig(densify_until=1.5), "densify_until", 1.5),
        (lambda: SplatConfig(gaussians=5), "gaussians", 5),
        (lambda: SplatConfig(background=(0.0, 0.0, 255.0)), "background", (0.0, 0.0, 255.0)),
        (lambda: SplatConfig(seed=2**63), "seed", 2**63),
        (lambda: StartPoints(torch.zeros(2, 3), torch.zeros(2, 3)), "points", 2),
        (lambda: StartPoints(LOST, torch.zeros(9, 3)), "points", 9),
        (lambda: starting_cloud(SAME, degree=0, scale=1.0, opacity=0.5), "points", 9),
        (
            lambda: choose_background(ball_views(4, masked=False), replace(QUICK, background="random")),
            "background",
            "random",
        ),
        (lambda: comparable_views(ball_views(2), None), "views", 2),
        (lambda: splat(ball_views(5, masked=False), QUICK), "views", 0),
    ],
)
def test_settings_points_and_views_without_a_meaning_are_refused(call, name: str, value: Any) -> None:
    with raises(SceneError, name=name, value=value):
        call()


def test_a_run_that_diverges_says_which_rates_to_lower() -> None:
    with raises(SceneError) as caught:
        splat(ball_views(5), replace(QUICK, center_rate=1e20, color_rate=1e30))
    assert caught.value.name in ("loss", "gaussians")


def _images(height: int = 13, width: int = 17) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    first = torch.rand(height, width, 3, generator=generator, dtype=torch.float64)
    return first, (first + 0.3 * torch.rand(height, width, 3, generator=generator, dtype=torch.float64)) / 1.3


def test_similarity_is_wangs_formula_window_by_window() -> None:
    first, second = (each.numpy() for each in _images())
    offsets = np.arange(-5, 6)
    weights = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.5**2))
    weights /= weights.sum()
    values = []
    for channel in range(3):
        one, other = (np.pad(each[..., channel], 5) for each in (first, second))
        for row, column in np.ndindex(first.shape[:2]):
            x, y = one[row : row + 11, column : column + 11], other[row : row + 11, column : column + 11]
            mean_x, mean_y = (weights * x).sum(), (weights * y).sum()
            # Variances about the mean, not as differences of moments.
            var_x, var_y = (weights * (x - mean_x) ** 2).sum(), (weights * (y - mean_y) ** 2).sum()
            covariance = (weights * (x - mean_x) * (y - mean_y)).sum()
            shared = (2 * mean_x * mean_y + 0.01**2) * (2 * covariance + 0.03**2)
            values.append(shared / ((mean_x**2 + mean_y**2 + 0.01**2) * (var_x + var_y + 0.03**2)))
    # Both in float64: what is left is rounding.
    assert float(ssim(*map(torch.from_numpy, (first, second)))) == pytest.approx(np.mean(values), abs=1e-12)


def test_graphics_cards_get_the_same_value_and_gradient() -> None:
    first, second = _images()
    one, other = first.clone().requires_grad_(), first.clone().requires_grad_()
    value, plain = ssim(one, second), convolved_ssim(other, second)
    (2.0 * value).backward()
    (2.0 * plain).backward()
    assert float(value.detach()) == pytest.approx(float(plain.detach()), abs=1e-12)
    torch.testing.assert_close(one.grad, other.grad, rtol=0, atol=1e-12)


def test_psnr_of_a_tenth_is_twenty_decibels() -> None:
    target = torch.full((4, 6, 3), 0.5)
    assert psnr(target + 0.1, target) == pytest.approx(20.0, abs=1e-4)
    inside = torch.zeros(4, 6, dtype=torch.bool)
    inside[:2] = True
    image = target + torch.where(inside, 0.1, 0.4)[..., None]
    assert psnr(image, target, inside=inside) == pytest.approx(20.0, abs=1e-4)
    assert psnr(target, target) == math.inf
    # A screen shows 1.3 as 1.
    assert psnr(torch.full((4, 6, 3), 1.3), torch.full((4, 6, 3), 0.9)) == pytest.approx(20.0, abs=1e-4)
