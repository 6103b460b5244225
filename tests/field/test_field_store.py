"""Fields in files: the same to the last bit, those of earlier formats, and what is refused."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from avmsf.capture.settings import CaptureSettings
from avmsf.editing.material import change_material, infer_material
from avmsf.editing.modal_edit import EDITS, adjust_modes
from avmsf.errors import FieldFileError
from avmsf.fem.material import GLASS, WOOD
from avmsf.field.config import FORMAT
from avmsf.field.gains.attention import AttentionGains
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.scaled import BodyGains, ScaledGains
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load, save
from factories.made_fields import Change, record_in, rewritten
from factories.plate_field import PLATE, QUICK, plate_fit, plate_impacts
from factories.raising import raises
from oracles.plate import sample_contacts

CONTACTS = sample_contacts(PLATE, 10, generator=torch.Generator().manual_seed(5))
CONFIG = replace(QUICK, warmup_steps=4, steps=2)
SETTINGS = CaptureSettings(response_channel=2, highpass=30.0, align=False)


@cache
def field(damping: str = "shared") -> SoundField:
    config = replace(CONFIG, damping=damping, learning_rate=0.05)
    return plate_fit(config, train=plate_impacts(forces=True), capture="a plate", settings=SETTINGS)


def test_a_field_comes_back_to_the_last_bit(tmp_path):
    saved, path, chance = field("validated"), tmp_path / "plate.safetensors", torch.get_rng_state()
    save(saved, path)
    loaded = load(str(path))
    assert torch.equal(torch.get_rng_state(), chance)
    assert torch.equal(loaded.render(CONTACTS), saved.render(CONTACTS))
    assert loaded.origin == saved.origin
    assert loaded.origin.settings == SETTINGS
    assert loaded.origin.config.fft_sizes == (1024, 256)
    assert loaded.origin.trained_on == plate_impacts().names
    assert (loaded.sample_rate, loaded.samples) == (saved.sample_rate, saved.samples)
    assert (loaded.gain_field.shape, loaded.gain_field.encoder) == (saved.gain_field.shape, "geometry")
    assert not loaded.gain_field.training
    assert not any(parameter.requires_grad for parameter in loaded.gain_field.parameters())


def test_settings_that_earlier_versions_lack_are_stored_only_where_they_differ(tmp_path):
    positive = plate_fit(replace(CONFIG, positive_gains=True), train=plate_impacts(forces=True))
    for saved, stored in ((field(), False), (positive, True)):
        save(saved, tmp_path / "plate.safetensors")
        record = record_in(tmp_path / "plate.safetensors")
        assert ("positive_gains" in record["config"]) == ("positive" in record["gains"]["shape"]) == stored
        # Earlier versions need a setting that this one lacks.
        assert record["config"]["patience"] == 0
        loaded = load(tmp_path / "plate.safetensors")
        assert loaded.origin.config == saved.origin.config
        assert torch.equal(loaded.gains(CONTACTS), saved.gains(CONTACTS))
    assert float(loaded.gains(CONTACTS).min()) >= 0 > float(field().gains(CONTACTS).min())


def test_a_loaded_field_needs_its_file_no_more(tmp_path):
    path = tmp_path / "plate.safetensors"
    save(field(), path)
    loaded = load(path)
    with open(path, "r+b") as file:
        file.write(bytes(path.stat().st_size))
    path.unlink()
    assert torch.equal(loaded.render(CONTACTS), field().render(CONTACTS))


def changed(tmp_path: Path, change: Change) -> Path:
    save(field(), tmp_path / "plate.safetensors")
    return rewritten(tmp_path / "plate.safetensors", change)


@pytest.mark.parametrize("number", [7, FORMAT + 1])
def test_another_format_is_refused_by_its_number(tmp_path, number):
    def change(_: dict, record: dict) -> None:
        record.update(format=number, gain_field=record.pop("gains"), something="new")

    with raises(FieldFileError, file="changed.safetensors", name="format", value=number):
        load(changed(tmp_path, change))


def tensor(name: str, made: Callable[[torch.Tensor], torch.Tensor]) -> Change:
    return lambda tensors, _: tensors.update({name: made(tensors[name])})


def put(keys: str, *value: object) -> Change:
    """Put a value into the record, or take one out."""
    *path, last = keys.split(".")

    def change(_: dict[str, torch.Tensor], record: dict) -> None:
        for key in path:
            record = record[key]
        if value:
            record[last] = value[0]
        else:
            del record[last]

    return change


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (tensor("bank.damping", torch.Tensor.float), "bank.damping"),
        (tensor("bank.damping", torch.neg), "bank.damping"),
        (tensor("bank.frequency", lambda each: each * 0), "bank.frequency"),
        (tensor("residual.magnitude", lambda each: each[None]), "residual.magnitude"),
        (tensor("residual.magnitude", torch.neg), "residual.magnitude"),
        (tensor("residual.magnitude", lambda each: each + 1e38), "residual.magnitude"),
        *((put("background_force", force), "background_force") for force in (0.0, -1.0, "1", [])),
        (put("gains.shape.width", 10**7), "gains.head.0.weight"),
        (put("gains.modes", 10**30), ...),
        (put("gains.kind", "splines"), "gains.kind"),
        (put("origin.settings.highpass", -1.0), ...),
        (put("origin.report.quality", {"positions": 9, "error": 0.3, "nearest_mean": 0.7, "errors": 0.3}), ...),
        (put("origin.report.quality", {"positions": 9, "error": 0.3, "nearest_mean": None}), ...),
        (put("origin.trained_on", [1]), "origin.trained_on"),
        (put("origin", None), "origin"),
        (put("format", "1"), "format"),
        (put("sample_rate", "44100"), "sample_rate"),
        *((put("sample_rate", rate), "sample_rate") for rate in (-1.0, 1e300, 1e-300, 10**400)),
        # No recording has so many.
        *((put("samples", count), "samples") for count in (0, 10**9)),
        (put("sizes", {}), "modes"),
        (put("config.clusters", 0), "clusters"),
        (put("config.fft_sizes", "1024"), "config.fft_sizes"),
        (put("config.unheard_of", 1), "config.unheard_of"),
        # Nothing that a record lacks is made up.
        (put("config.seed"), "config.seed"),
        (put("origin.report"), "report"),
    ],
)
def test_a_damaged_file_is_refused_with_what_is_wrong(tmp_path, change, name):
    path = changed(tmp_path, change)
    with raises(FieldFileError, file="changed.safetensors") as caught:
        load(path)
    assert name in (..., caught.value.name)


def test_the_noise_of_a_file_without_a_background_grows_with_the_force(tmp_path):
    old = load(changed(tmp_path, put("background_force")))
    assert torch.equal(old.render(CONTACTS, forces=4.0), 4.0 * old.render(CONTACTS))


def test_what_could_not_be_read_back_is_not_written(tmp_path):
    path = tmp_path / "plate.safetensors"
    bank = replace(field().bank, damping=-field().bank.damping)
    with raises(FieldFileError, file=path, name="bank.damping"):
        save(replace(field(), bank=bank), path)
    with raises(FieldFileError, file=path, name="background_force"):
        save(replace(field(), residual=replace(field().residual, force=0.0)), path)
    with raises(FieldFileError, file=path, name="samples"):
        save(replace(field(), samples=10**9), path)
    for broken in (float("nan"), torch.ones(1)):
        origin = replace(field().origin, report={"loss": broken})
        with raises(FieldFileError, file=path, name="origin.report"):
            save(replace(field(), origin=origin), path)
    assert not path.exists()


FILES = sorted((Path(__file__).parent / "data").glob("format-*/*.safetensors"))
MIXTURE = Path(__file__).parent / "data" / f"format-{FORMAT}" / "mixture.safetensors"


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_stored_field_sounds_as_it_did(path):
    expected = load_file(path.parent / "expected")
    sounds = load(path).render(expected["positions"], samples=200)
    loudest = float(expected[path.stem].abs().max())
    # Linear algebra rounds differently on other machines.
    torch.testing.assert_close(sounds, expected[path.stem], rtol=0, atol=1e-4 * loudest)


def test_the_present_format_has_stored_fields_of_all_kinds():
    kinds = {load(path).gain_field.kind for path in FILES if path.parent == MIXTURE.parent}
    assert kinds == {each.kind for each in (AttentionGains, BodyGains, MixtureGains, ScaledGains)}


def test_a_stored_alignment_is_read():
    alignment = load(MIXTURE).alignment
    assert len(alignment.names) == len(alignment.delays) == 8


def test_edits_of_earlier_versions_have_the_present_names(tmp_path):
    field = adjust_modes(change_material(load(MIXTURE), GLASS, WOOD), pitch=1.1)
    entries = field.origin.report[EDITS]
    old = [{**entry, "edit": kind} for entry, kind in zip(entries, ("recast", "retune"), strict=True)]
    report = {**field.origin.report, EDITS: [*old, {"edit": "steer"}, {"edit": "recast", "to": entries[0]["to"]}]}
    replace(field, origin=replace(field.origin, report=report)).save(tmp_path / "old.safetensors")
    assert b"recast" in (tmp_path / "old.safetensors").read_bytes()
    read = load(tmp_path / "old.safetensors")
    kinds = [entry["edit"] for entry in read.origin.report[EDITS]]
    assert kinds == ["change_material", "adjust_modes", "guided", "change_material"]
    assert read.origin.report[EDITS][:2] == entries
    assert infer_material(read, option="--from")[0] == WOOD


@pytest.mark.parametrize(
    ("report", "name"),
    [
        ({EDITS: ["x"]}, "edits.0"),
        ({EDITS: [{"a": 1}]}, "edits.0.edit"),
        ({EDITS: [{"edit": "change_material"}]}, "edits.0.to"),
        ({EDITS: [{"edit": "recast", "to": {"name": "wood"}}]}, "edits.0.to.alpha"),
        ({EDITS: [{"edit": "adjust_modes", "decay": 1.0}]}, "edits.0.pitch"),
        ({EDITS: [{"edit": "adjust_modes", "pitch": 0.0, "decay": 1.0}]}, "edits.0.pitch"),
        ({"supporting_poles": 3}, "supporting_poles"),
        ({"supporting_poles": [0, 1.0]}, "supporting_poles.1"),
        ({"supporting_poles": [-1]}, "supporting_poles.0"),
        ({"supporting_poles": [10_000]}, "supporting_poles.0"),
    ],
)
def test_edits_and_supporting_poles_that_cannot_be_are_refused(report, name, tmp_path):
    field = load(MIXTURE)
    damaged = replace(field, origin=replace(field.origin, report={**field.origin.report, **report}))
    with raises(FieldFileError, name=f"origin.report.{name}"):
        damaged.save(tmp_path / "field.safetensors")


def test_files_are_of_one_type_whatever_that_of_forces_or_torchs_default(tmp_path):
    impacts, path = plate_impacts(forces=True), tmp_path / "plate.safetensors"
    save(plate_fit(CONFIG, train=replace(impacts, forces=impacts.forces.double())), path)
    torch.set_default_dtype(torch.float64)
    try:
        assert load(path).bank.frequency.dtype == torch.float64
        save(plate_fit(CONFIG, train=impacts), path)
    finally:
        torch.set_default_dtype(torch.float32)
