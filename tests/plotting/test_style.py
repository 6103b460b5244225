"""The style of figures: colors that color-blind people tell apart, and the same ones in the studio's page."""

import re
from itertools import combinations

import matplotlib
import numpy as np
import pytest
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from avmsf.plotting.style import DIVERGING, FIRST, SECOND, SEQUENTIAL, SERIES, series_color, styled
from avmsf.studio.server import PAGE

# Machado, Oliveira and Fernandes (2009), severity 1, for linear red, green and blue.
BLINDNESS = {
    "none": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}


def lab(colors: Float[np.ndarray, "colors 3"], blindness: str) -> Float[np.ndarray, "colors 3"]:
    """Return CIELAB coordinates (D65) of sRGB colors as somebody sees them."""
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ BLINDNESS[blindness].T, 0.0, 1.0)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = np.cbrt(seen @ to_xyz.T / to_xyz.sum(axis=1)).T
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)


@pytest.mark.parametrize("blindness", BLINDNESS)
def test_colors_of_series_differ_for_everybody(blindness: str) -> None:
    places = lab(np.array([to_rgb(color) for color in SERIES]), blindness)
    # A difference of 2.3 is just noticeable; curves are thin, so several times that.
    assert min(float(np.linalg.norm(one - other)) for one, other in combinations(places, 2)) > 9.0


@pytest.mark.parametrize("blindness", BLINDNESS)
def test_amounts_grow_in_lightness_and_signs_differ_in_color(blindness: str) -> None:
    amounts = lab(colormaps[SEQUENTIAL](np.linspace(0, 1, 9))[:, :3], blindness)
    assert (np.diff(amounts[:, 0]) > 4.0).all()
    signs = lab(colormaps[DIVERGING](np.linspace(0, 1, 11))[:, :3], blindness)
    assert (np.diff(signs[:6, 0]) > 0).all()
    assert (np.diff(signs[5:, 0]) < 0).all()
    # Equal magnitudes of either sign, but for the smallest.
    assert (np.linalg.norm(signs[:4] - signs[:6:-1], axis=1) > 20.0).all()


def test_a_styled_figure_has_the_styles_colors_and_matplotlib_keeps_its_own() -> None:
    @styled
    def draw() -> Figure:
        figure = Figure()
        figure.subplots().plot([[0.0, 1.0], [1.0, 0.0]])
        return figure

    before = dict(matplotlib.rcParams)
    for _ in range(2):
        [axes] = draw().axes
        assert [line.get_color() for line in axes.lines] == [FIRST, SECOND]
    assert dict(matplotlib.rcParams) == before
    assert series_color(len(SERIES)) == FIRST


@pytest.mark.parametrize(("name", "colormap"), [("AMOUNT", SEQUENTIAL), ("SIGN", DIVERGING)])
def test_the_studios_page_has_the_same_colormaps(name: str, colormap: str) -> None:
    script = (PAGE / "colors.js").read_text()
    stops = re.search(rf"const {name} = \[(.*?)\n\];", script, re.DOTALL)
    assert stops is not None
    found = np.array([[int(value) for value in row.split(",")] for row in re.findall(r"\[([\d, ]+)\]", stops[1])])
    expected = 255 * colormaps[colormap](np.linspace(0, 1, len(found)))[:, :3]
    assert np.abs(found - expected).max() <= 0.5


def test_the_studios_curves_have_colors_of_the_series() -> None:
    used = re.findall(r"--(?:first|second): (#[0-9a-f]{6});", (PAGE / "style.css").read_text())
    assert len(used) == 4
    assert used[:2] == [SECOND, FIRST]
    assert set(used) <= set(SERIES)
