import math
import sys
from dataclasses import fields
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numba
import pytest
import torch

from avmsf.errors import SceneError
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.rasterizer.projection import project
from avmsf.gaussians.rasterizer.rasterizers import NumbaRasterizer, Rendering, choose_rasterizer
from avmsf.photographs.cameras import Camera
from factories.raising import raises
from oracles.gaussian_image import render_everywhere, splats

NAMES = tuple(each.name for each in fields(GaussianCloud))
BACKGROUND = torch.tensor([0.2, 0.5, 0.9])


def cloud_of(count: int = 250, *, degree: int = 1, seed: int = 0) -> GaussianCloud:
    """Gaussians with axes of 1 to 30 mm in a ball of about 0.1 m; a third of them opaque, some beyond the camera."""
    generator = torch.Generator().manual_seed(seed)
    draw = partial(torch.randn, generator=generator)
    centers = 0.1 * draw(count, 3)
    centers[::9] *= 4
    opacities = 2 * draw(count)
    opacities[::3] = 8.0
    harmonics = 0.5 * draw(count, (degree + 1) ** 2, 3)
    return GaussianCloud(centers, draw(count, 4), math.log(0.006) + 0.6 * draw(count, 3), opacities, harmonics)


def camera_of(width: int = 83, height: int = 61, *, distance: float = 0.35) -> Camera:
    position = distance * torch.tensor([0.6, -0.64, 0.48])
    camera = Camera.looking(position, torch.zeros(3), up=torch.eye(3)[2], focal=70.0, width=width, height=height)
    # Off the middle, and with pixels that are not square.
    return Camera(camera.world_to_camera, (70.0, 74.0), (width / 2 + 3.3, height / 2 - 1.7), width, height)


def leaves(cloud: GaussianCloud, dtype: torch.dtype = torch.float32) -> GaussianCloud:
    return GaussianCloud(*(getattr(cloud, name).detach().to(dtype).clone().requires_grad_() for name in NAMES))


def image_of(cloud: GaussianCloud, camera: Camera) -> Rendering:
    return NumbaRasterizer()(cloud, camera, background=BACKGROUND)


def single(place: tuple[float, float, float], *, scale: float = 0.01, logit: float = 1.0) -> GaussianCloud:
    size, color = torch.full((1, 3), math.log(scale)), torch.tensor([[[1.0, 0.0, -1.0]]])
    return GaussianCloud(torch.tensor([place]), torch.tensor([[1.0, 0, 0, 0]]), size, torch.tensor([logit]), color)


AHEAD = Camera(torch.eye(4, dtype=torch.float64), (100.0, 100.0), (20.0, 13.0), 40, 27)
"""At the origin, along z."""


@pytest.mark.parametrize("distance", [0.35, 0.12])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_images_and_gradients_are_the_oracles(degree: int, distance: float) -> None:
    cloud, camera = cloud_of(degree=degree), camera_of(distance=distance)
    own, true = leaves(cloud), leaves(cloud, torch.float64)
    found = image_of(own, camera)
    expected, undecided = render_everywhere(true, camera, background=BACKGROUND)
    assert undecided.float().mean() < 0.02
    clear = ~undecided
    # Float32's rounding of a hundred blended layers is a few 1e-7; 1e-5 is well under one step of 8 bits.
    for name in ("color", "alpha", "depth"):
        torch.testing.assert_close(
            getattr(found, name)[clear].double(), getattr(expected, name)[clear].detach(), atol=1e-5, rtol=0
        )
    found.screen.retain_grad()
    expected.screen.retain_grad()
    generator = torch.Generator().manual_seed(1)
    for rendering in (found, expected):
        generator.manual_seed(1)
        loss = 0.0
        for name in ("color", "alpha", "depth"):
            values = getattr(rendering, name)
            loss = loss + (values * torch.randn(values.shape, generator=generator))[clear].sum()
        loss.backward()
    pairs = [(name, getattr(own, name).grad, getattr(true, name).grad) for name in NAMES]
    for name, gradient, truth in [*pairs, ("screen", found.screen.grad, expected.screen.grad)]:
        assert float((gradient - truth).norm() / truth.norm()) < 1e-4, name


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_colors_turn_with_the_direction_of_view(degree: int) -> None:
    # In an image's gradient by the centers the places drown the directions: here the colors are on their own.
    own, true = leaves(cloud_of(degree=degree)), leaves(cloud_of(degree=degree), torch.float64)
    found, radii = (project(own, camera_of())[place] for place in (3, 5))
    expected = splats(true, camera_of()).colors
    seen = radii[:, 0] > 0
    slopes = torch.randn(found.shape, generator=torch.Generator().manual_seed(1)) * seen[:, None]
    torch.testing.assert_close(found[seen].double(), expected[seen], atol=1e-6, rtol=0)
    (found * slopes).sum().backward()
    (expected * slopes).sum().backward()
    for name in ("centers", "harmonics"):
        gradient, truth = getattr(own, name).grad, getattr(true, name).grad
        assert float((gradient - truth).norm() / truth.norm()) < 1e-5, name


