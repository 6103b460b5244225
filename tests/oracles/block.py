"""A rectangular block as tetrahedra, the body whose beams, plates and bars have textbook frequencies."""

import itertools

import torch

from avmsf.fem.solid import Solid


def block(size: tuple[float, float, float], cells: tuple[int, int, int]) -> Solid:
    """Return a block from the origin to `size` meters, `cells` boxes along each axis, six tetrahedra a box.

    The tetrahedra of a box are the six ways from its lowest corner to its highest along the axes, so that those of
    neighboring boxes meet in whole sides.
    """
    places = [
        torch.linspace(0.0, side, number + 1, dtype=torch.float64) for side, number in zip(size, cells, strict=True)
    ]
    points = torch.cartesian_prod(*places)
    rows = torch.arange(len(points)).reshape([number + 1 for number in cells])
    lowest = rows[:-1, :-1, :-1].flatten()
    steps = [int(rows[1, 0, 0]), int(rows[0, 1, 0]), int(rows[0, 0, 1])]
    ways = [
        torch.stack([lowest, lowest + first, lowest + first + second, lowest + sum(steps)], dim=1)
        for first, second, _ in itertools.permutations(steps)
    ]
    return Solid.build(points, torch.cat(ways))
