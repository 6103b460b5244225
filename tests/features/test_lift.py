"""Lifting: a point gets the features that the images show at that very point, and at no other."""

import math
from dataclasses import dataclass, field, replace

import pytest
import torch
from scipy.spatial.transform import Rotation

from avmsf.errors import SceneError
from avmsf.features.lift import by_presence, by_visibility, lift, lift_points, supported
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.rasterizer.rasterizers import NumbaRasterizer, Rendering
from avmsf.gaussians.visibility import depth_of_cloud, depth_reach, depth_test
from avmsf.photographs.cameras import Camera, View
from factories.raising import raises

RADIUS, DISTANCE, FOCAL, WIDTH, HEIGHT = 0.1, 0.5, 500.0, 240, 220


def camera_at(direction: list[float], *, width: int = WIDTH, height: int = HEIGHT) -> Camera:
    position = torch.tensor(direction, dtype=torch.float64)
    position = DISTANCE * position / position.norm()
    up = torch.tensor([0.3, 0.2, 1.0])
    return Camera.looking(position, torch.zeros(3), up=up, focal=FOCAL, width=width, height=height)


def view_of(camera: Camera, *, mask: torch.Tensor | None = None) -> View:
    return View("a view", torch.zeros(camera.height, camera.width, 3, dtype=torch.uint8), camera, mask)


AROUND = [camera_at(d) for d in ([1, 0, 0], [0, 1, 0.2], [-1, 0.3, 0], [0, -1, 0.4], [0.5, 0.1, 1], [0.1, 0.5, -1])]


def sphere_points(count: int = 500) -> torch.Tensor:
    steps = torch.arange(count, dtype=torch.float64) + 0.5
    height, turn = 1 - 2 * steps / count, math.pi * (1 + math.sqrt(5)) * steps
    flat = (1 - height**2).sqrt()
    return RADIUS * torch.stack([flat * turn.cos(), flat * turn.sin(), height], dim=1)


def sphere_depth(camera: Camera) -> torch.Tensor:
    """Depth of the sphere about the origin at each pixel's center, in closed form; 0 beside it."""
    places = sphere_places(camera)
    along = (places - camera.position) @ camera.world_to_camera[2, :3]
    closest = torch.linalg.cross(camera.rays(), camera.position.expand(camera.height, camera.width, 3)).norm(dim=-1)
    return torch.where(closest <= RADIUS, along, 0.0)


def sphere_places(camera: Camera) -> torch.Tensor:
    """Where each pixel's ray first meets the sphere, or comes nearest to it."""
    rays, eye = camera.rays(), camera.position
    middle = -(rays @ eye)
    half = (middle**2 - eye @ eye + RADIUS**2).clamp(min=0).sqrt()
    return eye + (middle - half)[..., None] * rays


@dataclass
class Painted:
    """An encoder that has the map of each view ready, in the views' order."""

    maps: list[torch.Tensor]
    name: str = "painted"
    images: list[torch.Tensor] = field(default_factory=list)

    def describe(self, image: torch.Tensor) -> torch.Tensor:
        self.images.append(image)
        return self.maps[len(self.images) - 1]


def painted_sphere(cameras: list[Camera]) -> Painted:
    """Maps, coarser than the images, of the object coordinates that each cell's middle shows."""
    return Painted([sphere_places(camera.resized(80, 55)).permute(2, 0, 1).float() for camera in cameras])


def sphere_cloud(points: torch.Tensor, scale: float = 0.004) -> GaussianCloud:
    count = len(points)
    rotations = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    scales, opacities = torch.full((count, 3), math.log(scale)), torch.full((count,), 3.0)
    return GaussianCloud(points.float(), rotations, scales, opacities, torch.zeros(count, 1, 3))


