"""The probability of a contact, as a picture of the object from all sides and as a colored point cloud."""

from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf.errors import EvaluationError
from avmsf.localization.contact_map import ContactPosterior
from avmsf.plotting.clouds import ALL_SIDES, Side, draw_cloud
from avmsf.plotting.style import FIRST, SECOND, SEQUENTIAL, styled

_DECADES = 3.0
"""Powers of ten below the likeliest that colors tell apart."""
_FOUND, _OTHER, _TRUTH = to_rgb(FIRST), (0.95, 0.95, 0.95), to_rgb(SECOND)
"""Blue and red, the paper's colors of the found and the true contact."""
_MARK = 0.018
"""Radius of a mark over the object's diagonal."""
_Mark: TypeAlias = tuple[Tensor, tuple[float, float, float]]
_DRAWN = 6000
"""Points in a picture, about."""


@styled
def draw_contact(
    contact: ContactPosterior,
    *,
    title: str,
    others: Float[Tensor, "others 3"] | None = None,
    truth: Float[Tensor, " 3"] | None = None,
    sides: Sequence[Side] = ALL_SIDES,
) -> Figure:
    """Draw the probability of a contact over the object, and below it the paper's cosine distance, from all sides.

    The most probable contact is marked blue, equivalent `others` white, and the true contact, `truth`, red if given.
    """
    points = contact.points
    # The likeliest point and its neighborhood must not fall between those that are drawn.
    rows = torch.arange(0, len(points), max(1, len(points) // _DRAWN))
    rows = torch.unique(torch.cat([rows, torch.topk(contact.probability, min(64, len(points))).indices]))
    marks: list[_Mark] = [] if others is None else [(each, _OTHER) for each in others]
    marks.append((contact.position, _FOUND))
    if truth is not None:
        marks.append((truth, _TRUTH))
    low, high = float(contact.distance.min()), float(contact.distance.max())
    high = max(high, low + 1e-6)
    colors = {
        "probability": contact_colors(contact),
        "cosine distance": _heat(1.0 - (contact.distance.double() - low) / (high - low)),
    }
    painted = {name: _marked(points, each, marks)[rows] for name, each in colors.items()}
    used = {color for _, color in marks}
    named = ((_FOUND, "blue: most probable"), (_OTHER, "white: equivalent"), (_TRUTH, "red: true contact"))
    legend = ", ".join(words for color, words in named if color in used)
    figure = draw_cloud(points[rows], painted, title=f"{title}\n{legend}", sides=sides)
    panels = np.array(figure.axes).reshape(len(colors), -1)
    likely = ScalarMappable(Normalize(-_DECADES, 0.0), SEQUENTIAL)
    figure.colorbar(likely, ax=list(panels[0]), shrink=0.75, label="log10 of probability / maximum")
    distant = ScalarMappable(Normalize(low, high), f"{SEQUENTIAL}_r")
    figure.colorbar(distant, ax=list(panels[1]), shrink=0.75, label="cosine distance of the gains")
    return figure


def contact_colors(contact: ContactPosterior) -> Float[Tensor, "points 3"]:
    """Return colors, 0 to 1, dark purple for a thousandth of the greatest probability and less, up to yellow."""
    likely = contact.probability.double()
    share = likely / likely.max().clamp_min(torch.finfo(torch.float64).tiny)
    level = 1.0 + torch.log10(share.clamp_min(10.0**-_DECADES)) / _DECADES
    return _heat(level)


def write_contact_cloud(contact: ContactPosterior, path: Path) -> None:
    """Write the object's points with their colors as a binary `.ply` that any viewer of point clouds opens.

    The vertices have the floats `probability` (they sum to one) and `cosine_distance` beside place and color. Raises
    EvaluationError where it cannot be written.
    """
    numbers = ("probability", "cosine_distance")
    kinds = dict.fromkeys("xyz", "<f4") | dict.fromkeys(("red", "green", "blue"), "u1") | dict.fromkeys(numbers, "<f4")
    colors = (255.0 * contact_colors(contact)).round()
    columns = [*contact.points.double().T, *colors.T, contact.probability, contact.distance]
    table = np.rec.fromarrays([column.cpu().numpy() for column in columns], dtype=list(kinds.items()))
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in kinds.items()]
    header += ["end_header", ""]
    content = "\n".join(header).encode("ascii") + table.tobytes()
    write_whole(path, content, raising=EvaluationError)


def _heat(level: Float[Tensor, " points"]) -> Float[Tensor, "points 3"]:
    return torch.from_numpy(colormaps[SEQUENTIAL](level.clamp(0.0, 1.0).numpy())[:, :3]).float()


def _marked(
    points: Float[Tensor, "points 3"],
    colors: Float[Tensor, "points 3"],
    marks: Sequence[_Mark],
) -> Float[Tensor, "points 3"]:
    """Return the colors with those of the points about each mark replaced by the mark's."""
    painted = colors.clone()
    diagonal = float((points.amax(0) - points.amin(0)).norm())
    for place, color in marks:
        apart = (points.double() - place.double()).norm(dim=1)
        near = (apart <= max(_MARK * diagonal, float(apart.min()))).nonzero().flatten()
        ring = near[apart[near] >= 0.5 * _MARK * diagonal]
        # A ring leaves the heat in its middle visible; where points are sparse, the nearest one alone is painted.
        painted[ring if len(ring) >= 6 else near] = torch.tensor(color)
    return painted
