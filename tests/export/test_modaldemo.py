"""The layout of the paper's demo: its bytes are where its manifests say, and it comes back as it was."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from avmsf.errors import ExportError
from avmsf.export.discs import discs
from avmsf.export.modaldemo import Demo, is_demo, read_demo, write_demo
from avmsf.scene.gaussians import GaussianCloud
from avmsf.scene.ply import read_splats
from made_tables import MODES, POINTS, RATE, SAMPLES, apart, summed, table


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
    assert "loudness" in words
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
    with pytest.raises(ExportError, match="a Gaussian for each of the field's 9 points, found 3"):
        write_demo(field, tmp_path / "few", cloud=given.take(torch.arange(3)))


def test_discs_face_down_where_the_surface_does():
    field = cosines()
    field.normals[0] = torch.tensor([0.0, 0.0, -1.0])
    w, x, y, z = discs(field).rotations[0].tolist()
    assert 1 - 2 * (x * x + y * y) == pytest.approx(-1.0)
    assert (w, z) == (0.0, 0.0)


def test_offsets_alone_at_the_top_are_understood(tmp_path):
    """As a manifest may be written that gives counts and byte offsets and no more."""
    top, sound = written(tmp_path, spatial=True)
    bare = {name: record["offset"] for name, record in top["arrays"].items()}
    (tmp_path / "manifest.json").write_text(json.dumps({"num_gaussians": POINTS, **bare}))
    offsets = {name: record["offset"] for name, record in sound["arrays"].items()}
    bare_sound = {"num_modes": MODES, "duration": 3.0, "offsets": offsets}
    (tmp_path / "original" / "manifest.json").write_text(json.dumps(bare_sound))
    with pytest.raises(ExportError, match="expected a sample rate from 1 to 768000 Hz, found None"):
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
    with pytest.raises(ExportError, match="found original, wood: name one"):
        read_demo(tmp_path)
    assert read_demo(tmp_path, variant="wood").field.origin["variant"] == "wood"


def test_variants_of_the_same_gaussians_gather_in_one_folder(tmp_path):
    first, second = cosines(), replace(cosines(), frequency=1.1 * cosines().frequency)
    write_demo(first, tmp_path / "demo")
    words = " ".join(write_demo(second, tmp_path / "demo", variant="glass").remarks)
    assert "other variants stay as they were: original" in words
    assert json.loads((tmp_path / "demo" / "manifest.json").read_text())["variants"] == ["glass", "original"]
    for name, field in (("original", first), ("glass", second)):
        torch.testing.assert_close(
            read_demo(tmp_path / "demo", variant=name).field.frequency, field.frequency, rtol=1e-6, atol=0
        )
    # Again, in its place.
    write_demo(second, tmp_path / "demo", variant="original")
    assert len(list((tmp_path / "demo").glob("*/modal.bin"))) == 2
    elsewhere = replace(first, points=first.points + 1)
    with pytest.raises(ExportError, match="variants of the same Gaussians, found glass of others: choose another"):
        write_demo(elsewhere, tmp_path / "demo")
    assert read_demo(tmp_path / "demo", variant="glass").field.frequency[0] > 450
    assert "of no use any more: glass" in " ".join(write_demo(elsewhere, tmp_path / "demo", force=True).remarks)
    torch.testing.assert_close(read_demo(tmp_path / "demo").field.points, elsewhere.points)


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (("arrays", "frequencies", "shape"), [], "shape of 'frequencies' as whole numbers from 1"),
        (("arrays", "gains", "shape"), 5, "shape of 'gains' as whole numbers from 1, found 5"),
        (("arrays", "dampings", "shape"), [4.0], r"shape of 'dampings' as whole numbers from 1, found \[4.0\]"),
        (("arrays", "gains", "offset"), True, "the offset of 'gains' in bytes"),
        (("duration",), 1e300, "a duration above 0 and up to 600 s, found 1e"),
        (("duration",), 1e9, "a duration above 0 and up to 600 s, found 1000000000"),
        (("sampleRate",), float("inf"), "a sample rate from 1 to 768000 Hz, found inf"),
        (("sampleRate",), 10**30, "a sample rate from 1 to 768000 Hz, found 1000"),
    ],
)
def test_a_manifest_that_says_nonsense_is_refused(tmp_path, place, value, words):
    _, sound = written(tmp_path)
    record = sound
    for key in place[:-1]:
        record = record[key]
    record[place[-1]] = value
    (tmp_path / "original" / "manifest.json").write_text(json.dumps(sound))
    with pytest.raises(ExportError, match=words):
        read_demo(tmp_path)


def test_what_is_broken_is_named(tmp_path):
    with pytest.raises(ExportError, match="expected the manifest of the paper's demo, found none"):
        read_demo(tmp_path)
    _, sound = written(tmp_path / "demo")
    place = tmp_path / "demo" / "original"
    modal = (place / "modal.bin").read_bytes()
    (place / "modal.bin").write_bytes(modal[:-4])
    with pytest.raises(ExportError, match=r"'dampings' ends at byte \d+ of \d+: it was cut short"):
        read_demo(tmp_path / "demo")
    wrong = bytearray(modal)
    start = sound["arrays"]["gains"]["offset"] + 4 * (2 * MODES + 1)
    wrong[start : start + 4] = np.float32(np.nan).tobytes()
    (place / "modal.bin").write_bytes(bytes(wrong))
    with pytest.raises(ExportError, match="finite numbers in 'gains', found nan in row 2"):
        read_demo(tmp_path / "demo")
    (place / "modal.bin").write_bytes(modal)
    sound["arrays"]["gains"]["shape"] = [POINTS + 1, MODES]
    (place / "manifest.json").write_text(json.dumps(sound))
    with pytest.raises(ExportError, match="manifests belong to different objects"):
        read_demo(tmp_path / "demo")
    (place / "manifest.json").write_text("[]")
    with pytest.raises(ExportError, match="expected a JSON object, found list"):
        read_demo(tmp_path / "demo")
    with pytest.raises(ExportError, match=r"a variant's name that a folder can have, found '\.\./wood'"):
        write_demo(cosines(), tmp_path / "other", variant="../wood")
    loud = cosines()
    loud.cosine[0, 0] = 1e6
    with pytest.raises(ExportError, match="up to 65504"), np.errstate(over="ignore"):
        write_demo(loud, tmp_path / "loud", precision="float16")