@pytest.mark.parametrize(("columns", "rows"), [(240, 220), (80, 55), (17, 16)])
def test_a_map_of_places_in_the_image_is_read_where_the_points_are(columns, rows):
    # Cell [row, column] of the map holds its own middle's pixel: bilinear interpolation of that is exact.
    camera = camera_at([1, 0.2, 0.3])
    x = (torch.arange(columns) + 0.5) * WIDTH / columns
    y = (torch.arange(rows) + 0.5) * HEIGHT / rows
    encoder = Painted([torch.stack([x[None, :].expand(rows, columns), y[:, None].expand(rows, columns)])])
    points = 0.4 * sphere_points()
    ball = torch.full((HEIGHT, WIDTH), 1.0, dtype=torch.float64)
    lifted = lift_points(points, [view_of(camera)], encoder, depth_map=lambda _: ball)
    assert lifted.unseen == 0
    # A pixel is 1; float32 and its interpolation weights at numbers up to 240.
    torch.testing.assert_close(lifted.features.features.double(), camera.project(points)[0], rtol=0, atol=1e-3)


def test_every_point_gets_its_own_position():
    points = sphere_points()
    views = [view_of(camera) for camera in AROUND]

    def steep(visibility):
        """Count only views that see a point no flatter than at 60 degrees."""
        towards = visibility.camera.position - points
        return visibility.seen * ((points / RADIUS * towards / towards.norm(dim=1, keepdim=True)).sum(1) > 0.5).double()

    lifted = lift_points(points, views, painted_sphere(AROUND), depth_map=sphere_depth, weighting=steep)
    known = lifted.seen > 0
    # Six views that each count a cap of 60 degrees.
    assert int(known.sum()) > 400
    error = (lifted.features.features - points)[known].norm(dim=1)
    # Cells of h = 4 mm: bilinear interpolation errs by h^2 / 8 times the second derivative along both axes of the
    # image, at most 1 / (R cos^3) of depth a meter at 60 degrees: .3 mm each. Half a cell off would be 2 mm off.
    assert float(error.max()) < 6e-4
    assert float(error.median()) < 1e-4


def test_gaussians_get_their_own_positions():
    points = sphere_points()

    def rasterizer(cloud, camera, *, background):
        depth = sphere_depth(camera).float()
        color, screen, radii = torch.zeros(HEIGHT, WIDTH, 3), torch.zeros(len(cloud), 2), torch.ones(len(cloud))
        return Rendering(color, (depth > 0).float(), depth, screen, radii)

    views = [view_of(camera) for camera in AROUND]
    lifted = lift(sphere_cloud(points), views, painted_sphere(AROUND), rasterizer=rasterizer)
    known = lifted.seen > 0
    # Steep views count, too: their cells span four times as much.
    assert float((lifted.features.features - points)[known].norm(dim=1).median()) < 5e-4
    assert lifted.features.encoder == "painted"
    # What the views say of one point differs by tenths of millimeters, between points by ten centimeters.
    assert lifted.agreement > 0.999


def test_rendered_gaussians_hide_what_lies_behind_them():
    points = sphere_points(2500)
    cloud, camera = sphere_cloud(points), AROUND[0]
    depth = depth_of_cloud(cloud, NumbaRasterizer())(camera)
    visibility = depth_test(cloud.centers, view_of(camera), depth, reach=depth_reach(cloud, camera))
    towards = camera.position - points
    cosine = (points / RADIUS * towards / towards.norm(dim=1, keepdim=True)).sum(1)
    # Gaussians of 4 mm: the shell is some millimeters thick and its rim uncertain by as much.
    assert not bool(visibility.seen[cosine < -0.2].any())
    assert float(visibility.seen[cosine > 0.6].double().mean()) > 0.95


def test_an_occluder_hides_what_is_behind_it_and_no_more():
    # A plate at depth .4 before a wall at .5, left half of the image.
    camera = camera_at([0, 0, 1], width=100, height=100)
    depth = torch.full((100, 100), 0.5, dtype=torch.float64)
    depth[:, :50] = 0.4
    pixels = torch.tensor([[10.3, 20.1], [49.0, 50.0], [51.2, 50.0], [90.0, 10.0]], dtype=torch.float64)
    inside = torch.cat([(pixels - 50) / FOCAL * 0.5, torch.full((4, 1), 0.5, dtype=torch.float64)], dim=1)
    pose = torch.linalg.inv(camera.world_to_camera)
    wall = inside @ pose[:3, :3].T + pose[:3, 3]
    still = torch.zeros(4, dtype=torch.float64)
    assert depth_test(wall, view_of(camera), depth, reach=still).seen.tolist() == [False, False, True, True]
    assert depth_test(wall, view_of(camera), depth, reach=still + 0.11).seen.all()
    # The plate's own points lie in front of what they hide.
    plate = (inside * 0.4 / 0.5) @ pose[:3, :3].T + pose[:3, 3]
    assert depth_test(plate, view_of(camera), depth, reach=still).seen.all()


