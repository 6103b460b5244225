"""The layout of the paper's demo: its bytes are where its manifests say, and it comes back as it was."""

import errno
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from avmsf.errors import ExportError
from avmsf.export.paper_demo import Demo, is_demo, read_demo, write_demo
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.ply import read_splats
from factories.made_tables import MODES, POINTS, RATE, SAMPLES, apart, summed, table
from factories.raising import raises


def cosines(**settings):
    """Return a table whose modes start as the demo's do."""
    field = table(**settings)
    return type(field)(
        field.points, field.normals, field.frequency, field.damping, torch.zeros_like(field.sine), field.sine,
        field.noise, field.sample_rate, name=field.name,
    )  # fmt: skip


def written(folder: Path, **settings) -> tuple[dict, dict]:
    write_demo(cosines(**settings), folder)
    return tuple(json.loads((place / "manifest.json").read_text()) for place in (folder, folder / "original"))


@pytest.mark.parametrize("spatial", [False, True])
def test_the_bytes_lie_where_the_manifests_say(tmp_path, spatial):
    field = cosines(spatial=spatial)
    top, sound = written(tmp_path / "demo", spatial=spatial)
    modal = (tmp_path / "demo" / "original" / "modal.bin").read_bytes()
    place = {name: record["offset"] for name, record in sound["arrays"].items()}
    rows = POINTS if spatial else 1
    frequency = np.frombuffer(modal, "<f4", MODES, place["frequencies"])
    gains = np.frombuffer(modal, "<f4", POINTS * MODES, place["gains"]).reshape(POINTS, MODES)
    damping = np.frombuffer(modal, "<f4", rows * MODES, place["dampings"]).reshape(rows, MODES)
    heard = summed(np.zeros(MODES), gains[7], frequency, damping[7 % rows])
    assert apart(heard, field.render(torch.tensor([7]))[0]) < 3e-4
    assert sound["duration"] == SAMPLES / RATE
    picking = (tmp_path / "demo" / "picking.bin").read_bytes()
    assert top["count"] == POINTS
    means = np.frombuffer(picking, "<f4", 3 * POINTS, top["arrays"]["means"]["offset"]).reshape(POINTS, 3)
    np.testing.assert_array_equal(means, field.points.numpy())
    assert len(picking) == 4 * POINTS * (3 + 3 + 4 + 1)


@pytest.mark.parametrize("spatial", [False, True])
def test_it_comes_back_as_it_was(tmp_path, spatial):
    field = cosines(spatial=spatial)
    report = write_demo(field, tmp_path / "demo")
    back = read_demo(tmp_path / "demo").field
    assert apart(back.render(torch.arange(POINTS)), field.render(torch.arange(POINTS))) < 3e-4
    assert report.error < 1e-6
    assert (back.sample_rate, back.samples, back.name) == (RATE, SAMPLES, "thing")
    assert is_demo(tmp_path / "demo")
    assert not is_demo(tmp_path)


def test_half_precision_keeps_three_digits(tmp_path):
    field = cosines()
    report = write_demo(field, tmp_path / "demo", precision="float16")
    back = read_demo(tmp_path / "demo").field
    error = apart(back.cosine, field.cosine)
    assert 1e-6 < error < 2**-11
    assert 1e-6 < report.error < 2**-9
    sizes = {path.name: size for path, size in report.sizes.items() if path.parent.name == "original"}
    assert sizes["modal.bin"] == 4 * MODES + 2 * POINTS * MODES + 4 * MODES


def test_modes_that_start_otherwise_keep_their_loudness_and_their_nodes(tmp_path):
    field = table(phased=True, noisy=True)
    # One mode has the same phase everywhere: the signs that it has along the surface must stay.
    field.sine[:, 1], field.cosine[:, 1] = torch.linspace(-1, 1, POINTS), 0.7 * torch.linspace(-1, 1, POINTS)
    report = write_demo(field, tmp_path / "demo")
    gains = read_demo(tmp_path / "demo").field.cosine
    torch.testing.assert_close(gains.abs(), torch.hypot(field.sine, field.cosine))
    signs = gains[:, 1].sign() * field.sine[:, 1].sign()
    assert len(set(signs[field.sine[:, 1] != 0].tolist())) == 1
    assert report.error > 0.1
    words = " ".join(report.remarks)
    assert "cosine" in words
    assert "noise" in words


def test_the_gaussians_are_those_given_or_discs_on_the_surface(tmp_path):
    field = cosines()
    write_demo(field, tmp_path / "discs")
    cloud = read_splats(tmp_path / "discs" / "scene.ply")
    demo = read_demo(tmp_path / "discs")
    torch.testing.assert_close(cloud.centers, field.points)
    torch.testing.assert_close(demo.scales, cloud.log_scales.exp())
    torch.testing.assert_close(demo.opacities, cloud.opacities)
    w, x, y, z = demo.rotations.double().unbind(1)
    third = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=1)
    torch.testing.assert_close(third.float(), field.normals, atol=1e-5, rtol=0)
    draw = torch.Generator().manual_seed(1)
    given = GaussianCloud(
        field.points, torch.randn(POINTS, 4, generator=draw), torch.randn(POINTS, 3, generator=draw),
        torch.randn(POINTS, generator=draw), torch.randn(POINTS, 4, 3, generator=draw),
    )  # fmt: skip
    write_demo(field, tmp_path / "given", cloud=given)
    torch.testing.assert_close(read_splats(tmp_path / "given" / "scene.ply").harmonics, given.harmonics)
    with raises(ExportError, name="cloud", value=3):
        write_demo(field, tmp_path / "few", cloud=given.take(torch.arange(3)))


