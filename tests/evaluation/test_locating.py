"""Baselines of localization where every answer is known, and pictures of a located contact."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.evaluation.localization import nearest_spectrum, random_distance
from avmsf.field.sound_field import Origin, SoundField
from avmsf.localization.contact_map import ContactMap
from avmsf.localization.locator import Locator
from avmsf.modal.residual_noise import Residual
from avmsf.modal.synthesis import synthesize
from avmsf.plotting.contacts import contact_colors, draw_contact, write_contact_cloud
from avmsf.plotting.pictures import save_picture
from factories.made_fields import BANK, positional
from factories.raising import raises

RATE, SAMPLES = 8000.0, 3000
STRUCK = (68, 60, 102, 8)


def test_chance_is_the_mean_distance_from_the_right_place() -> None:
    points = torch.tensor([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    assert random_distance(points, torch.tensor([0.0, 3.0, 0.0])) == pytest.approx((3 + 5 + math.sqrt(109)) / 3)


@cache
def locator() -> Locator:
    zero = torch.zeros(len(BANK), dtype=torch.float64)
    field = SoundField(BANK, positional(), zero, Residual(torch.full((9,), 1e-3)), RATE, SAMPLES, Origin("plate"))
    return Locator.of(field)


@cache
def strikes() -> Impacts:
    gains = locator().gains[list(STRUCK)].to(torch.complex128)
    sounds = synthesize(
        gains.real, BANK.frequency, BANK.damping, samples=SAMPLES, sample_rate=RATE, quadrature=gains.imag
    )
    noise = torch.randn(sounds.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    sounds = sounds + 1e-3 * sounds.abs().max() * noise
    return Impacts(locator().points[list(STRUCK)].double(), sounds.float(), RATE, ("d.wav", "c.wav", "b.wav", "a.wav"))


def test_the_most_alike_spectrum_is_a_sounds_own_however_loud() -> None:
    alike = nearest_spectrum(strikes())
    generator = torch.Generator().manual_seed(1)
    for row, sound in enumerate(strikes().sounds):
        level = 1e-3 * float(sound.abs().max())
        other = -300.0 * (sound + level * torch.randn(SAMPLES, generator=generator))
        assert alike(other) == row
    with raises(EvaluationError, name="sound", value=0.0):
        alike(torch.zeros(SAMPLES))


def test_silent_recordings_are_never_the_nearest() -> None:
    quiet = strikes().sounds.clone()
    quiet[1] = 0.0
    alike = nearest_spectrum(replace(strikes(), sounds=quiet))
    assert [alike(sound) for sound in strikes().sounds[[0, 2, 3]]] == [0, 2, 3]
    assert alike(strikes().sounds[1]) != 1


@cache
def contact() -> ContactMap:
    return locator().locate(strikes().sounds[0])


def test_colors_grow_with_probability() -> None:
    sharper = contact().probability ** 10
    colors = contact_colors(replace(contact(), probability=sharper / sharper.sum()))
    brightness = colors.sum(1)
    assert int(brightness.argmax()) == contact().most_probable == STRUCK[0]
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
    assert "red: " not in draw_contact(contact(), title="hit.wav", sides=((0.0, 25.0),)).get_suptitle()
    save_picture(figure, tmp_path / "hit.png")
    assert (tmp_path / "hit.png").read_bytes().startswith(b"\x89PNG")
