"""The open field: revisions, what edits make of it, that nobody's work is overwritten in silence, and one locator."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from avmsf.editing.material import change_material
from avmsf.editing.modal_edit import adjust_modes
from avmsf.errors import EditError, FieldFileError, SimulationError
from avmsf.export.sampled_field import SampledField
from avmsf.fem.material import CERAMIC, WOOD
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load
from avmsf.localization.locator import Locator
from avmsf.studio.edit import REST, Sliders
from avmsf.studio.files import resample, sample
from avmsf.studio.responses import RequestError
from avmsf.studio.session import Revision, Session, file_name
from factories.made_fields import FIELDS
from factories.raising import raises
from served import plate_field

WOODEN = {"material": {"from": "ceramic", "to": "wood"}, "size": 1.5, "pitch": 0.8, "decay": 2.0, "brightness": 1.0}


def opened(home: Path) -> tuple[Session, list[Revision]]:
    shown: list[Revision] = []
    session = Session(home, shown.append)
    session.open(plate_field())
    return session, shown


def same(one: SoundField, other: SoundField) -> bool:
    return all(
        torch.equal(getattr(one.bank, name), getattr(other.bank, name)) for name in ("frequency", "damping")
    ) and torch.equal(one.gains(one.gain_field.points), other.gains(other.gain_field.points))


def test_sliders_do_what_the_tasks_do() -> None:
    field = plate_field()
    modes = [{"mode": 1, "db": None}, {"mode": 2, "db": 6.0, "pitch": 1.01, "decay": 0.5}]
    edited, remarks = Sliders.read({**WOODEN, "modes": modes}).apply(field)
    pitch = torch.full((5,), 0.8, dtype=torch.float64) * torch.tensor([1, 1, 1.01, 1, 1], dtype=torch.float64)
    decay = torch.full((5,), 2.0, dtype=torch.float64) * torch.tensor([1, 1, 0.5, 1, 1], dtype=torch.float64)
    levels = [0.0, -math.inf, 6.0, 0.0, 0.0]
    wooden = change_material(field, CERAMIC, WOOD, size=1.5)
    assert same(edited, adjust_modes(wooden, pitch=pitch, decay=decay, brightness_db=1.0, gains_db=levels))
    assert any("Poisson's ratio" in words for words in remarks)


def test_sliders_are_read_back_and_change_nothing_at_rest() -> None:
    sliders = Sliders.read({**WOODEN, "modes": [{"mode": 3, "db": None}]})
    assert Sliders.read(sliders.to_json()) == sliders
    assert sliders.to_json()["modes"] == [{"mode": 3, "db": None, "pitch": 1.0, "decay": 1.0}]
    assert Sliders.read(REST.to_json()) == REST == Sliders.read({"base": 1})
    field = plate_field()
    edited, remarks = REST.apply(field)
    assert edited is field
    assert remarks == []


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        ({"pitch": "high"}, "pitch", "high"),
        ({"pitch": float("nan")}, "pitch", pytest.approx(math.nan, nan_ok=True)),
        ({"size": True}, "size", True),
        ({"modes": {"0": 1}}, "modes", {"0": 1}),
        ({"modes": [{"mode": -1}]}, "mode", -1),
        ({"modes": [{"mode": 0, "level": 3}]}, "a mode", ["level"]),
        ({"material": "wood"}, "material", "wood"),
        ({"material": {"to": 3}}, "material.to", 3),
        ({"pitch": 10**400}, "pitch", 10**400),
        ({"modes": [{"mode": 0, "db": -900}]}, "db", -900.0),
        ({"brightness": 400}, "brightness", 400.0),
        ({"louder": 2}, "an edit", ["louder"]),
        ({"modes": [{"mode": k, "pitch": 1.1} for k in range(6)]}, "modes", 6),
        ({"modes": [{"mode": 1, "db": -100.0}] * 2}, "modes", [1]),
        ({"modes": [{"mode": 10**400}]}, "mode", 10**400),
        ({"material": {"to": "w" * 500_000}}, "material.to", "w" * 500_000),
        *(({name: each}, name, each) for name in ("size", "pitch", "decay") for each in (1e308, 1e-4, 0.0, -1.0)),
        *(({"modes": [{"mode": 0, name: each}]}, name, each) for name in ("pitch", "decay") for each in (1e308, 0.0)),
    ],
    ids=lambda value: str(value)[:40],
)
def test_what_is_no_slider_is_named(words: dict[str, Any], name: str, value: object) -> None:
    with raises(RequestError, name=name, value=value) as refused:
        Sliders.read(words, modes=5)
    assert refused.value.status == 400
    assert len(str(refused.value)) < 300


@pytest.mark.parametrize(
    ("words", "kind"),
    [
        ({"modes": [{"mode": 5, "db": 1.0}]}, EditError),
        ({"material": {"from": "ceramic", "to": "cheese"}}, SimulationError),
        ({"pitch": 2.0}, OSError),
    ],
)
def test_an_edit_that_fails_leaves_everything_as_it_was(tmp_path, words, kind):
    """The last one where the picture of the revision cannot be made."""

    def show(revision: Revision) -> None:
        if revision.number > 1:
            raise OSError("the disk is full")

    session = Session(tmp_path, show)
    session.open(plate_field())
    with pytest.raises(kind):
        session.edit(1, Sliders.read(words))
    assert session.current.number == 1
    assert not session.can_undo


def test_each_edit_starts_from_the_field_as_it_was_opened_and_undo_goes_back_under_a_new_number(tmp_path: Path) -> None:
    session, shown = opened(tmp_path)
    first = session.edit(1, Sliders(pitch=2.0))
    second = session.edit(2, Sliders(pitch=1.5))
    assert torch.equal(second.require_field().bank.frequency, 1.5 * plate_field().bank.frequency)
    undone = session.undo(3)
    assert (undone.number, undone.sliders, undone.field) == (4, first.sliders, first.field)
    assert session.undo(4).sliders == REST
    assert [revision.number for revision in shown] == [1, 2, 3, 4, 5]
    assert not session.can_undo
    with raises(RequestError, name="undo"):
        session.undo(5)


def test_two_tabs_never_overwrite_one_another(tmp_path: Path) -> None:
    session, _ = opened(tmp_path)
    session.edit(1, Sliders(pitch=2.0))
    for late in (lambda: session.edit(1, Sliders(pitch=3.0)), lambda: session.undo(1), lambda: session.save(1, "late")):
        with raises(RequestError, name="base", value=1) as refused:
            late()
        assert (refused.value.status, refused.value.more) == (409, {"revision": 2})
    assert session.current.sliders.pitch == 2.0
    assert list(tmp_path.iterdir()) == []


def test_what_is_saved_is_what_is_heard_and_the_sliders_rest_from_then_on(tmp_path: Path) -> None:
    session, _ = opened(tmp_path)
    edited = session.edit(1, Sliders.read(WOODEN)).require_field()
    path, saved = session.save(2, "wooden plate")
    assert path == tmp_path / "wooden plate.safetensors"
    assert same(load(path), edited)
    assert (saved.number, saved.sliders, saved.field) == (3, REST, edited)
    twice = session.edit(3, Sliders(pitch=2.0)).require_field()
    assert torch.equal(twice.bank.frequency, 2.0 * edited.bank.frequency)
    # As long as a file's name may be.
    assert session.save(4, "音" * 66)[0].is_file()


def test_a_file_that_is_there_is_never_overwritten_and_one_that_cannot_be_written_not_left(tmp_path: Path) -> None:
    session, _ = opened(tmp_path)
    (tmp_path / "bowl.safetensors").write_text("precious")
    (tmp_path / "link.safetensors").symlink_to(tmp_path / "elsewhere")
    before = sorted(tmp_path.iterdir())
    for name in ("bowl", "bowl.safetensors", "link"):
        with raises(RequestError, file=f"{name.removesuffix('.safetensors')}.safetensors") as refused:
            session.save(1, name)
        assert refused.value.status == 409
    field = plate_field()
    session.open(replace(field, origin=replace(field.origin, report={"loss": math.nan})))
    with pytest.raises(FieldFileError):
        session.save(2, "new")
    assert sorted(tmp_path.iterdir()) == before
    assert (tmp_path / "bowl.safetensors").read_text() == "precious"


PATHS = ["", " ", "../up", "a/b", "a\\b", "/etc/x", ".hidden", "a\0b", "a\nb", "~"]
OTHERS = ["x" * 200, "=1+1", "x."]


@pytest.mark.parametrize("name", PATHS + OTHERS)
def test_names_that_lead_elsewhere_or_are_too_long_are_refused(name: str) -> None:
    with raises(RequestError, name="name", value=name) as refused:
        file_name(name)
    assert refused.value.status == 400


def test_before_there_is_a_field_nothing_can_be_edited(tmp_path: Path) -> None:
    session = Session(tmp_path, lambda revision: None)
    session.open(None)
    with raises(RequestError, name="field"):
        session.edit(1, Sliders(pitch=2.0))
    first = plate_field()
    session.open(first)
    assert not session.can_undo
    session.open(plate_field("elastic"))
    assert session.undo(3).field is first


@pytest.mark.parametrize("kind", sorted(FIELDS))
def test_the_table_of_an_edited_field_is_the_one_made_anew(kind: str) -> None:
    before = plate_field(kind)
    normals = torch.nn.functional.normalize(before.gain_field.points - before.gain_field.points.mean(0), dim=1)
    sampled = sample(before, before.gain_field.points, normals)
    # The highest mode goes beyond half the sample rate, and the next one down is mute.
    words = {"size": 0.7, "material": {"from": "ceramic", "to": "ceramic"}, "decay": 0.5, "brightness": 2.0}
    after, _ = Sliders.read({**words, "pitch": 1.3, "modes": [{"mode": 3, "db": None}]}).apply(before)
    assert after.gain_field.length == 0.7
    found = resample(replace(sampled, name="another"), before, after)
    assert found is not None
    assert found.name == after.origin.capture
    expected = SampledField.of(after, before.gain_field.points.double() * 0.7, normals)
    assert len(expected.frequency) < len(sampled.frequency)
    assert torch.equal(found.frequency, expected.frequency)
    assert torch.allclose(found.damping, expected.damping, rtol=1e-6)
    loudest = float(expected.gains.abs().max())
    # Gains are float32, and a place that is scaled and scaled back is another one in its last digit.
    assert float((found.gains - expected.gains).abs().max()) < 1e-5 * loudest
    # From one edit to the next, and back to one in which a mute mode sounds: there is no way but to ask the field.
    other = {**words, "pitch": 1.4, "brightness": 0.0, "modes": [{"mode": 3, "db": None}]}
    louder, _ = Sliders.read(other).apply(before)
    twice = resample(found, after, louder)
    assert twice is not None
    anew = SampledField.of(louder, before.gain_field.points.double() * 0.7, normals)
    assert float((twice.gains - anew.gains).abs().max()) < 1e-5 * float(anew.gains.abs().max())
    muted, _ = Sliders.read({"modes": [{"mode": 3, "db": None}]}).apply(before)
    silent = resample(sampled, before, muted)
    assert silent is not None
    assert resample(silent, muted, before) is None
    assert resample(found, after, before) is None
    assert resample(sampled, before, plate_field("attention" if kind != "attention" else "positional")) is None


def test_threads_that_prepare_and_locate_at_once_get_what_one_alone_gets() -> None:
    field = plate_field("elastic")
    sounds = [field.render(field.gain_field.points[[row]])[0] for row in (3, 40, 90, 130)]
    alone = [Locator.of(field).locate(sound).probability for sound in sounds]
    locator = Locator.of(field)

    def locate(number: int) -> torch.Tensor:
        locator.prepare(400 + 80 * (number % 4))
        return locator.locate(sounds[number % 4]).probability

    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(locate, range(8)))
    for number, probability in enumerate(found):
        assert torch.equal(probability, alone[number % 4])
