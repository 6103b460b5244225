"""Bodies of a shape as photographs show it: what was seen, and walls of several thicknesses."""

from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
import trimesh

from avmsf.errors import SceneError
from avmsf.fem.candidate_bodies import SurfaceBodies
from avmsf.mesh.level_set import difference
from avmsf.mesh.surface import Surface
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import BodyConfig

SIDES = (0.08, 0.06, 0.05)


def box(inset: float, *, above: float = 0.0) -> Surface:
    """Return the block that the cup is cut from, each side but the upper one moved inwards."""
    low, high = (inset, inset, inset), (SIDES[0] - inset, SIDES[1] - inset, SIDES[2] + above)
    made = trimesh.creation.box(bounds=(low, high))
    return Surface(torch.tensor(made.vertices).float(), torch.tensor(made.faces))


@dataclass(frozen=True, eq=False)
class Cup:
    """A cup of flat sides whose wall is unknown; walls above `most` leave nothing of its cavity."""

    most: float = 0.02
    thickness_range: tuple[float, float] | None = (0.006, 0.018)

    def as_seen(self) -> Surface:
        return box(0.0)

    def digest(self) -> str:
        return f"{self}"

    def shell(self, thickness: float, *, faces: int) -> Surface:
        if thickness > self.most:
            raise SceneError("nothing is left of the cavity")
        return difference(self.as_seen(), box(thickness, above=0.01))


@pytest.mark.slow
def test_walls_cover_the_range_and_thicker_ones_are_stiffer() -> None:
    filled, *walls = SurfaceBodies(Cup(), count=6, dofs=4000).bodies
    assert filled.thickness is None
    assert [body.thickness for body in walls] == pytest.approx([0.006 * 3 ** (step / 4) for step in range(5)])
    lowest = [float(body.elastic.frequency[0]) for body in walls]
    assert lowest == sorted(lowest)
    # Of panels that bend, frequencies go with the thickness, 1.32 here; panels between thicker walls are
    # smaller, and coarse elements too stiff, more so in thinner walls.
    assert 1.2 < lowest[1] / lowest[0] < 1.6


def test_walls_that_cannot_be_had_are_left_out() -> None:
    found = SurfaceBodies(Cup(most=0.01), count=4, dofs=2000)
    assert all(body.thickness is None or body.thickness <= 0.01 for body in found.bodies)
    # Tetrahedra are random, and may miss a thin wall.
    assert len([wall for wall in found.refused if wall is not None and wall > 0.01]) == 3
    assert SurfaceBodies(Cup(most=0.01), count=4, dofs=2000).with_thickness(0.011) is None


@pytest.mark.slow
def test_the_thickness_is_searched_for_unless_it_is_known_or_there_is_no_cavity() -> None:
    config = BodyConfig(shapes=6, dofs=4000)
    searched = candidate_bodies(Cup(), config)
    assert searched.searches_thickness
    body = searched.with_thickness(0.007)
    assert body is not None
    assert body.thickness == 0.007
    known = candidate_bodies(Cup(), BodyConfig(wall=0.005, shapes=6, dofs=4000))
    assert (known.searches_thickness, [each.thickness for each in known.bodies]) == (False, [0.005])
    solid = candidate_bodies(Cup(thickness_range=None), config)
    assert (solid.searches_thickness, [each.thickness for each in solid.bodies]) == (False, [None])


@pytest.mark.slow
def test_bodies_of_a_shape_are_read_again_and_those_of_another_shape_are_not(tmp_path: Path) -> None:
    said: list[str] = []

    def frequency(shape: Cup) -> torch.Tensor:
        said.clear()
        made = SurfaceBodies(shape, thicknesses=[0.009], count=6, dofs=2000, cache=tmp_path, log=said.append)
        return made.bodies[0].elastic.frequency

    def computed() -> int:
        return sum("elastic modes of" in words for words in said)

    first = frequency(Cup())
    assert computed() == 1
    # Tetrahedra come out a little different each time; what is read is the same to the last bit.
    assert torch.equal(first, frequency(Cup()))
    assert computed() == 0
    frequency(Cup(most=0.019))
    assert computed() == 1