def test_offsets_alone_at_the_top_are_understood(tmp_path):
    """As a manifest may be written that gives counts and byte offsets and no more."""
    top, sound = written(tmp_path, spatial=True)
    bare = {name: record["offset"] for name, record in top["arrays"].items()}
    (tmp_path / "manifest.json").write_text(json.dumps({"num_gaussians": POINTS, **bare}))
    offsets = {name: record["offset"] for name, record in sound["arrays"].items()}
    bare_sound = {"num_modes": MODES, "duration": 3.0, "offsets": offsets}
    (tmp_path / "original" / "manifest.json").write_text(json.dumps(bare_sound))
    with raises(ExportError, file="original/manifest.json", name="sampleRate", value=None):
        read_demo(tmp_path)
    demo = read_demo(tmp_path, sample_rate=RATE)
    assert isinstance(demo, Demo)
    assert demo.field.samples == 3 * RATE
    assert not demo.field.shared_damping
    torch.testing.assert_close(demo.field.cosine, cosines(spatial=True).cosine)


def test_of_several_variants_one_is_named(tmp_path):
    written(tmp_path)
    (tmp_path / "wood").mkdir()
    for name in ("manifest.json", "modal.bin"):
        (tmp_path / "wood" / name).write_bytes((tmp_path / "original" / name).read_bytes())
    with raises(ExportError, file=tmp_path, name="variant", value=["original", "wood"]):
        read_demo(tmp_path)
    assert read_demo(tmp_path, variant="wood").field.origin["variant"] == "wood"


def test_variants_of_the_same_gaussians_gather_in_one_folder(tmp_path):
    first, second = cosines(), replace(cosines(), frequency=1.1 * cosines().frequency)
    write_demo(first, tmp_path / "demo")
    words = " ".join(write_demo(second, tmp_path / "demo", variant="glass", force=True).remarks)
    assert "other variants are unchanged: original" in words
    assert json.loads((tmp_path / "demo" / "manifest.json").read_text())["variants"] == ["glass", "original"]
    for name, field in (("original", first), ("glass", second)):
        torch.testing.assert_close(
            read_demo(tmp_path / "demo", variant=name).field.frequency, field.frequency, rtol=1e-6, atol=0
        )
    # Again, in its place.
    write_demo(second, tmp_path / "demo", variant="original", force=True)
    assert len(list((tmp_path / "demo").glob("*/modal.bin"))) == 2
    elsewhere = replace(first, points=first.points + 1)
    with raises(ExportError, file=tmp_path / "demo", value=["glass"]):
        write_demo(elsewhere, tmp_path / "demo", force=True)
    assert read_demo(tmp_path / "demo", variant="glass").field.frequency[0] > 450


@pytest.mark.parametrize(
    ("place", "value", "name"),
    [
        (("arrays", "frequencies", "shape"), [], "frequencies.shape"),
        (("arrays", "gains", "shape"), 5, "gains.shape"),
        (("arrays", "dampings", "shape"), [4.0], "dampings.shape"),
        (("arrays", "gains", "offset"), True, "gains.offset"),
        (("duration",), 1e300, "duration"),
        (("duration",), 1e9, "duration"),
        (("sampleRate",), float("inf"), "sampleRate"),
        (("sampleRate",), 10**30, "sampleRate"),
    ],
)
def test_a_manifest_with_impossible_values_is_refused(tmp_path, place, value, name):
    _, sound = written(tmp_path)
    record = sound
    for key in place[:-1]:
        record = record[key]
    record[place[-1]] = value
    (tmp_path / "original" / "manifest.json").write_text(json.dumps(sound))
    with raises(ExportError, file="original/manifest.json", name=name) as caught:
        read_demo(tmp_path)
    assert caught.value.value == (sound["arrays"]["gains"] if name == "gains.offset" else value)


def test_what_is_broken_is_named(tmp_path):
    with raises(ExportError, file=tmp_path / "manifest.json", value=os.strerror(errno.ENOENT)):
        read_demo(tmp_path)
    _, sound = written(tmp_path / "demo")
    place = tmp_path / "demo" / "original"
    modal = (place / "modal.bin").read_bytes()
    (place / "modal.bin").write_bytes(modal[:-4])
    with raises(ExportError, file="original/modal.bin", name="dampings", value=len(modal) - 4):
        read_demo(tmp_path / "demo")
    wrong = bytearray(modal)
    start = sound["arrays"]["gains"]["offset"] + 4 * (2 * MODES + 1)
    wrong[start : start + 4] = np.float32(np.nan).tobytes()
    (place / "modal.bin").write_bytes(bytes(wrong))
    with raises(ExportError, file="original/modal.bin", name="gains", row=2):
        read_demo(tmp_path / "demo")
    (place / "modal.bin").write_bytes(modal)
    sound["arrays"]["gains"]["shape"] = [POINTS + 1, MODES]
    (place / "manifest.json").write_text(json.dumps(sound))
    with raises(ExportError, file="original/manifest.json", name="gains", value=[POINTS + 1, MODES]):
        read_demo(tmp_path / "demo")
    (place / "manifest.json").write_text("[]")
    with raises(ExportError, file="original/manifest.json", value="list"):
        read_demo(tmp_path / "demo")
    with raises(ExportError, name="variant", value="../wood"):
        write_demo(cosines(), tmp_path / "other", variant="../wood")
    loud = cosines()
    loud.cosine[0, 0] = 1e6
    with raises(ExportError, name="precision", value=1e6), np.errstate(over="ignore"):
        write_demo(loud, tmp_path / "loud", precision="float16")
