"""The verbs from the command line: help, check, modes, fit, render and info."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import soundfile
import torch
import trimesh

import avmsf
from avmsf.capture import read_capture
from avmsf.capture.settings import settings_of
from avmsf.cli import VERBS, main
from avmsf.cli.fit import Options as FitOptions
from avmsf.cli.info import _not_trained_on
from avmsf.cli.paths import OutputError
from avmsf.cli.report import field_lines
from avmsf.errors import FitError
from avmsf.features.feature_field import FeatureField, save_features
from avmsf.field.sound_field import Origin
from avmsf.field.store import load, save
from avmsf.modal.extraction.alignment import recording_keys
from avmsf.modal.modes import ForcePulse
from factories.made_fields import directional, sounding
from factories.plate_capture import PLATE, TINY, fill_plate
from factories.plate_field import CONTACT_TIME, HIGHEST, RATE, plate_impacts
from factories.raising import raises
from factories.verbs import Streams, results_of, run_verb, sets
from oracles.plate import plate_modes

AT = ("--position", "0.05", "0.06", "0")
SMOOTH = ("--gain-model", "smooth", *TINY)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fill_plate(tmp_path_factory.mktemp("captures") / "plate")


@pytest.fixture(scope="module")
def field(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fields") / "plate.safetensors"
    assert main(["fit", str(capture), "--output", str(path), "--train-count", "5", *SMOOTH]) == 0
    return path


def test_help_names_every_verb_and_imports_nothing_that_computes() -> None:
    code = (
        "import sys\nfrom avmsf.cli import main\ncode = main(['--help'])\n"
        "print([name for name in ('torch', 'scipy', 'numpy', 'tyro') if name in sys.modules], code)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert ran.stdout.splitlines()[-1] == "[] 0"
    for verb in VERBS:
        assert f"\n  {verb} " in ran.stdout


def test_the_version_is_printed(capsys: Streams) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == avmsf.__version__


@pytest.mark.parametrize(("word", "meant"), [("fti", "fit"), ("lcoate", "locate")])
def test_a_mistyped_verb_gets_a_suggestion(word: str, meant: str, capsys: Streams) -> None:
    error = results_of(capsys, word, code=2)[0]["error"]
    assert (error["name"], error["value"]) == ("avmsf", word)
    # What to do is behind what was found.
    assert re.search(rf"\b{meant}\b", error["message"].partition(repr(word))[2])


def test_a_warning_on_the_capture_is_noted(tmp_path: Path, capsys: Streams) -> None:
    folder = fill_plate(tmp_path / "plate")
    sound, rate = soundfile.read(folder / "004.wav")
    clipped = np.clip(5 * sound / np.abs(sound).max(), -1, 1)
    soundfile.write(folder / "004.wav", clipped, rate, subtype="FLOAT")
    assert main(["modes", str(folder), "--modes", "8"]) == 0
    err = capsys.readouterr().err
    (note,) = [line for line in err.splitlines() if line.startswith("note: ")]
    assert "004.wav: " in note
    assert "clipped" in note
    assert "CaptureWarning" not in err


def test_modes_prints_the_plates(capture: Path, tmp_path: Path, capsys: Streams) -> None:
    found, _ = results_of(capsys, "modes", capture, "--plots", tmp_path)
    impacts = read_capture(capture).impacts
    truth = plate_modes(PLATE, impacts.contacts, highest=HIGHEST, contact_time=CONTACT_TIME)
    strongest = max(found["modes"], key=lambda mode: mode["level_db"])
    nearest = int((truth.frequency - strongest["frequency_hertz"]).abs().argmin())
    # .05 % of the frequency: what extraction is to reach with noise 40 dB down.
    assert strongest["frequency_hertz"] == pytest.approx(float(truth.frequency[nearest]), rel=5e-4)
    assert strongest["t60_seconds"] == pytest.approx(np.log(1000) / float(truth.damping[nearest]), rel=0.05)
    assert strongest["level_db"] == 0.0
    # The plate's recordings share every pole and every phase; noise is 40 dB down.
    assert strongest["phase_coherence"] > 0.99
    assert strongest["explained_left_out"] > 0.95
    assert strongest["frequency_spread_hertz"] < 0.5
    shares = [mode["energy_share"] for mode in found["modes"] + found["supporting_poles"]]
    assert sum(shares) == pytest.approx(1.0)
    assert (found["recordings"], found["sample_rate"]) == (8, RATE)
    assert (tmp_path / "modes.png").read_bytes().startswith(b"\x89PNG")


def test_a_quiet_verb_prints_its_table_alone(capture: Path, capsys: Streams) -> None:
    assert main(["modes", str(capture), "--modes", "4", "--quiet"]) == 0
    out, err = capsys.readouterr()
    assert "frequency Hz" in out
    assert err == ""


def test_fit_writes_a_field_and_its_scores(capture: Path, tmp_path: Path, capsys: Streams) -> None:
    path = tmp_path / "deep" / "plate.safetensors"
    words = ["fit", capture, "--output", path, "--train-fraction", "0.5", "--plots", tmp_path / "plots"]
    told, _ = results_of(capsys, *words, "--gain-model", "network", "--without-shape", *TINY, "--seed", "3")
    field = load(path)
    assert told["modes"] == int(field.is_mode.sum()) > 0
    assert told["modes"] + told["supporting_poles"] == len(field.bank) <= 12
    assert told["trained_on"] == list(field.origin.trained_on)
    assert told["trained_on"][0] == "001.wav"
    assert len(told["trained_on"]) == len(told["tested_on"]) == 4
    assert set(told["trained_on"]).isdisjoint(told["tested_on"])
    config = field.origin.config
    assert (config.seed, config.clusters, config.fft_sizes) == (3, 8, (1024, 256))
    # All impacts have one direction: it makes no baseline of its own.
    assert [name for name in told["scores"] if "direction" in name] == []
    errors = {method: each["relative_stft"] for method, each in told["scores"].items()}
    own = "the held-out recordings' own gains"
    assert min(errors, key=lambda method: errors[method]) == own
    # With the field's noise, without which the logarithm of silence would count.
    assert told["scores"][own]["l1_log"] < 1.1 * told["scores"]["field"]["l1_log"]
    assert max(errors, key=lambda method: errors[method]) == "white noise"
    assert [each.name for each in path.parent.iterdir()] == ["plate.safetensors"]
    assert {"modes.png", "gains.png", "spectrograms.png"} <= {each.name for each in (tmp_path / "plots").iterdir()}


def test_the_paper_leaves_visual_features_out_only_if_that_is_allowed(capture, tmp_path, capsys):
    words = ["fit", str(capture), "--preset", "paper", "--without-shape", "--cache", str(tmp_path), *TINY]
    with raises(FitError, name="features"):
        run_verb(*words)
    _, said = results_of(capsys, *words, "--allow-missing-features")
    assert "without visual features" in said


def test_one_capture_that_workers_are_asked_for_has_a_folder_as_several_have(capture: Path, tmp_path: Path) -> None:
    options = FitOptions.parse([str(capture), "--workers", "2", "--output", str(tmp_path / "fields")])
    options.check_inputs()
    assert [each.output for each in options.tasks().values()] == [tmp_path / "fields" / f"{capture.name}.safetensors"]


def test_fit_replaces_nothing_but_a_field_of_the_same_capture(capture: Path, field: Path, tmp_path: Path) -> None:
    output, own = tmp_path / "plate.safetensors", load(field)
    words = ["--output", str(output)]
    shutil.copy(field, output)
    FitOptions.parse([str(capture), *words]).check_inputs()
    for other_kind in (["--until", "features"], ["--material", "glass"]):
        with raises(OutputError, file=output, name="--overwrite"):
            FitOptions.parse([str(capture), *other_kind, *words]).check_inputs()
    edited = replace(own, origin=replace(own.origin, report={**own.origin.report, "edits": [{"edit": "x"}]}))
    other = replace(own, origin=replace(own.origin, capture="bowl"))
    # Keys of one length, as the header says how long it is.
    damaged = [output.read_bytes().replace(key, key[::-1]) for key in (b"origin", b"report")]
    for content in (edited, other, b"sound", *damaged):
        output.write_bytes(content) if isinstance(content, bytes) else save(content, output)
        with raises(OutputError, file=output, name="--overwrite"):
            FitOptions.parse([str(capture), *words]).check_inputs()
        FitOptions.parse([str(capture), *words, "--overwrite"]).check_inputs()


def test_fit_takes_a_single_recording(tmp_path: Path, capsys: Streams) -> None:
    folder, output = fill_plate(tmp_path / "plate"), tmp_path / "field.safetensors"
    table = folder / "impacts.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:2]))
    told, _ = results_of(capsys, "fit", folder, "--output", output, *SMOOTH)
    assert (told["trained_on"], told["tested_on"], told["scores"]) == (["001.wav"], [], {})
    # Leave-one-out, on which a word on the quality rests, needs more.
    assert load(output).quality is None


@pytest.mark.parametrize("early", [True, False])
def test_a_refused_fit_leaves_nothing_behind(tmp_path: Path, capsys: Streams, early: bool) -> None:
    """Without a mesh it is refused before the modes, with a rate that diverges after them."""
    folder, output = fill_plate(tmp_path / "plate", surface=not early), tmp_path / "fields" / "plate.safetensors"
    words = ["--gain-model", "elastic", *sets("body.wall=0.004 body.shapes=8 body.dofs=1000"), *TINY]
    words += [] if early else sets("fit.learning_rate=1e30")
    assert main(["fit", str(folder), "--output", str(output), *words]) == 2
    assert ("surface.obj" in capsys.readouterr().err) == early
    assert (folder / ".avmsf" / "modes.safetensors").exists() == (not early)
    assert list(output.parent.glob("*")) == []


@pytest.mark.parametrize("level", [-6.0, 0.0])
def test_render_sets_levels_by_one_factor_for_all(field: Path, tmp_path: Path, level: float) -> None:
    places = [*AT, "--position", "0.02", "0.02", "0", "--output", str(tmp_path), "--normalize", "peak"]
    assert main(["render", str(field), *places, "--level-db", str(level), "--coding", "int16"]) == 0
    plain = load(field).render(torch.tensor([[0.05, 0.06, 0.0], [0.02, 0.02, 0.0]]))
    expected = plain / plain.abs().max() * 10 ** (level / 20)
    written = [soundfile.read(tmp_path / name, dtype="int16")[0].astype(int) for name in ("001.wav", "002.wav")]
    for row, sound in enumerate(written):
        # One step of 16 bits, and the full scale that is one below 1.
        assert np.abs(sound / 2**15 - expected[row].numpy()).max() <= 2**-14
    if level == 0.0:
        assert max(np.abs(each).max() for each in written) == 32767


def test_info_of_features_and_meshes_that_others_made(tmp_path: Path, capsys: Streams) -> None:
    features = FeatureField.from_points(torch.rand(40, 3, generator=torch.Generator().manual_seed(0)))
    save_features(features, tmp_path / "features.safetensors", report={"encoder": "one of our own"})
    assert main(["info", str(tmp_path / "features.safetensors")]) == 0
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    box.invert()
    box.export(tmp_path / "box.ply")
    assert main(["info", str(tmp_path / "box.ply")]) == 0
    assert "volume 1e+03 cm3" in capsys.readouterr().out


def test_info_says_and_draws(field: Path, capture: Path, tmp_path: Path, capsys: Streams) -> None:
    output = tmp_path / "pictures"
    told, shown = results_of(capsys, "info", field, "--capture", capture, "--plots", output)
    # By what the table is sorted, and what its first column counts.
    assert re.search(r"energy: squared amplitude times T60\n +mode +frequency Hz", shown)
    fitted = load(field)
    assert (told["capture"], told["sample_rate"]) == ("plate", RATE)
    frequency, is_mode = fitted.bank.frequency, fitted.is_mode
    assert told["mode_count"] == len(told["modes"])
    assert [each["frequency_hertz"] for each in told["modes"]] == frequency[is_mode].tolist()
    assert [each["frequency_hertz"] for each in told["supporting_poles"]] == frequency[~is_mode].tolist()
    assert told["compared_with"]["which"] == "not training recordings"
    assert set(told["compared_with"]["recordings"]).isdisjoint(fitted.origin.trained_on)
    assert len(told["compared_with"]["recordings"]) == 3
    assert (len(told["trained_on"]), told["trained_on"][0]) == (5, "001.wav")
    assert (told["pipeline"]["extraction"], told["pipeline"]["fit"]["seed"]) == ("high-resolution", 0)
    # A folder may have another name.
    shutil.copytree(capture, tmp_path / "renamed")
    told, _ = results_of(capsys, "info", field, "--capture", tmp_path / "renamed")
    assert told["compared_with"]["which"] == "not training recordings"
    for name in ("modes", "gains", "spectrograms"):
        assert (output / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    # It has no body.
    assert not (output / "surface.png").exists()


PLACES = torch.tensor([[0.05, 0.03, 0.002], [0.05, 0.03, 0.002], [-0.04, 0.01, 0.002]], dtype=torch.float64)
DIRECTIONS = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
SPOT = ("--position", "0.05", "0.03", "0.002")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Return the file of a field that knows directions and the average force of its recordings."""
    field = sounding(directional())
    save(replace(field, residual=replace(field.residual, force=50.0)), tmp_path / "field.safetensors")
    return tmp_path / "field.safetensors"