def test_a_round_gaussian_straight_ahead_is_a_bell() -> None:
    found = image_of(single((0.0, 0.0, 0.5), scale=0.01, logit=1.0), AHEAD)
    # 100 pixels x 0.01 m / 0.5 m, and the blur of 0.3 square pixels.
    variance = (100 * 0.01 / 0.5) ** 2 + 0.3
    opacity = 1 / (1 + math.exp(-1.0))
    down, across = torch.meshgrid(torch.arange(27) + 0.5, torch.arange(40) + 0.5, indexing="ij")
    alpha = opacity * torch.exp(-((across - 20) ** 2 + (down - 13) ** 2) / (2 * variance))
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    torch.testing.assert_close(found.alpha, alpha, atol=1e-6, rtol=0)
    # The constant harmonic is 1 / (2 sqrt(pi)); a color is half more, and nothing is darker than black.
    light = 0.5 / math.sqrt(math.pi)
    color = torch.tensor([0.5 + light, 0.5, 0.5 - light])
    torch.testing.assert_close(
        found.color, alpha[..., None] * color + (1 - alpha[..., None]) * BACKGROUND, atol=1e-6, rtol=0
    )
    torch.testing.assert_close(found.depth, torch.where(alpha > 0, 0.5, 0.0), atol=1e-5, rtol=0)
    torch.testing.assert_close(found.screen, torch.tensor([[20.0, 13.0]]), atol=1e-5, rtol=0)
    reach = math.sqrt(2 * variance * math.log(255 * opacity))
    torch.testing.assert_close(found.radii, torch.tensor([reach]), atol=1e-4, rtol=0)


def test_the_order_of_the_gaussians_is_of_no_effect() -> None:
    cloud, camera = cloud_of(), camera_of()
    order = torch.randperm(len(cloud), generator=torch.Generator().manual_seed(3))
    assert len(torch.unique(cloud.centers, dim=0)) == len(cloud)
    assert torch.equal(image_of(cloud, camera).color, image_of(cloud.take(order), camera).color)
    assert torch.equal(image_of(cloud, camera).radii[order], image_of(cloud.take(order), camera).radii)


