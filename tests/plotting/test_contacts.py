"""A located contact in colors, as a cloud and as a picture."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from matplotlib.colors import to_hex

from avmsf.localization.contact_map import ContactPosterior
from avmsf.localization.locator import Locator
from avmsf.modal.synthesis import synthesize
from avmsf.plotting.clouds import ALL_SIDES, view_from
from avmsf.plotting.contacts import contact_colors, draw_contact, write_contact_cloud
from avmsf.plotting.pictures import save_picture
from avmsf.plotting.style import FIRST, SECOND
from factories.made_fields import BANK, positional, sounding

RATE, SAMPLES = 8000.0, 3000
STRUCK = 68


@cache
def contact() -> ContactPosterior:
    """Return where a plate's field locates its own sound at the point `STRUCK`, with noise 60 dB down."""
    locator = Locator.of(sounding(positional(), noise=1e-3, samples=SAMPLES))
    gains = locator.gains[[STRUCK]].to(torch.complex128)
    (sound,) = synthesize(gains, BANK.frequency, BANK.damping, samples=SAMPLES, sample_rate=RATE)
    noise = torch.randn(SAMPLES, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return locator.locate((sound + 1e-3 * sound.abs().max() * noise).float())


def test_colors_grow_with_probability() -> None:
    sharper = contact().probability ** 10
    colors = contact_colors(replace(contact(), probability=sharper / sharper.sum()))
    brightness = colors.sum(1)
    assert int(brightness.argmax()) == contact().most_probable == STRUCK
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
    # The plate is flat: from above and from below all marks are seen at their places.
    points = contact().points.double().numpy()
    marks = points[[0, 1, STRUCK, 5]] - (points.min(0) + points.max(0)) / 2
    for axes, side in zip(figure.axes, ALL_SIDES * 2, strict=False):
        if abs(side[1]) == 75.0:
            assert np.allclose(axes.collections[1].get_offsets(), (marks @ view_from(side).T)[:, :2])
            assert [to_hex(each) for each in axes.collections[1].get_edgecolors()] == [*["#ffffff"] * 2, FIRST, SECOND]
    assert "red: " not in draw_contact(contact(), title="hit.wav", sides=((0.0, 25.0),)).get_suptitle()
    save_picture(figure, tmp_path / "hit.png")
    assert (tmp_path / "hit.png").read_bytes().startswith(b"\x89PNG")