RENDERED: dict[str, dict[str, Any]] = {
    "": {},
    "--force 2": {"forces": 2.0},
    "--no-noise": {"noise": False},
    "--seconds 0.1": {"samples": 800},
    "--contact-time 2e-3": {"pulse": ForcePulse(2e-3)},
    "--contact-time 2e-3 --pulse hertz": {"pulse": ForcePulse(2e-3, "hertz")},
    "--direction 0 0 1 --direction 0 0 -1": {"directions": [[0, 0, 1], [0, 0, -1]]},
}
"""Options, and what `render` of the field is given then."""


@pytest.mark.parametrize("words", RENDERED)
def test_render_is_the_fields_own(words: str, path: Path, capsys: Streams) -> None:
    output = path.with_name("sounds")
    spots = [*SPOT, "--position", "-40e-3", "1e-2", "0.002", "--output", output]
    told, said = results_of(capsys, "render", path, *spots, *words.split())
    assert ("--no-noise leaves it out" in said) == ("--force" in words)
    assert told["files"] == [str(output / "001.wav"), str(output / "002.wav")]
    expected = load(path).render(PLACES[1:], **RENDERED[words])
    for file, sound in zip(told["files"], expected, strict=True):
        written, rate = soundfile.read(file, dtype="float32")
        assert (rate, soundfile.info(file).subtype) == (8000, "FLOAT")
        assert np.array_equal(written, sound.numpy())


