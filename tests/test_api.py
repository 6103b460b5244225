"""The public interface: what a user of Python starts from, end to end, with lists, arrays and paths."""

import inspect
import math
import re
from dataclasses import replace
from functools import cache
from operator import attrgetter
from typing import Any

import numpy as np
import pytest
import soundfile
import torch

import avmsf
from avmsf.capture import Impacts
from avmsf.cli import main
from avmsf.errors import (
    ArrayError,
    AvmsfError,
    AvmsfWarning,
    CaptureError,
    EditError,
    EvaluationError,
    ExportError,
    FitError,
    PositionError,
    PositionWarning,
)
from avmsf.evaluation import score
from avmsf.field import FitConfig, SoundField
from avmsf.pipeline import PipelineConfig
from factories.delayed_plate import delays, strikes
from factories.plate_capture import fill_plate
from factories.plate_field import RATE, plate_impacts
from factories.raising import raises, warns
from factories.verbs import sets

NAMES = {
    *("Capture", "SoundField", "Surface"),
    *("edit", "evaluate", "extract_modes", "fit", "load", "locate", "read", "split", "suggest", "write"),
}
CONTACT = [0.05, 0.06, 0.0]


@cache
def capture() -> avmsf.Capture:
    return avmsf.Capture("plate", plate_impacts(forces=True))


@cache
def field() -> SoundField:
    return avmsf.fit(capture(), config=PipelineConfig(modes=8), progress=False)


def test_the_functions_to_start_from_describe_each_parameter_and_the_result():
    for name in NAMES - {"Capture", "SoundField", "Surface"} | {"SoundField.render", "SoundField.posterior"}:
        function = attrgetter(name)(avmsf)
        described = inspect.getdoc(function)
        given = [each for each in inspect.signature(function).parameters if each != "self"]
        assert re.findall(r"^    (\w+): ", described.partition("Args:")[2].partition("\n\n")[0], re.MULTILINE) == given
        assert "Returns:" in described


def test_the_top_has_the_names_that_users_start_from_and_its_packages():
    classes = {name for name in avmsf.__all__ if not isinstance(getattr(avmsf, name), type(avmsf))}
    assert classes == NAMES
    assert avmsf.__version__
    assert {"capture", "field", "modal", "gaussians"} < set(avmsf.__all__)
    for package in set(avmsf.__all__) - NAMES:
        module = getattr(avmsf, package)
        assert all(getattr(module, name) is not None for name in getattr(module, "__all__", []))


@pytest.mark.parametrize(("size", "positions"), [(0.75, 12), (12, 12), (1, 1), (0.5, 8)])
def test_a_split_trains_on_a_part_of_the_positions_or_on_their_number(size, positions):
    whole = avmsf.Capture("plate", plate_impacts(16))
    train, test = avmsf.split(whole, size)
    assert (len(train.impacts), len(test.impacts)) == (positions, 16 - positions)
    assert {*train.impacts.names, *test.impacts.names} == set(whole.impacts.names)
    names = [avmsf.split(whole, size, seed=seed)[0].impacts.names for seed in (None, None, 1, 1, 2)]
    assert names[0] == names[1]
    assert names[2] == names[3]
    assert len(set(names)) > 1


def test_fit_says_what_it_does_unless_that_is_turned_off(capfd):
    config = PipelineConfig(modes=2, fit=FitConfig(steps=0))
    avmsf.fit(capture(), config=config, progress=False)
    assert capfd.readouterr() == ("", "")
    avmsf.fit(capture(), config=config)
    out, err = capfd.readouterr()
    assert out == ""
    assert "modes" in err


def test_fit_makes_the_field_that_the_command_makes(tmp_path):
    folder, output = fill_plate(tmp_path / "plate", surface=False), tmp_path / "field.safetensors"
    assert main(["fit", str(folder), "--output", str(output), *sets("modes=6 fit.steps=5")]) == 0
    made = avmsf.fit(avmsf.read(str(folder)), config=PipelineConfig(modes=6, fit=FitConfig(steps=5)), progress=False)
    one, other = made.render([CONTACT]), avmsf.load(output).render([CONTACT])
    # Modes of two runs differ in their last digits.
    assert float((one - other).abs().max()) < 1e-4 * float(one.abs().max())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["field.safetensors", "plate"]


def reversed_twice(rows: list[Any]) -> np.ndarray:
    """Return rows with a step of -1 in memory, in the byte order of other machines."""
    return np.array(rows[::-1], ">f8")[::-1]


