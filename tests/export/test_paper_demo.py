"""The layout of the paper's demo: its bytes are where its manifests say."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from avmsf.errors import ExportError
from avmsf.export.paper_demo import write_demo
from avmsf.gaussians.ply import read_splats
from factories.clouds import random_cloud
from factories.demo_layout import read_arrays
from factories.made_tables import MODES, POINTS, RATE, SAMPLES, apart, summed, table
from factories.raising import raises


def cosines(**settings):
    """Return a table whose modes start as the demo's do."""
    field = table(**settings)
    return replace(field, gains=1j * field.gains)


@pytest.mark.parametrize("spatial", [False, True])
def test_the_bytes_lie_where_the_manifests_say(tmp_path, spatial):
    field, demo = cosines(spatial=spatial), tmp_path / "demo"
    report = write_demo(field, demo)
    sound, picked = read_arrays(demo / "original"), read_arrays(demo)
    for row in range(POINTS):
        damping = sound["dampings"][row] if spatial else sound["dampings"]
        heard = summed(1j * sound["gains"][row].numpy(), sound["frequencies"].numpy(), damping.numpy())
        assert apart(heard, field.render(torch.tensor([row]))[0]) < 3e-4
    assert report.error < 1e-6
    manifest = json.loads((demo / "original" / "manifest.json").read_text())
    assert (manifest["duration"], manifest["sampleRate"], manifest["modes"]) == (SAMPLES / RATE, RATE, MODES)
    assert json.loads((demo / "manifest.json").read_text())["count"] == POINTS
    assert torch.equal(picked["means"], field.points)
    assert (demo / "picking.bin").stat().st_size == 4 * POINTS * (3 + 3 + 4 + 1)


def test_modes_that_start_otherwise_keep_their_loudness_and_their_nodes(tmp_path):
    field = table(phased=True, noisy=True)
    # One mode has the same phase everywhere: the signs that it has along the surface must stay.
    field.gains[:, 1] = (1 + 0.7j) * torch.linspace(-1, 1, POINTS)
    report = write_demo(field, tmp_path / "demo")
    gains = read_arrays(tmp_path / "demo" / "original")["gains"]
    torch.testing.assert_close(gains.abs(), field.gains.abs())
    signs = gains[:, 1].sign() * field.gains[:, 1].real.sign()
    assert len(set(signs[field.gains[:, 1] != 0].tolist())) == 1
    assert report.error > 0.1
    words = " ".join(report.remarks)
    assert "cosine" in words
    assert "noise" in words


def test_the_gaussians_are_those_given_or_discs_on_the_surface(tmp_path):
    field = cosines()
    write_demo(field, tmp_path / "discs")
    cloud = read_splats(tmp_path / "discs" / "scene.ply")
    demo = read_arrays(tmp_path / "discs")
    torch.testing.assert_close(cloud.centers, field.points)
    torch.testing.assert_close(demo["scales"], cloud.log_scales.exp())
    torch.testing.assert_close(demo["opacities"], cloud.opacities)
    w, x, y, z = demo["quaternions"].double().unbind(1)
    third = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=1)
    torch.testing.assert_close(third.float(), field.normals, atol=1e-5, rtol=0)
    given = random_cloud(field.points, degree=1)
    write_demo(field, tmp_path / "given", cloud=given)
    torch.testing.assert_close(read_splats(tmp_path / "given" / "scene.ply").harmonics, given.harmonics)
    with raises(ExportError, name="cloud", value=3):
        write_demo(field, tmp_path / "few", cloud=given.take(torch.arange(3)))


def test_variants_of_the_same_gaussians_gather_in_one_folder(tmp_path):
    first, second = cosines(), replace(cosines(), frequency=1.1 * cosines().frequency)
    write_demo(first, tmp_path / "demo")
    words = " ".join(write_demo(second, tmp_path / "demo", variant="glass", overwrite=True).remarks)
    assert "other variants are unchanged: original" in words
    assert json.loads((tmp_path / "demo" / "manifest.json").read_text())["variants"] == ["glass", "original"]
    for name, field in (("original", first), ("glass", second)):
        found = read_arrays(tmp_path / "demo" / name)["frequencies"]
        torch.testing.assert_close(found.double(), field.frequency, rtol=1e-6, atol=0)
    # Again, in its place.
    write_demo(second, tmp_path / "demo", variant="original", overwrite=True)
    assert len(list((tmp_path / "demo").glob("*/modal.bin"))) == 2
    elsewhere = replace(first, points=first.points + 1)
    with raises(ExportError, file=tmp_path / "demo", value=["glass"]):
        write_demo(elsewhere, tmp_path / "demo", overwrite=True)
    assert read_arrays(tmp_path / "demo" / "glass")["frequencies"][0] > 450


def test_half_precision_keeps_three_digits_and_what_the_layout_cannot_hold_is_refused(tmp_path):
    field = cosines()
    report = write_demo(field, tmp_path / "demo", precision="float16")
    error = apart(read_arrays(tmp_path / "demo" / "original")["gains"].float(), field.gains.imag)
    assert 1e-6 < error < 2**-11
    assert 1e-6 < report.error < 2**-9
    sizes = {path.name: size for path, size in report.sizes.items() if path.parent.name == "original"}
    assert sizes["modal.bin"] == 4 * MODES + 2 * POINTS * MODES + 4 * MODES
    with raises(ExportError, name="variant", value="../wood"):
        write_demo(field, tmp_path / "other", variant="../wood")
    field.gains[0, 0] = 1e6j
    with raises(ExportError, name="precision", value=1e6), np.errstate(over="ignore"):
        write_demo(field, tmp_path / "loud", precision="float16")