def test_points_outside_the_image_or_the_mask_or_behind_the_camera_are_not_seen():
    camera = camera_at([0, 0, 1], width=100, height=100)
    depth = torch.full((100, 100), 0.5, dtype=torch.float64)
    mask = torch.full((100, 100), 255, dtype=torch.uint8)
    mask[:50] = 0
    places = torch.tensor([[0.0, 0, 0], [0, 0, 2], [9, 0, 0], [0, 0, DISTANCE]], dtype=torch.float64)
    still = torch.zeros(4, dtype=torch.float64)
    assert depth_test(places, view_of(camera), depth, reach=still).seen.tolist() == [True, False, False, False]
    up, down = (torch.tensor([[0, sign * 0.02, 0.0]], dtype=torch.float64) for sign in (1, -1))
    below = [float(camera.project(each)[0][0, 1]) > 50 for each in (up, down)]
    seen = [bool(depth_test(each, view_of(camera, mask=mask), depth, reach=still[:1]).seen) for each in (up, down)]
    assert seen == below
    assert sorted(seen) == [False, True]
    # A pixel without depth shows no surface, however far a point reaches.
    assert not depth_test(places, view_of(camera), torch.zeros_like(depth), reach=still + 9).seen.any()


def test_unseen_points_take_the_mean_of_the_three_nearest_seen():
    points = sphere_points(300)
    lifted = lift_points(points, [view_of(AROUND[0])], painted_sphere(AROUND[:1]), depth_map=sphere_depth)
    known = lifted.seen > 0
    assert lifted.unseen == int((~known).sum()) > 150
    near = torch.cdist(points[~known], points[known]).topk(3, largest=False).indices
    expected = lifted.features.features[known][near].mean(1)
    torch.testing.assert_close(lifted.features.features[~known], expected, rtol=0, atol=1e-7)


def test_weights_and_counts_are_the_weightings_own():
    # Two cameras at 1 and 2 distances that say 0 and 1 of every point: nearer by two is four times the pixels.
    near, far = camera_at([1, 0, 0]), camera_at([1, 0, 0])
    pose = far.world_to_camera.clone()
    pose[2, 3] += DISTANCE
    far = Camera(pose, far.focal, far.principal, WIDTH, HEIGHT)
    points = torch.zeros(1, 3, dtype=torch.float64)
    views = [view_of(near), view_of(far)]
    for weighting, mean in ((by_presence, 0.5), (by_visibility, 0.2)):
        encoder = Painted([torch.zeros(1, 4, 4), torch.ones(1, 4, 4)])
        lifted = lift_points(
            points, views, encoder, depth_map=lambda c: torch.full((HEIGHT, WIDTH), 5.0), weighting=weighting
        )
        assert float(lifted.features.features) == pytest.approx(mean, abs=1e-6)
        assert lifted.seen.tolist() == [2]


def test_agreement_is_the_share_of_variance_between_points():
    # Two points, two views: features +1 and -1 of the points, +d and -d of the views: variances 1 and d^2.
    camera = camera_at([1, 0, 0])
    places = torch.tensor([[0, 0.05, 0], [0, -0.05, 0]], dtype=torch.float64)
    left = camera.project(places)[0][:, 0] < WIDTH / 2
    assert left.tolist() in ([True, False], [False, True])
    halves = torch.where(torch.arange(40) < 20, 1.0, -1.0).expand(1, 30, 40)
    encoder = Painted([halves + 0.5, halves - 0.5])
    wall = torch.full((HEIGHT, WIDTH), 1.0)
    lifted = lift_points(places, [view_of(camera)] * 2, encoder, depth_map=lambda c: wall)
    assert lifted.agreement == pytest.approx(1 / 1.25, abs=1e-6)