@pytest.mark.parametrize("kind", [list, np.array, np.float32, torch.tensor, reversed_twice])
def test_lists_and_arrays_sound_like_tensors(kind):
    contacts = [CONTACT, [0.1, 0.02, 0.0]]
    sounds = field().render(kind(contacts), forces=kind([2.0, 0.5]))
    expected = field().render(torch.tensor(contacts, dtype=torch.float64), forces=torch.tensor([2.0, 0.5]))
    torch.testing.assert_close(sounds, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))
    given = kind(contacts)
    impacts = Impacts.of(contacts=given, sounds=sounds, sample_rate=48_000.0)
    if not isinstance(given, list):
        given[0] = 5.0
        assert float(impacts.contacts.max()) < 5.0
    # Directions of any length count as unit vectors, and one of length zero as none.
    directions = kind([[0.0, 0.0, -0.5], [0.0, 0.0, 0.0]])
    made = Impacts.of(contacts=kind(contacts), sounds=sounds, sample_rate=48_000.0, directions=directions)
    assert made.directions.tolist() == [[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]
    assert field().render(kind(contacts), kind([[0.0, 0.0, -1.0]] * 2), 2).shape == sounds.shape
    assert field().known(kind(contacts)).mean.shape == (2, len(field().bank))
    assert field().relative_gain_std(kind(contacts)).shape == (2,)
    down = kind([[0.0, 0.0, -1.0]])
    found = avmsf.suggest(field(), 1, candidates=kind([CONTACT]), directions=down, progress=False)
    assert found.rows.tolist() == [0]


def test_scores_of_a_recording_against_itself_are_zero():
    impacts = capture().impacts
    scores = score(impacts.sounds.numpy(), impacts)
    assert set(scores.mean().values()) == {0.0}
    assert str(len(impacts)) in repr(scores)


def test_a_recording_is_located_by_its_path_or_its_samples(tmp_path):
    sound = capture().impacts.sounds[3].numpy()
    soundfile.write(tmp_path / "hit.wav", sound, int(RATE), subtype="FLOAT")
    given = ((sound, RATE), (sound.tolist(), RATE), (tmp_path / "hit.wav", None), (str(tmp_path / "hit.wav"), None))
    found = [avmsf.locate(field(), what, sample_rate=rate) for what, rate in given]
    places = [each.points[each.most_probable] for each in found]
    assert all(torch.equal(place, places[0]) for place in places[:2])
    expected = capture().impacts.contacts[3].float()
    assert all(float((place - expected).norm()) < 0.03 for place in places)  # meters


def test_a_result_may_be_changed_in_place():
    sound = capture().impacts.sounds[3]
    found = avmsf.locate(field(), sound, progress=False)
    kept = found.position.clone()
    place = found.position
    place *= 1000
    assert torch.equal(found.position, kept)
    found.points.mul_(1000)
    assert torch.equal(avmsf.locate(field(), sound, progress=False).position, kept)


def test_levels_by_force_and_as_recorded_are_not_compared_without_a_word():
    with warns(AvmsfWarning, name="test"):
        avmsf.evaluate(field(), replace(capture().impacts, forces=None))


def test_numbers_of_numpy_and_devices_of_torch_serve_as_settings():
    one, other = (avmsf.split(capture(), seed=each)[0].impacts.names for each in (3, np.int64(3)))
    assert one == other
    settings = {"config": PipelineConfig(modes=2), "seed": np.int64(3), "device": torch.device("cpu")}
    made = avmsf.fit(capture(), "smooth", **settings, progress=False)
    assert (made.origin.report["pipeline"]["device"], made.origin.config.seed) == ("cpu", 3)


def test_evaluation_aligns_recordings_as_the_fit_did(tmp_path):
    train, test = avmsf.split(avmsf.Capture("plate", strikes(12, starts=delays(12))))
    made = avmsf.fit(train, config=PipelineConfig(modes=5), progress=False)
    assert made.alignment is not None
    made.save(tmp_path / "field.safetensors")
    read = avmsf.load(tmp_path / "field.safetensors")
    scores = [avmsf.evaluate(each, test).mean()["relative_stft"] for each in (made, read)]
    assert scores[0] == scores[1]
    assert scores[0] == avmsf.evaluate(made, made.aligned(test.impacts)).mean()["relative_stft"]
    unaligned = avmsf.evaluate(made, replace(test.impacts, before=None, after=None)).mean()["relative_stft"]
    assert scores[0] < unaligned


def test_impacts_and_surfaces_are_made_of_arrays(tmp_path):
    given = capture().impacts
    made = Impacts.of(given.contacts.tolist(), given.sounds.numpy(), RATE, forces=given.forces.tolist())
    assert torch.equal(made.sounds, given.sounds)
    assert made.names[0] == "001"
    assert impacts_of(names=range(len(given))).names[0] == "0"
    mask = given.contacts[:, 0] > float(given.contacts[:, 0].median())
    for rows in (mask, mask.numpy(), mask.tolist()):
        assert given.take(rows).names == given.take(mask.nonzero().flatten()).names
    surface = avmsf.Surface.of([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.array([[0, 1, 2]]))
    for name in ("a.obj", "a.glb", "a.ply"):
        surface.write(tmp_path / name)
        assert len(avmsf.Surface.read(tmp_path / name).faces) == len(surface.faces)
    with raises(CaptureError, name="kind"):
        surface.write(tmp_path / "a.stl")
    assert torch.equal(avmsf.Surface.read(tmp_path / "a.ply").vertices, surface.vertices)


def impacts_of(**changes) -> Impacts:
    given = capture().impacts
    return Impacts.of(**{"contacts": given.contacts, "sounds": given.sounds, "sample_rate": RATE} | changes)


def far() -> avmsf.Capture:
    """The capture in millimeters, on a plate in meters."""
    plate = avmsf.Surface.of([[0, 0, 0], [0.2, 0, 0], [0.2, 0.15, 0], [0, 0.15, 0]], [[0, 1, 2], [0, 2, 3]])
    given = capture().impacts
    return avmsf.Capture("plate", replace(given, contacts=1000.0 * given.contacts), plate)


def posterior_of_a_network():
    quick = PipelineConfig(gain_model="network", modes=2, fit=FitConfig(steps=0, warmup_steps=1, clusters=4))
    return avmsf.fit(capture(), config=quick, progress=False).posterior([CONTACT])


ALONE = avmsf.Capture("plate", Impacts.of([[0, 0, 0]], [[0.0, 1.0]], 8000.0))
CORNERS, AWAY = torch.eye(3), [CONTACT, [50.0, 60.0, 0.0]]


@pytest.mark.parametrize(
    ("call", "kind", "attributes"),
    [
        (lambda: avmsf.split(capture(), "a"), EvaluationError, {}),
        (lambda: avmsf.split(np.zeros((3, 3))), EvaluationError, {"name": "recordings", "value": "ndarray"}),
        (lambda: avmsf.Capture(capture().impacts, "plate"), CaptureError, {"name": "impacts", "value": "str"}),
        (lambda: avmsf.Capture("a", capture().impacts, "a.ply"), CaptureError, {"name": "surface", "value": "str"}),
        *(
            (lambda where=where: field().render(where), ArrayError, {"name": "positions", "row": row})
            for where, row in (
                (CONTACT, None),
                ([[0.05, 0.06]], None),
                ([["a", "b", "c"]], None),
                ([CONTACT, [0.0, math.nan, 0.0]], 1),
            )
        ),
        (lambda: field().gains(CONTACT), ArrayError, {"name": "contacts"}),
        (lambda: field().render([CONTACT], directions=[[0, 0, 1.0]] * 2), ArrayError, {"name": "directions"}),
        (lambda: field().render([CONTACT], forces=[1.0, 2.0]), ArrayError, {"name": "forces"}),
        (lambda: field().render([CONTACT], forces=-5), ArrayError, {"name": "forces", "row": 0, "value": -5.0}),
        (lambda: field().render(AWAY), PositionError, {"row": 1}),
        (lambda: field().known(AWAY), PositionError, {"name": "contacts", "row": 1}),
        (lambda: field().render([CONTACT], samples=-1), AvmsfError, {"name": "samples", "value": -1}),
        (lambda: field().render([CONTACT], samples=2.5), AvmsfError, {"name": "samples", "value": 2.5}),
        (lambda: impacts_of(sounds=capture().impacts.sounds[:3]), ArrayError, {"name": "sounds"}),
        (
            lambda: impacts_of(sounds=capture().impacts.sounds.index_fill(1, torch.arange(5, 9), math.inf)),
            *(ArrayError, {"name": "sounds", "row": 0, "value": math.inf}),
        ),
        (lambda: impacts_of(contacts=CONTACT), ArrayError, {"name": "contacts"}),
        (lambda: impacts_of(names=["a"]), ArrayError, {"name": "names"}),
        (lambda: capture().impacts.take([True, False]), ArrayError, {"name": "rows", "value": 2}),
        (lambda: capture().impacts.take([1.7]), ArrayError, {"name": "rows", "value": [1.7]}),
        (lambda: avmsf.split(capture(), seed=1.7), EvaluationError, {"name": "seed", "value": 1.7}),
        (lambda: impacts_of(forces=0), ArrayError, {"name": "forces", "row": 0, "value": 0.0}),
        *(
            (lambda rate=rate: impacts_of(sample_rate=rate), ArrayError, {"name": "sample_rate"})
            for rate in (0, -1.0, math.nan)
        ),
        (lambda: avmsf.Surface.of(CORNERS, [[0, 1, 2], [0, 1, 3]]), ArrayError, {"row": 1}),
        (lambda: avmsf.Surface.of(CORNERS, [[0, 1, 1.5]]), ArrayError, {"name": "faces", "row": 0}),
        # Before anything is computed.
        (lambda: avmsf.fit(far(), progress=False), CaptureError, {"name": "contacts"}),
        (lambda: avmsf.fit(ALONE, device="mps", progress=False), FitError, {"name": "device"}),
        (
            lambda: avmsf.fit(avmsf.Capture("plate", impacts_of(sample_rate=250_000)), progress=False),
            *(FitError, {"name": "sample_rate", "value": 250_000.0}),
        ),
        (posterior_of_a_network, FitError, {}),
        (lambda: avmsf.suggest(field(), 1, candidates=[0.02, 0.03]), ArrayError, {"name": "candidates"}),
        (lambda: avmsf.suggest(field(), 2.5), AvmsfError, {"name": "count", "value": 2.5}),
        (lambda: avmsf.edit(field()), EditError, {}),
        (lambda: avmsf.write(field(), "plate.xyz"), ExportError, {"name": "to", "value": ".xyz"}),
        *(
            (lambda given=given: avmsf.write(field(), "new.html", **given), ExportError, attributes)
            for given, attributes in (
                ({"strikes": CORNERS}, {"name": "strikes", "value": "Tensor"}),
                ({"strikez": 3}, {"value": "strikez"}),
                ({"capture": "mug"}, {"value": "capture"}),
            )
        ),
        (lambda: avmsf.fit(3), AvmsfError, {"name": "capture", "value": "int"}),
        (lambda: avmsf.fit(ALONE, seed="x"), AvmsfError, {"name": "seed", "value": "x"}),
        (lambda: avmsf.fit(ALONE, gain_model="bad"), AvmsfError, {"name": "gain_model", "value": "bad"}),
        (lambda: avmsf.evaluate(field(), "bowl"), AvmsfError, {"name": "test", "value": "str"}),
        (lambda: avmsf.extract_modes("bowl"), AvmsfError, {"name": "recordings", "value": "str"}),
        (lambda: avmsf.locate("bowl.safetensors", "a.wav"), AvmsfError, {"name": "field", "value": "str"}),
        (
            lambda: avmsf.locate(field(), [0.0, 1.0] * 2000, sample_rate="48k"),
            *(AvmsfError, {"name": "sample_rate", "value": "48k"}),
        ),
    ],
)
def test_values_that_cannot_be_meant_are_refused_by_name(call, kind, attributes):
    with raises(kind, **attributes):
        call()


def test_a_position_near_the_object_gives_a_warning():
    points = field().gain_field.points
    size = float((points.amax(0) - points.amin(0)).norm())
    beside = [CONTACT, [CONTACT[0], CONTACT[1], 0.3 * size]]
    with warns(PositionWarning, name="positions", row=1, value=pytest.approx(0.3 * size, rel=0.05)):
        field().render(beside)
    field().render(points)


def test_a_field_is_written_in_the_format_of_its_ending(tmp_path):
    avmsf.write(field(), tmp_path / "plate.html")
    assert "<html" in (tmp_path / "plate.html").read_text()
    avmsf.write(field(), str(tmp_path / "plate.glb"), contacts=5)
    assert (tmp_path / "plate.glb").read_bytes().startswith(b"glTF")
    avmsf.write(field(), tmp_path / "samples", to="wavs", contacts=3)
    assert len(list((tmp_path / "samples").rglob("*.wav"))) == 3
