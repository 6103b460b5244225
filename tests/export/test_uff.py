"""The universal file is read back by pyuff and by its columns, and sounds as the field."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from avmsf.errors import ExportError
from avmsf.export.uff import response, response_frequencies, write_universal
from factories.made_tables import MODES, POINTS, summed, table
from factories.raising import raises

pyuff = pytest.importorskip("pyuff", reason="needs pip install 'avmsf[uff]'")


def sets(path, kind):
    return [each for each in pyuff.UFF(str(path)).read_sets() if each["type"] == kind]


def test_nodes_and_real_shapes_come_back(tmp_path):
    field = table()
    write_universal(field, tmp_path / "thing.uff")
    (nodes,) = sets(tmp_path / "thing.uff", 2411)
    places = np.stack([nodes[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(places, field.points.numpy(), rtol=1e-7)
    assert [int(number) for number in nodes["node_nums"]] == list(range(1, POINTS + 1))
    modes = sets(tmp_path / "thing.uff", 55)
    assert len(modes) == MODES
    frequency, damping, gains = [], [], []
    for mode in modes:
        assert mode["analysis_type"] == 2
        damping.append(mode["modal_damp_vis"] * 2 * math.pi * mode["freq"])
        frequency.append(mode["freq"] * math.sqrt(1 - mode["modal_damp_vis"] ** 2))
        shape = np.stack([mode["r1"], mode["r2"], mode["r3"]], axis=1)
        gains.append((shape * -field.normals.numpy()).sum(1))
    np.testing.assert_allclose(frequency, field.frequency, rtol=6e-6)
    np.testing.assert_allclose(damping, field.damping, rtol=2e-5)
    np.testing.assert_allclose(np.array(gains).T, field.gains.real, atol=2e-5)


def test_responses_are_the_transforms_of_the_sounds(tmp_path):
    """By a plain sum over a sound that dies away inside it, sampled far above its modes."""
    field = table(phased=True)
    quick = replace(field, frequency=field.frequency / 20, damping=field.damping * 4)
    rate = 1e6
    sound = summed(quick.gains[2], quick.frequency, quick.damping, samples=400_000, rate=rate)
    times = np.arange(len(sound)) / rate
    weights = np.full(len(sound), 1 / rate)
    weights[0] /= 2
    for line in (0.0, 20.0, 54.0, 160.0):
        expected = (sound * weights * np.exp(-2j * np.pi * line * times)).sum()
        (found,) = response(quick, 2, np.array([line]))
        assert abs(found - expected) < 1e-5 * abs(expected)
    write_universal(field, tmp_path / "thing.uff", functions=3)
    functions = sets(tmp_path / "thing.uff", 58)
    assert len(functions) == 3
    lines = response_frequencies(field)
    for each in functions:
        np.testing.assert_allclose(each["data"], response(field, each["ref_node"] - 1, lines), rtol=1e-12)
        np.testing.assert_allclose(each["x"], lines, rtol=1e-12)
        blow = -field.normals[each["ref_node"] - 1]
        axis = abs(each["ref_dir"]) - 1
        assert axis == int(blow.abs().argmax())
        assert np.sign(each["ref_dir"]) == np.sign(float(blow[axis]))


@pytest.mark.parametrize("phased", [False, True])
def test_a_reader_makes_the_responses_of_the_shapes(tmp_path, phased):
    """By modal superposition in the reference direction, as programs do that know data sets 55 and 58 alone."""
    field = table(phased=phased)
    signs = torch.where(torch.arange(POINTS) % 2 == 0, 1.0, -1.0)
    straight = replace(field, normals=signs[:, None] * torch.eye(3)[torch.arange(POINTS) % 3])
    remarks = write_universal(straight, tmp_path / "thing.uff", functions=POINTS).remarks
    assert "degrees off" not in " ".join(remarks)
    functions, modes = sets(tmp_path / "thing.uff", 58), sets(tmp_path / "thing.uff", 55)
    assert {each["ref_dir"] for each in functions} == {-3, -2, -1, 1, 2, 3}
    for each in functions:
        s = 2j * np.pi * each["x"]
        total = np.zeros(len(s), dtype=complex)
        for mode in modes:
            shape = mode[f"r{abs(each['ref_dir'])}"][each["ref_node"] - 1] * np.sign(each["ref_dir"])
            if phased:
                pole = mode["eig"]
                total += shape / (s - pole) + np.conj(shape) / (s - np.conj(pole))
            else:
                ratio, undamped = mode["modal_damp_vis"], 2 * np.pi * mode["freq"]
                turning = undamped * math.sqrt(1 - ratio**2)
                total += shape * turning / (s**2 + 2 * ratio * undamped * s + undamped**2)
        # Six digits of a frequency, .005 Hz of 3300, beside resonances of some hertz.
        assert np.abs(total - each["data"]).max() < 5e-3 * np.abs(each["data"]).max()
    oblique = replace(straight, normals=torch.nn.functional.normalize(torch.ones(POINTS, 3), dim=1))
    assert "up to 55 degrees off" in " ".join(write_universal(oblique, tmp_path / "oblique.uff").remarks)


def test_one_damping_a_mode_is_said_to_be_a_mean(tmp_path):
    field = table(spatial=True, noisy=True)
    words = " ".join(write_universal(field, tmp_path / "thing.unv", functions=0).remarks)
    assert "mean by energy" in words
    assert "noise" in words
    assert not sets(tmp_path / "thing.unv", 58)
    energy = field.gains.real.double().square()
    mode = sets(tmp_path / "thing.unv", 55)[1]
    expected = float((energy * field.damping).sum(0)[1] / energy.sum(0)[1])
    assert mode["modal_damp_vis"] * 2 * math.pi * mode["freq"] == pytest.approx(expected, rel=2e-5)


def test_what_cannot_be_written_is_refused(tmp_path):
    with raises(ExportError, name="functions", value=-1):
        write_universal(table(), tmp_path / "thing.uff", functions=-1)
    with raises(ExportError, file="thing", name="suffix", value=""):
        write_universal(table(), tmp_path / "thing")