def test_a_gaussians_reach_is_its_deviation_along_the_view():
    generator = torch.Generator().manual_seed(5)
    quaternions = torch.randn(20, 4, generator=generator)
    scales = torch.rand(20, 3, generator=generator) * 0.02 + 0.001
    cloud = GaussianCloud(torch.zeros(20, 3), quaternions, scales.log(), torch.zeros(20), torch.zeros(20, 1, 3))
    camera = camera_at([0.3, -0.5, 0.7])
    turns = torch.from_numpy(Rotation.from_quat(quaternions[:, [1, 2, 3, 0]].numpy()).as_matrix())
    covariance = turns @ torch.diag_embed(scales.double() ** 2) @ turns.transpose(1, 2)
    axis = camera.world_to_camera[2, :3]
    expected = torch.einsum("i,nij,j->n", axis, covariance, axis).sqrt()
    torch.testing.assert_close(depth_reach(cloud, camera).double(), expected, rtol=1e-5, atol=0)


def test_the_encoder_never_sees_the_background():
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.uint8)
    mask[50:150, 60:180] = 255
    image = torch.full((HEIGHT, WIDTH, 3), 10, dtype=torch.uint8)
    image[50:150, 60:180] = 100
    encoder = painted_sphere(AROUND[:1])
    lift_points(sphere_points(50), [View("v", image, AROUND[0], mask)], encoder, depth_map=sphere_depth)
    torch.testing.assert_close(encoder.images[0], torch.full((HEIGHT, WIDTH, 3), 100 / 255))
    plain = painted_sphere(AROUND[:1])
    view = View("v", image, AROUND[0], mask)
    lift_points(sphere_points(50), [view], plain, depth_map=sphere_depth, inpainted=False)
    torch.testing.assert_close(plain.images[0].float(), view.color.float())


def test_points_that_the_views_agree_to_be_hidden_or_afloat_are_left_out() -> None:
    outside, views = sphere_points(), [view_of(camera) for camera in AROUND]
    afloat = torch.tensor([[0.0, 0.0, 1.3 * RADIUS], [1.3 * RADIUS, 0.0, 0.0]])
    points = torch.cat([outside, 0.8 * outside, afloat])
    still = torch.zeros(len(points))
    lifted = lift_points(points, views, painted_sphere(AROUND), depth_map=sphere_depth, reach=lambda _: still)
    kept = supported(lifted)
    # The inner ones lie 20 mm beneath a surface that the views know to a millimeter.
    assert bool((lifted.seen[500:1000] == 0).all())
    assert bool((lifted.past[1000:] > 0).all())
    assert float((kept.features.points.norm(dim=1) - RADIUS).abs().max()) < 1e-6
    # Hardly any of the surface, though depth changes by more than two pixels beside its outlines.
    assert len(kept.features.points) > 450
    assert kept.dropped == len(points) - len(kept.features.points)
    assert bool((kept.seen > 0).all())


def _lift(points=None, count: int = 1, maps=None):
    views = [view_of(camera) for camera in AROUND[:count]]
    encoder = painted_sphere(AROUND[:count]) if maps is None else Painted(maps)
    return lift_points(sphere_points(50) if points is None else points, views, encoder, depth_map=sphere_depth)


@pytest.mark.parametrize(
    ("work", "name", "value"),
    [
        (lambda: _lift(sphere_points(50) + torch.tensor([100.0, 0, 0])), "points", 0),
        (lambda: _lift(torch.zeros(0, 3)), "points", 0),
        (lambda: _lift(count=0, maps=[]), "views", 0),
        (lambda: _lift(maps=[torch.full((2, 3, 4), torch.nan)]), "painted", [2, 3, 4]),
        (lambda: _lift(maps=[torch.zeros(2, 0, 4)]), "painted", [2, 0, 4]),
        (lambda: _lift(count=2, maps=[torch.zeros(2, 3, 4), torch.zeros(3, 3, 4)]), "a view", 3),
        (lambda: supported(replace((lifted := _lift()), past=lifted.seen)), "points", 0),
    ],
)
def test_what_cannot_be_lifted_is_refused(work, name, value):
    with raises(SceneError, name=name, value=value):
        work()