def test_two_runs_give_the_same_bits_with_any_number_of_lanes(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes = []
    for lanes in (1, 1, 5):
        monkeypatch.setattr(numba, "get_num_threads", lambda lanes=lanes: lanes)
        cloud = leaves(cloud_of(600))
        found = image_of(cloud, camera_of())
        (found.color.square().sum() + found.depth.sum()).backward()
        outcomes.append([found.color.detach(), found.depth.detach(), *(getattr(cloud, name).grad for name in NAMES)])
    for other in outcomes[1:]:
        assert all(torch.equal(one, same) for one, same in zip(outcomes[0], other, strict=True))


@pytest.mark.parametrize("name", ["ellipses", "harmonics", "tiles", "pixels"])
def test_a_kernel_needs_no_other_file(name: str) -> None:
    # numba keeps what it compiled until the kernel's own file changes: with a helper or a constant from another file
    # it would go on with the old one.
    source = Path(__file__).resolve().parents[2] / "src" / "avmsf" / "gaussians" / "rasterizer" / f"{name}.py"
    # The decorator alone, whose options stand in the kernel's file.
    assert "avmsf" not in source.read_text().replace("from avmsf._utils.compiled import compiled\n", "")


def test_an_empty_cloud_shows_the_background() -> None:
    cloud = leaves(cloud_of().take(torch.tensor([], dtype=torch.long)))
    found = image_of(cloud, AHEAD)
    assert torch.equal(found.color, BACKGROUND.expand(27, 40, 3))
    assert not bool(found.alpha.any())
    assert not bool(found.depth.any())
    assert (found.screen.shape, found.radii.shape) == ((0, 2), (0,))
    found.color.sum().backward()
    assert cloud.centers.grad.shape == (0, 3)


@pytest.mark.parametrize(
    "cloud",
    [
        single((0.0, 0.0, -0.5)),
        single((0.0, 0.0, 0.009)),
        single((0.5, 0.0, 0.5)),
        single((0.0, 0.0, 0.5), logit=-8.0),
        single((0.0, 0.0, 0.5), logit=-1000.0),
        single((0.0, 0.0, 0.5), scale=1e300),
        single((1e38, -1e38, 0.5)),
    ],
    ids=["behind", "before the near plane", "beside", "too faint", "nothing", "larger than numbers", "far aside"],
)
def test_what_is_not_seen_leaves_no_trace(cloud: GaussianCloud) -> None:
    cloud = leaves(cloud)
    found = image_of(cloud, AHEAD)
    assert torch.equal(found.color, BACKGROUND.expand(27, 40, 3))
    assert float(found.radii) == 0.0
    (found.color.sum() + found.depth.sum() + found.alpha.sum()).backward()
    assert all(not bool(getattr(cloud, name).grad.any()) for name in NAMES)


@pytest.mark.parametrize(
    "log_scales",
    [[25.0, 25.0, 25.0], [-200.0, -200.0, -200.0], [2.0, -90.0, -90.0], [20.0, -20.0, 0.0], [15.0, 15.0, -90.0]],
    ids=["huge", "a point", "a needle", "all sizes", "a sheet"],
)
def test_degenerate_gaussians_stay_finite(log_scales: list[float]) -> None:
    cloud = cloud_of(40, degree=3)
    cloud.log_scales[7] = torch.tensor(log_scales)
    cloud.centers[7] = torch.tensor([0.01, 0.02, 0.03])
    cloud = leaves(cloud)
    found = image_of(cloud, camera_of())
    (found.color.square().sum() + found.depth.sum() + found.alpha.square().sum()).backward()
    assert float(found.radii[7]) > 0
    for tensor in [found.color, found.alpha, found.depth, found.radii, *(getattr(cloud, name).grad for name in NAMES)]:
        assert bool(torch.isfinite(tensor).all())
    assert float(found.alpha.detach().max()) <= 1.0


def test_a_missing_card_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with raises(SceneError, name="device", value="cuda"):
        choose_rasterizer("cuda")


def test_gsplat_is_given_what_it_expects(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, object] = {}

    def rasterization(**arguments: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        given.update(arguments)
        places = (arguments["means"][:, :2] * 3)[None]
        painted = places.sum() * torch.ones(1, 27, 40, 4) * torch.tensor([1.0, 2.0, 3.0, 4.0])
        radii = torch.tensor([[[3, 5]]], dtype=torch.int32)
        return painted, torch.ones(1, 27, 40, 1), {"means2d": places, "radii": radii}

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    own = choose_rasterizer("cuda")
    with raises(SceneError, name="cloud", value="cpu"):
        own(single((0.0, 0.0, 0.5)), AHEAD, background=BACKGROUND)
    # There is no card here: only the question where a tensor lies is answered otherwise.
    monkeypatch.setattr("avmsf.gaussians.rasterizer.rasterizers.is_on_gpu", lambda tensor: True)
    cloud = leaves(single((0.1, 0.2, 0.5), scale=0.02, logit=0.0))
    found = own(cloud, AHEAD, background=BACKGROUND)
    assert [given[name].shape for name in ("means", "quats", "scales", "opacities", "colors")] == [
        *((1, 3), (1, 4), (1, 3), (1,), (1, 1, 3))
    ]
    assert [given[name].shape for name in ("viewmats", "Ks", "backgrounds")] == [(1, 4, 4), (1, 3, 3), (1, 3)]
    assert (given["width"], given["height"], given["sh_degree"]) == (40, 27, 0)
    assert (given["render_mode"], given["packed"], given["near_plane"]) == ("RGB+ED", False, 0.01)
    torch.testing.assert_close(given["scales"], torch.full((1, 3), 0.02))
    torch.testing.assert_close(given["opacities"], torch.tensor([0.5]))
    torch.testing.assert_close(given["Ks"][0], torch.tensor([[100.0, 0, 20], [0, 100, 13], [0, 0, 1]]))
    assert (found.color.shape, found.alpha.shape, found.depth.shape) == ((27, 40, 3), (27, 40), (27, 40))
    assert float(found.radii) == 5.0
    found.screen.retain_grad()
    found.color.sum().backward()
    # The sum of all colors is 6 x 27 x 40 times that of the places.
    torch.testing.assert_close(found.screen.grad, torch.full((1, 2), 6.0 * 27 * 40))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device and gsplat: no device is here")
def test_gsplat_renders_what_the_cpu_does() -> None:
    pytest.importorskip("gsplat", reason="needs gsplat: pip install 'avmsf[gpu]'")
    cloud, camera = cloud_of(degree=3), camera_of()
    there = GaussianCloud(*(getattr(cloud, name).cuda() for name in NAMES))
    here, other = leaves(cloud), leaves(there)
    found = choose_rasterizer("cuda")(other, camera, background=BACKGROUND.cuda())
    expected = image_of(here, camera)
    _, undecided = render_everywhere(cloud, camera, background=BACKGROUND)
    # gsplat reckons all in float32, and cuts off by rectangles that it takes in float32 too.
    torch.testing.assert_close(found.color.cpu()[~undecided], expected.color[~undecided], atol=1e-4, rtol=0)
    slopes = torch.randn(expected.color.shape, generator=torch.Generator().manual_seed(1)) * ~undecided[..., None]
    (found.color * slopes.cuda()).sum().backward()
    (expected.color * slopes).sum().backward()
    for name in NAMES:
        truth = getattr(here, name).grad
        assert float((getattr(other, name).grad.cpu() - truth).norm() / truth.norm()) < 1e-3, name


def spoilt(name: str, row: int, value: float) -> GaussianCloud:
    cloud = cloud_of(20)
    getattr(cloud, name)[row] = value
    return cloud


@pytest.mark.parametrize(
    ("make", "attributes"),
    [
        *(
            (lambda name=name, value=value: spoilt(name, 13, value), {"row": 13, "name": name})
            for name in NAMES
            for value in (math.nan, math.inf, -math.inf)
        ),
        (lambda: spoilt("rotations", 4, 0.0), {"row": 4, "name": "rotations", "value": [0.0] * 4}),
        (lambda: leaves(cloud_of(5), torch.float64), {"name": "centers", "value": ["float64", "cpu"]}),
        (
            lambda: GaussianCloud(*(getattr(cloud_of(5), name).to("meta") for name in NAMES)),
            {"name": "centers", "value": ["float32", "meta"]},
        ),
    ],
)
def test_clouds_and_backgrounds_that_cannot_be_rendered_are_refused(make, attributes: dict) -> None:
    with raises(SceneError, **attributes):
        image_of(make(), camera_of())
    with raises(SceneError, name="background", value=["float64", "cpu"]):
        NumbaRasterizer()(cloud_of(5), camera_of(), background=BACKGROUND.double())