def test_render_takes_a_table_in_any_unit_and_with_directions(path: Path) -> None:
    rows = ("rim/one.wav;50,0;30;2;0;0;-1;a", "wall;50;30;2;0;0;1;b", "lid;-40;10;2;;;;c")
    table, output = path.with_name("places.csv"), path.with_name("out")
    table.write_text("\n".join(["File;X;Y;Z;NX;NY;NZ;who", *rows]) + "\n")
    words = ["render", str(path), "--contact-table", str(table), "--unit", "mm", "--output", str(output)]
    # What is there is replaced only where that is asked for.
    assert [main(words), main(words), main([*words, "--overwrite"])] == [0, 2, 0]
    expected = load(path).render(PLACES, directions=DIRECTIONS)
    for sound, name in zip(expected, ("rim/one.wav", "wall.wav", "lid.wav"), strict=True):
        assert np.array_equal(soundfile.read(output / name, dtype="float32")[0], sound.numpy())
    assert not torch.equal(expected[0], expected[1])


@pytest.mark.parametrize("level", [-30.0, -10.0, 20.0])
def test_the_peak_of_what_is_written_is_said(path: Path, capsys: Streams, level: float) -> None:
    loudest, output = 20 * np.log10(float(load(path).render(PLACES[:1]).abs().max())), path.with_name("a.wav")
    told, err = results_of(capsys, "render", path, *SPOT, "--output", output, "--level-db", level - loudest)
    assert told["peak_dbfs"] == pytest.approx(level, abs=1e-3)
    assert np.abs(soundfile.read(output)[0]).max() == pytest.approx(10 ** (level / 20), rel=1e-4)
    # Quiet ones and those that clip are noted, once.
    assert err.count("--normalize peak") == (0 if level == -10 else 1)


