"""The probability of a contact, as a picture of the object from all sides."""

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from torch import Tensor

from avmsf.localization.contact_map import ContactPosterior
from avmsf.plotting.clouds import ALL_SIDES, draw_cloud, in_front, view_from
from avmsf.plotting.style import FIRST, SECOND, SEQUENTIAL, styled

_DECADES = 3.0
"""Powers of ten below the likeliest that colors tell apart."""
_LEGEND = {FIRST: "blue: most probable", "white": "white: equivalent", SECOND: "red: true contact"}
"""Colors of marks; blue and red are the paper's of the found and the true contact."""
_DRAWN = 6000
"""Points in a picture, about."""


@styled
def draw_contact(
    contact: ContactPosterior,
    *,
    title: str,
    others: Float[Tensor, "others 3"] | None = None,
    truth: Float[Tensor, " 3"] | None = None,
) -> Figure:
    """Draw the probability of a contact over the object, and below it the paper's cosine distance, from all sides.

    The most probable contact is marked blue, equivalent `others` white, and the true contact, `truth`, red if given.
    """
    points = contact.points
    # The likeliest point and its neighborhood must not fall between those that are drawn.
    rows = torch.arange(0, len(points), max(1, len(points) // _DRAWN))
    rows = torch.unique(torch.cat([rows, torch.topk(contact.probability, min(64, len(points))).indices]))
    marks = [] if others is None else [("white", each) for each in others]
    marks += [(FIRST, contact.position), *([] if truth is None else [(SECOND, truth)])]
    low, high = float(contact.distance.min()), float(contact.distance.max())
    high = max(high, low + 1e-6)
    colors = {
        "probability": contact_colors(contact)[rows],
        "cosine distance": _heat(1.0 - (contact.distance.double() - low) / (high - low))[rows],
    }
    legend = ", ".join(words for color, words in _LEGEND.items() if color in dict(marks))
    figure = draw_cloud(points[rows], colors, title=f"{title}\n{legend}", sides=ALL_SIDES)
    panels = np.array(figure.axes).reshape(len(colors), -1)
    drawn, places = points[rows].double().numpy(), np.stack([each.double().numpy() for _, each in marks])
    middle, edges = (drawn.min(0) + drawn.max(0)) / 2, np.array([color for color, _ in marks])
    for axes, side in zip(panels.flat, ALL_SIDES * len(colors), strict=True):
        frame = view_from(side).T
        visible = in_front(drawn @ frame, places @ frame)
        spots = (places[visible] - middle) @ frame
        axes.scatter(spots[:, 0], spots[:, 1], s=80, facecolors="none", edgecolors=edges[visible], linewidths=2)
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


def _heat(level: Float[Tensor, " points"]) -> Float[Tensor, "points 3"]:
    return torch.from_numpy(colormaps[SEQUENTIAL](level.clamp(0.0, 1.0).numpy())[:, :3]).float()
