"""Surfaces from outlines and depth, against closed forms: closed, hollow, thin, and with wrong masks."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from avmsf._utils.caching import source_digest
from avmsf.errors import SceneError
from avmsf.mesh.level_set import Grid, enclose
from avmsf.reconstruction import ObjectShape, object_shape, object_surface
from avmsf.reconstruction.distance import distance_from
from avmsf.reconstruction.fairing import fair_hull
from avmsf.reconstruction.object_shape import ShapeReport
from avmsf.reconstruction.outlines import Outline, hull_distance
from factories.looked_at import HEIGHT, RADIUS, ball, cup, cup_volume, depth_of, mesh_of, views_of

CELLS = 48
WALL = 0.004


def _shape(mesh: trimesh.Trimesh, *, behind: float = 0.0, cells: int = CELLS, **look: object) -> ObjectShape:
    return object_surface(views_of(mesh, **look), depth_of(mesh, behind=behind), cells=cells)


@pytest.fixture(scope="module")
def cup_shape() -> ObjectShape:
    return _shape(cup(wall=WALL), cells=64)


def test_a_ball_is_a_closed_ball_without_a_cavity() -> None:
    shape = _shape(ball(0.05))
    mesh = mesh_of(shape.as_seen())
    assert mesh.is_watertight
    off = np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.05)
    # In parts of the diagonal.
    assert off.mean() < 0.004 * shape.diagonal
    assert np.quantile(off, 0.95) < 0.012 * shape.diagonal
    assert not shape.hollow.any()
    assert shape.thickness_range is None
    with pytest.raises(SceneError):
        shape.shell(WALL)


@pytest.mark.parametrize("behind", [0.0, 0.002])
def test_a_cup_has_one_cavity_as_deep_as_it_is_though_depth_lies_behind_the_surface(behind: float) -> None:
    shape = _shape(cup(wall=WALL), behind=behind)
    assert int(shape.hollow.max()) == 1
    volume = int(shape.hollow.sum()) * shape.grid.spacing**3
    assert volume == pytest.approx(np.pi * RADIUS**2 * HEIGHT - cup_volume(WALL), rel=0.15)
    least, most = shape.thickness_range
    assert least < WALL < most
    assert mesh_of(shape.solid()).volume == pytest.approx(np.pi * RADIUS**2 * HEIGHT, rel=0.05)


def test_depth_that_errs_beside_a_cavity_dents_no_wall() -> None:
    # Depth of a band around the middle lies 3 mm behind what the masks show.
    deep, inner = RADIUS - 0.003, RADIUS - 2 * WALL
    outline = [(0, 0), (RADIUS, 0), (RADIUS, 0.02), (deep, 0.02), (deep, 0.04), (RADIUS, 0.04), (RADIUS, HEIGHT)]
    dented = trimesh.creation.revolve(
        np.array([*outline, (inner, HEIGHT), (inner, 2 * WALL), (0, 2 * WALL)]), sections=96
    )
    shape = object_surface(views_of(cup(wall=2 * WALL)), depth_of(dented), cells=CELLS)
    assert int(shape.hollow.max()) == 1
    points = mesh_of(shape.solid()).vertices
    radii = np.linalg.norm(points[np.abs(points[:, 2] - 0.03) < 0.005, :2], axis=1)
    assert float(np.median(radii)) == pytest.approx(RADIUS, abs=0.0007)


def test_a_cup_of_which_depth_shows_half_of_the_cavity_is_open_in_all_of_its_mouth() -> None:
    mesh = cup(wall=WALL)
    half = trimesh.creation.box(bounds=[(-1, 0, -1), (1, 1, 1)])
    filled = trimesh.boolean.union([mesh, trimesh.boolean.intersection([mesh.convex_hull, half])])
    shape = object_surface(views_of(mesh), depth_of(filled), cells=CELLS)
    assert mesh_of(shape.as_seen()).volume > 0.6 * mesh.convex_hull.volume
    assert mesh_of(shape.shell(WALL)).volume == pytest.approx(cup_volume(WALL), rel=0.05)


@pytest.mark.parametrize("wall", [0.0007, 0.002, 0.004, 0.008])
def test_a_shell_is_as_thick_as_asked_for_though_cells_are_wider(cup_shape: ObjectShape, wall: float) -> None:
    assert cup_shape.grid.spacing > 0.001
    mesh = mesh_of(cup_shape.shell(wall))
    assert mesh.is_watertight
    area = np.pi * RADIUS**2 + 2 * np.pi * RADIUS * HEIGHT
    # An eighth of a cell.
    assert mesh.volume == pytest.approx(cup_volume(wall), abs=0.125 * cup_shape.grid.spacing * area)


def test_a_thin_shell_of_few_triangles_is_not_pierced(cup_shape: ObjectShape) -> None:
    wall = 0.004 * cup_shape.diagonal
    mesh = mesh_of(cup_shape.shell(wall, faces=1100))
    assert mesh.is_watertight
    assert mesh.euler_number == 2
    assert len(mesh.faces) < 2400
    assert mesh.volume == pytest.approx(cup_volume(wall), rel=0.2)


def test_a_tube_is_open_at_both_ends() -> None:
    tube = trimesh.creation.annulus(0.027, 0.03, 0.08, sections=96)
    shape = _shape(tube)
    mesh = mesh_of(shape.shell(0.003))
    assert mesh.euler_number == 0
    assert mesh.volume == pytest.approx(tube.volume, rel=0.08)


def test_a_thin_plate_seen_from_both_sides_keeps_its_thickness() -> None:
    sides = (0.1, 0.06, 0.002)
    mesh = mesh_of(_shape(trimesh.creation.box(sides), cells=64).as_seen())
    assert mesh.volume == pytest.approx(np.prod(sides), rel=0.2)


def test_no_plate_is_a_frame_through_which_a_view_would_look() -> None:
    sides = (0.2, 0.06, 0.006)
    plate = _shape(trimesh.creation.box(sides))
    assert plate.supposed
    assert plate.thickness_range is None
    assert mesh_of(plate.solid()).volume == pytest.approx(np.prod(sides), rel=0.1)


def test_a_slender_shape_has_a_shell_below_a_face_that_may_be_open() -> None:
    # Half a rod that lies on its round side: cells are much smaller than the flat face is wide.
    rod = trimesh.creation.cylinder(radius=0.02, height=0.2, sections=96)
    half = trimesh.PointCloud(rod.vertices[rod.vertices[:, 1] < 1e-9]).convex_hull
    shape = _shape(half, cells=96)
    assert (shape.supposed, int(shape.hollow.max())) == (True, 1)
    wall, area = 0.002, np.pi * 0.02 * 0.2 + np.pi * 0.02**2
    assert mesh_of(shape.shell(wall)).volume == pytest.approx(area * wall, rel=0.15)


def test_views_that_alone_look_through_a_channel_keep_their_masks() -> None:
    length, width, height = 0.12, 0.05, 0.03
    sides = [((0.0, 0.0, -height / 2), (length, width, WALL))]
    sides += [((0.0, at * (width - WALL) / 2, 0.0), (length, WALL, height + WALL)) for at in (-1, 1)]
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for at, size in sides]
    shape = _shape(trimesh.util.concatenate(boxes))
    assert shape.report.rejected == ()
    assert mesh_of(shape.solid()).volume < 0.6 * length * width * (height + WALL)


def test_a_lid_that_is_bent_reaches_all_of_its_rims() -> None:
    # An angle bar of which only the middle of the inner faces is known to be a lid.
    legs, deep, wall, cell = (0.06, 0.04, 0.04), 0.01, 0.003, 0.001
    grid = Grid(np.full(3, -3.5 * cell), cell, tuple(round(each / cell) + 7 for each in legs))
    x, y, z = np.moveaxis(grid.centers(np.indices(grid.shape).reshape(3, -1).T), 1, 0).reshape(3, *grid.shape)
    ends = [low for at, leg in zip((x, y, z), legs, strict=True) for low in (at, leg - at)]
    outer = np.minimum(np.min(ends, axis=0), np.maximum(deep - y, deep - z)).astype(np.float32)
    known = (np.minimum(y, z) > deep - cell) & (np.min(ends, axis=0) > 0.006)
    hollow = ((outer > 0) & (outer < cell) & known).astype(np.int32)
    shape = ObjectShape(grid, outer, outer, hollow, True, float(np.linalg.norm(legs)), ShapeReport((), 0.0, 0.0))
    leg, inner = legs[1], legs[1] - 2 * wall
    solid, cavity = deep * (2 * leg - deep), (deep - wall) * (2 * inner - deep + wall)
    true = legs[0] * solid - (legs[0] - 2 * wall) * cavity
    assert mesh_of(shape.shell(wall)).volume == pytest.approx(true, rel=0.03)


def test_a_shallow_dome_is_as_thin_at_its_rim_as_in_the_middle() -> None:
    wide, high, wall = 0.06, 0.011, 0.003
    radius = (wide**2 + high**2) / (2 * high)
    low = radius - high

    def turned(hole: float) -> trimesh.Trimesh:
        """Return the dome, hollow within a distance from its axis."""
        outer, inner = np.linspace(0.0, wide, 24), np.linspace(0.0, hole, 12)
        within = np.stack([inner, np.sqrt((radius - wall) ** 2 - inner**2) - low], axis=1)
        around = np.stack([outer, np.sqrt(radius**2 - outer**2) - low], axis=1)
        return trimesh.creation.revolve(np.concatenate([within, [(hole, 0.0)], around[::-1]]), sections=96)

    dome = turned(np.sqrt((radius - wall) ** 2 - low**2))
    # Depth shows the middle of its cavity alone, as that of Gaussians does.
    shape = object_surface(views_of(dome), depth_of(turned(0.025)), cells=CELLS)
    assert mesh_of(shape.shell(wall)).volume == pytest.approx(abs(dome.volume), rel=0.1)


def test_wrong_masks_are_found_and_left_out() -> None:
    mesh = cup(wall=WALL)
    views = list(views_of(mesh))
    views[5] = replace(views[5], mask=torch.roll(views[5].mask, 40, dims=1))
    shape = object_surface(views, depth_of(mesh), cells=CELLS)
    assert shape.report.rejected == (views[5].name,)
    assert mesh_of(shape.solid()).volume == pytest.approx(np.pi * RADIUS**2 * HEIGHT, rel=0.05)


@pytest.mark.slow
def test_a_bottom_that_no_view_saw_is_closed_and_reported() -> None:
    block = trimesh.creation.cylinder(radius=0.04, height=0.08, sections=96)
    shape = _shape(block, elevations=(30.0, 50.0), azimuths=18)
    assert shape.report.unseen > 0.02
    assert float(shape.as_seen().vertices[:, 2].min()) == pytest.approx(-0.04, abs=0.005)
    assert _shape(block).report.unseen == 0.0


def test_the_digest_is_of_all_that_decides_the_surfaces(
    cup_shape: ObjectShape, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = [replace(cup_shape, **{name: getattr(cup_shape, name) + 1}) for name in ("outer", "seen", "hollow")]
    others.append(replace(cup_shape, supposed=not cup_shape.supposed))
    digests = {each.digest() for each in (cup_shape, replace(cup_shape), *others)}
    assert len(digests) == 5
    # Of the code that draws them too: bodies of another `shell` are not taken from a cache.
    read, code = Path.read_bytes, Path(object_shape.__file__)
    monkeypatch.setattr(Path, "read_bytes", lambda path: read(path) + b"# changed" * (path == code))
    source_digest.cache_clear()
    assert cup_shape.digest() not in digests
    source_digest.cache_clear()


@pytest.fixture(scope="module")
def block() -> ObjectShape:
    """Return a cylinder as low views show it; a tube looks the same, through both of whose ends none sees."""
    return _cylinder(elevations=(0.0, 15.0, -15.0))


def _cylinder(**look: object) -> ObjectShape:
    return _shape(trimesh.creation.cylinder(radius=0.03, height=0.05, sections=96), **look)


def test_both_ends_of_a_cylinder_may_be_open(block: ObjectShape) -> None:
    assert block.supposed
    assert int(block.hollow.max()) == 2
    for number in (1, 2):
        # An opening is smaller than the end by the reach of its edge; a cavity is a cell deep.
        area = int((block.hollow == number).sum()) * block.grid.spacing**2
        assert 0.7 * np.pi * 0.03**2 < area < np.pi * 0.03**2
    # What the views show is the block itself.
    assert mesh_of(block.as_seen()).volume == pytest.approx(np.pi * 0.03**2 * 0.05, rel=0.03)


@pytest.mark.parametrize("wall", [0.002, 0.004])
def test_the_wall_around_a_supposed_cavity_is_a_tube(block: ObjectShape, wall: float) -> None:
    mesh = mesh_of(block.shell(wall))
    assert mesh.is_watertight
    # The outer side of the hull is up to 1 % too wide, and the tube's ends are rounded.
    assert mesh.volume == pytest.approx(np.pi * 0.05 * (0.03**2 - (0.03 - wall) ** 2), rel=0.1)


def test_a_supposed_cavity_may_be_closed_all_round(block: ObjectShape, cup_shape: ObjectShape) -> None:
    wall = 0.004
    within = np.pi * (0.03 - wall) ** 2 * (0.05 - 2 * wall)
    # Of steeper views some would look through both ends.
    for shape in (block.closed(), _cylinder()):
        mesh = mesh_of(shape.shell(wall))
        assert mesh.is_watertight
        assert mesh.euler_number == 4
        assert mesh.volume == pytest.approx(np.pi * 0.03**2 * 0.05 - within, rel=0.1)
        assert shape.closed() is None
    assert cup_shape.closed() is None


def test_views_do_not_bound_the_wall_of_a_supposed_cavity(block: ObjectShape, cup_shape: ObjectShape) -> None:
    assert block.thickness_range == pytest.approx((0.0025 * block.diagonal, 0.06 * block.diagonal))
    # Into an open cup of a wall of 4 mm they do see.
    assert not cup_shape.supposed
    assert cup_shape.thickness_range[1] < 0.06 * cup_shape.diagonal


@pytest.mark.slow
@pytest.mark.parametrize("pixels", [-2, 2])
def test_masks_that_are_all_too_large_or_too_small_leave_the_size_as_it_is(pixels: int) -> None:
    mesh = ball(RADIUS)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(pixels) + 1,) * 2)
    change = cv2.dilate if pixels > 0 else cv2.erode
    views = [replace(view, mask=torch.from_numpy(change(view.mask.numpy(), kernel))) for view in views_of(mesh)]
    shape = object_surface(views, depth_of(mesh), cells=CELLS)
    # A pixel is 1 mm wide there.
    radii = np.linalg.norm(mesh_of(shape.solid()).vertices, axis=1)
    assert float(radii.mean()) == pytest.approx(RADIUS, abs=0.0005)
    assert shape.report.mask_offset == pytest.approx(pixels, abs=0.4)


@pytest.mark.slow
def test_a_mask_that_is_wrong_about_a_small_part_is_left_out() -> None:
    # Mirrored masks differ in the arm alone, which is a hundredth of the volume.
    arm = trimesh.creation.box((0.03, 0.012, 0.012))
    arm.apply_translation((0.05, 0.0, 0.02))
    mesh = trimesh.util.concatenate([trimesh.creation.cylinder(radius=0.04, height=0.06, sections=96), arm])
    views = list(views_of(mesh))
    wrong = (3, 9)
    for row in wrong:
        views[row] = replace(views[row], mask=views[row].mask.flip((0, 1)).clone())
    shape = object_surface(views, depth_of(mesh), cells=CELLS)
    assert set(shape.report.rejected) == {views[row].name for row in wrong}
    assert float(shape.solid().vertices[:, 0].max()) == pytest.approx(0.065, abs=0.002)


def test_views_without_masks_or_from_one_side_are_refused() -> None:
    mesh = ball(RADIUS)
    views = views_of(mesh, elevations=(0.0,), azimuths=72, size=48)[:3]
    for few in (views, [replace(view, mask=None) for view in views]):
        with pytest.raises(SceneError):
            object_surface(few, depth_of(mesh), cells=CELLS)


@pytest.mark.parametrize("wall", [0.0, -1.0, float("nan"), 0.05, 1.2 * RADIUS])
def test_a_wall_as_thick_as_the_cup_is_wide_is_refused(cup_shape: ObjectShape, wall: float) -> None:
    with pytest.raises(SceneError):
        cup_shape.shell(wall)


GRID = Grid(np.full(3, -0.06), 0.004, (31, 31, 31))


def test_an_outline_lies_where_half_of_a_pixel_is_covered() -> None:
    (view, *_) = views_of(ball(0.05))
    mask = torch.zeros_like(view.mask)
    mask[:, 40:80] = 255
    mask[:, 80] = 85
    inside = Outline.of(replace(view, mask=mask)).inside
    # Between the middles of pixels 79, all covered, and 80, a third covered: three quarters of the way.
    assert inside[64, 78] == pytest.approx(1.75, abs=0.1)
    assert inside[64, 85] == pytest.approx(-5.25, abs=0.1)


def test_the_hull_of_a_ball_is_the_ball_within_half_a_pixel() -> None:
    outlines = [Outline.of(view) for view in views_of(ball(0.05), azimuths=24)]
    found = hull_distance(outlines, GRID, rank=0)
    truth = 0.05 - np.linalg.norm(GRID.centers(np.argwhere(np.ones(GRID.shape, bool))), axis=1).reshape(GRID.shape)
    near = np.abs(truth) < 0.004
    # A pixel is 1 mm wide there.
    assert float(np.abs(found - truth)[near].mean()) < 0.5e-3


def test_a_higher_rank_forgives_as_many_wrong_masks() -> None:
    views = list(views_of(ball(0.05)))
    views[0] = replace(views[0], mask=torch.zeros_like(views[0].mask))
    outlines = [Outline.of(view) for view in views]
    assert not (hull_distance(outlines, GRID, rank=0) > 0).any()
    assert (hull_distance(outlines, GRID, rank=1) > 0).any()


def _ball() -> np.ndarray:
    places = np.stack(np.meshgrid(*[np.arange(25.0)] * 3, indexing="ij"), axis=-1)
    return (8.3 - np.linalg.norm(places - 12.2, axis=-1)).astype(np.float32)


def test_distances_from_a_ball_are_exact_within_a_tenth_of_a_cell() -> None:
    values = _ball()
    found = distance_from(np.clip(values, -2.5, 2.5))
    off = np.abs(found - np.abs(values))
    assert off.mean() < 0.03
    assert np.quantile(off, 0.99) < 0.1


def test_a_part_that_is_left_out_is_no_surface() -> None:
    values = _ball()
    upper = np.zeros(values.shape, dtype=bool)
    upper[12:] = True
    found = distance_from(values, upper)
    # The nearest place of the lower half, from the top of the ball, is on its rim.
    assert found[20, 12, 12] == pytest.approx(np.hypot(8.3, 8.0), abs=0.8)
    assert np.isinf(distance_from(values, np.ones(values.shape, dtype=bool))).all()


def _hull(mesh: trimesh.Trimesh, *, taut: bool) -> trimesh.Trimesh:
    outlines = [Outline.of(view) for view in views_of(mesh, azimuths=24)]
    grid = Grid.around(mesh.bounds[0] - 0.03, mesh.bounds[1] + 0.03, cells=96, finest=1.0, margin=2)
    hull = hull_distance(outlines, grid, rank=0)
    values = fair_hull(hull, outlines, grid, float(np.linalg.norm(mesh.extents)))[0] if taut else hull
    return mesh_of(enclose(values, grid))


@pytest.mark.slow
def test_the_pyramid_above_a_flat_top_is_removed() -> None:
    block = trimesh.creation.cylinder(radius=0.05, height=0.04, sections=96)
    above = _hull(block, taut=False).bounds[1, 2] - 0.02
    assert above > 0.003
    assert _hull(block, taut=True).bounds[1, 2] - 0.02 < 0.35 * above