def test_info_reads_recordings_from_where_the_fields_sounds_start(capture, field, tmp_path, capsys):
    made, settings = load(field), settings_of(capture).starting("peak")
    origin = replace(made.origin, settings=settings, trained_on=())
    save(replace(made, origin=origin, alignment=None), tmp_path / "peak.safetensors")
    told, _ = results_of(capsys, "info", tmp_path / "peak.safetensors", "--capture", capture)
    wanted = avmsf.evaluate(load(tmp_path / "peak.safetensors"), read_capture(capture, settings)).mean()
    assert told["compared_with"]["scores"]["field"] == pytest.approx(wanted)


def test_training_recordings_are_told_by_what_they_hold_where_the_field_knows() -> None:
    impacts = plate_impacts(4)
    alignment = SimpleNamespace(keys=recording_keys(impacts.take([0, 1])))
    field = SimpleNamespace(alignment=alignment, sample_rate=impacts.sample_rate)
    assert _not_trained_on(field, SimpleNamespace(impacts=impacts)) == [2, 3]
    # A later session may number its recordings as the first did.
    later = replace(impacts, sounds=0.5 * impacts.sounds)
    assert _not_trained_on(field, SimpleNamespace(impacts=later)) == [0, 1, 2, 3]


def test_outliers_are_no_recordings_that_a_field_was_fitted_to() -> None:
    report = {"excluded": ["b.wav"], "outliers": {"b.wav": "b.wav contradicts the other recordings"}}
    field = sounding(directional(), origin=Origin("plate", ("a.wav", "b.wav", "c.wav"), report=report))
    (line,) = (line for line in field_lines(field, Path("f.safetensors")) if "fitted to" in line)
    assert line.endswith(" 2 recordings")
    values = {"report": report, "modes": 3}
    assert FitOptions(()).cells(values)["outliers left out"] == "b.wav"
