"""The command line: every verb end to end, what goes to which stream, exit codes, one line an error."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
import trimesh

import avmsf
from avmsf.capture import Capture, CaptureSettings, read_capture
from avmsf.cli import VERBS, main
from avmsf.errors import CaptureError
from avmsf.field.store import load
from factories.plate_capture import PLATE, TINY, fill_plate
from factories.plate_field import CONTACT_TIME, HIGHEST, RATE
from factories.raising import raises
from factories.settings import sets
from factories.verbs import run_verb
from oracles.plate import plate_modes

Streams = pytest.CaptureFixture[str]
AT = ("--position", "0.05", "0.06", "0")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fill_plate(tmp_path_factory.mktemp("captures") / "plate")


@pytest.fixture(scope="module")
def field(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fields") / "plate.safetensors"
    words = [
        "fit",
        str(capture),
        "--output",
        str(path),
        "--train-count",
        "5",
        "--start",
        "1",
        "--gain-model",
        "smooth",
        *TINY,
    ]
    assert main(words) == 0
    return path


def python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)


def interrupt(*arguments: object, **named: object) -> None:
    raise KeyboardInterrupt


def error_line(streams: Streams) -> str:
    """Return the one line that an error prints, with nothing on the standard output."""
    out, err = streams.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1, err
    assert "Traceback" not in err
    return err


def test_help_names_every_verb_and_imports_no_torch() -> None:
    ran = python(
        "import sys\nfrom avmsf.cli import main\n"
        "code = main(['--help'])\n"
        "print('torch' in sys.modules, 'scipy' in sys.modules, code)"
    )
    assert ran.stdout.splitlines()[-1] == "False False 0"
    for verb in VERBS:
        assert f"\n  {verb} " in ran.stdout


def test_common_options_may_stand_before_the_verb(capture: Path, capsys: Streams) -> None:
    results = []
    for words in (["check", str(capture), "--json", "--quiet"], ["--json", "--quiet", "check", str(capture)]):
        assert main(words) == 0
        results.append(capsys.readouterr())
    assert results[0] == results[1]
    assert json.loads(results[0].out)
    assert main(["--quiet"]) == 2


def test_what_is_no_verb_ends_with_2_on_the_standard_error(capsys: Streams) -> None:
    for words in (["fit"], ["fit", "capture", "--output", "x", "--seed", "many"], ["fit", "capture", "--oops", "3"]):
        assert main(words) == 2
        assert words[-1] in error_line(capsys)


@pytest.mark.parametrize(("word", "meant"), [("fti", "fit"), ("lcoate", "locate"), ("rendre", "render")])
def test_a_mistyped_verb_gets_a_suggestion(word: str, meant: str, capsys: Streams) -> None:
    assert main([word, "--json"]) == 2
    error = json.loads(capsys.readouterr().out)["error"]
    assert (error["name"], error["value"]) == ("avmsf", word)
    # What to do is behind what was found.
    assert re.search(rf"\b{meant}\b", error["message"].partition(repr(word))[2])


@pytest.mark.parametrize("verb", ["check", "modes", "fit"])
def test_a_missing_input_is_refused_before_anything_that_computes_is_imported(verb: str) -> None:
    words = [verb, "/nowhere"]
    ran = python(
        "import sys\nfrom avmsf.cli import main\n"
        f"print(main({words!r}), [name for name in ('torch', 'scipy', 'numpy') if name in sys.modules])"
    )
    assert ran.stdout == "2 []\n"
    assert ran.stderr.startswith(f"avmsf {verb}: /nowhere: ")


def test_every_public_name_is_there_and_no_other() -> None:
    for name in avmsf.__all__:
        assert getattr(avmsf, name) is not None
    assert set(avmsf.__all__) <= set(dir(avmsf))
    with pytest.raises(AttributeError):
        avmsf.fitt  # noqa: B018


def test_output_that_nobody_reads_any_more_ends_quietly(field: Path) -> None:
    main_of = "import sys; from avmsf.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", main_of, "info", str(field), "--json"]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert run.stdout is not None
    run.stdout.close()
    _, told = run.communicate(timeout=300)
    assert b"Traceback" not in told
    assert b"BrokenPipe" not in told
    assert run.returncode == 141


def test_the_version_is_the_packages(capsys: Streams) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == avmsf.__version__


def test_check_of_a_good_capture_ends_with_0(capture: Path, capsys: Streams) -> None:
    assert main(["check", str(capture)]) == 0
    out, err = capsys.readouterr()
    assert "001.wav" in out
    assert "008.wav" in out
    assert "no problem found" in out
    assert err == f"next: avmsf modes {capture}\n"


@pytest.mark.parametrize(("strays", "said"), [((), "1 warning"), (("stray.wav",), "2 warnings")])
def test_check_counts_its_warnings(tmp_path: Path, capsys: Streams, strays: tuple[str, ...], said: str) -> None:
    folder = fill_plate(tmp_path / "plate")
    sound, rate = soundfile.read(folder / "004.wav")
    clipped = np.clip(5 * sound / np.abs(sound).max(), -1, 1)
    soundfile.write(folder / "004.wav", clipped, rate, subtype="FLOAT")
    for name in strays:
        soundfile.write(folder / name, sound, rate)
    assert main(["check", str(folder)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"readable, with {said}"


def test_check_shows_every_problem_and_ends_with_2_where_it_cannot_be_read(tmp_path: Path, capsys: Streams) -> None:
    folder = fill_plate(tmp_path / "plate")
    (folder / "003.wav").unlink()
    soundfile.write(folder / "004.wav", np.zeros(2400), 8000, subtype="FLOAT")
    assert main(["check", str(folder), "--json"]) == 2
    out, err = capsys.readouterr()
    report = json.loads(out)
    assert not report["readable"]
    assert [row["readable"] for row in report["recordings"]] == [True, True, False, False, True, True, True, True]
    assert "\n003.wav: " in err
    assert "\n004.wav: " in err
    assert err.splitlines()[-1].startswith(f"avmsf check: {folder} cannot be read")


def test_a_capture_that_looks_wrong_is_noted_as_a_sentence(tmp_path: Path, capsys: Streams) -> None:
    folder = fill_plate(tmp_path / "plate")
    soundfile.write(folder / "stray.wav", np.zeros(100), 8000)
    table = (folder / "impacts.csv").read_text().splitlines()
    sound, rate = soundfile.read(folder / "002.wav")
    soundfile.write(folder / "002.wav", np.clip(5 * sound / np.abs(sound).max(), -1, 1), rate, subtype="FLOAT")
    assert main(["modes", str(folder), "--modes", "8"]) == 0
    err = capsys.readouterr().err
    notes = [line for line in err.splitlines() if line.startswith("note: ")]
    assert len(notes) == 1
    assert "002.wav: " in notes[0]
    assert "clipped" in notes[0]
    assert "CaptureWarning" not in err
    assert len(table) == 9


def test_modes_prints_the_plates(capture: Path, tmp_path: Path, capsys: Streams) -> None:
    picture = tmp_path / "modes.png"
    assert main(["modes", str(capture), "--json", "--plots", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
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
    assert all(len(line) <= 100 for line in err.splitlines() if "│" in line)
    assert (found["recordings"], found["sample_rate"]) == (8, RATE)
    assert f"{strongest['frequency_hertz']:.2f}" in err
    assert picture.read_bytes().startswith(b"\x89PNG")
    # The table is the verb's output where no JSON is.
    main(["modes", str(capture), "--extraction", "short-time", "--modes", "4"])
    assert " modes of plate" in capsys.readouterr().out


def test_fit_writes_a_field_and_its_scores(capture: Path, tmp_path: Path, capsys: Streams) -> None:
    path = tmp_path / "deep" / "plate.safetensors"
    words = [
        "fit",
        str(capture),
        "--output",
        str(path),
        "--train-fraction",
        "0.5",
        "--start",
        "2",
        "--json",
        "--gain-model",
        "network",
        "--without-shape",
        *TINY,
    ]
    assert main([*words, "--seed", "3"]) == 0
    told = json.loads(capsys.readouterr().out)
    field = load(path)
    assert told["modes"] == int(field.is_mode.sum()) > 0
    assert told["modes"] + told["supporting_poles"] == len(field.bank) <= 12
    assert told["trained_on"] == list(field.origin.trained_on)
    assert told["trained_on"][0] == "003.wav"
    assert len(told["trained_on"]) == len(told["tested_on"]) == 4
    assert set(told["trained_on"]).isdisjoint(told["tested_on"])
    config = field.origin.config
    assert (config.seed, config.clusters, config.fft_sizes) == (3, 8, (1024, 256))
    assert set(told["scores"]) == {
        "field",
        "nearest recording",
        "mean waveform of 3 nearest",
        "mean gains of 3 nearest",
        "white noise",
        "the held-out recordings' own gains, no noise",
    }
    errors = {method: each["relative_stft"] for method, each in told["scores"].items()}
    assert min(errors, key=lambda method: errors[method]) == "the held-out recordings' own gains, no noise"
    assert max(errors, key=lambda method: errors[method]) == "white noise"
    assert [each.name for each in path.parent.iterdir()] == ["plate.safetensors"]


def keep_one(folder: Path, samples: np.ndarray | None = None) -> Path:
    """Return the folder of a capture of one recording: the first row, its sound replaced where `samples` are given."""
    table = folder / "impacts.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:2]))
    if samples is not None:
        soundfile.write(next(folder.rglob("001.wav")), samples, int(RATE), subtype="FLOAT")
    return folder


def test_fit_takes_a_single_recording(tmp_path: Path, capsys: Streams) -> None:
    folder, output = keep_one(fill_plate(tmp_path / "plate")), tmp_path / "field.safetensors"
    assert main(["fit", str(folder), "--output", str(output), "--json", "--gain-model", "smooth", *TINY]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["trained_on"], told["tested_on"], told["scores"]) == (["001.wav"], [], {})
    # Leave-one-out, on which a word on the quality rests, needs more.
    assert load(output).quality is None


def test_a_single_silent_recording_is_one_error(tmp_path: Path, capsys: Streams) -> None:
    folder, output = keep_one(fill_plate(tmp_path / "plate"), np.zeros(4000)), tmp_path / "field.safetensors"
    words = [str(folder), "--output", str(output), *TINY]
    with raises(CaptureError, file="001.wav", name=None, value=0.0):
        run_verb("fit", *words)
    capsys.readouterr()
    assert main(["fit", *words]) == 2
    assert error_line(capsys)
    assert not output.exists()


def test_fit_to_one_position_is_scored_at_the_others(capture: Path, tmp_path: Path, capsys: Streams) -> None:
    words = ["--train-count", "1", "--start", "3", "--gain-model", "smooth", "--json", *TINY]
    assert main(["fit", str(capture), "--output", str(tmp_path / "field.safetensors"), *words]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["trained_on"] == ["004.wav"]
    assert len(told["tested_on"]) == 7
    assert "mean waveform of 1 nearest" in told["scores"]
    assert np.isfinite([error for each in told["scores"].values() for error in each.values()]).all()


def test_modes_of_the_paper_start_at_the_peak(capture: Path, monkeypatch: pytest.MonkeyPatch, capsys: Streams) -> None:
    asked: list[str] = []

    def read(folder: Path, settings: CaptureSettings) -> Capture:
        asked.append(settings.time_zero)
        return read_capture(folder, settings)

    monkeypatch.setattr("avmsf.capture.read_capture", read)
    for words in ([], ["--preset", "paper"], ["--preset", "paper", "--time-zero", "onset"]):
        assert main(["modes", str(capture), "--modes", "4", "--json", *words]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["method"] == ("short-time" if words else "high-resolution")
    assert asked == ["onset", "peak", "onset"]


SHEET = sets("body.wall=0.004 body.shapes=8 body.dofs=1000")


def test_fit_says_why_elastic_mode_shapes_took_no_part(tmp_path: Path, capsys: Streams) -> None:
    folder, fields = fill_plate(tmp_path / "plate", surface=False), tmp_path / "fields"
    words = ["--output", str(fields / "all.safetensors"), "--json", "--train-count", "2", *TINY]
    assert main(["fit", str(folder), *words]) == 0
    out, err = capsys.readouterr()
    assert "got 2" in err
    report = json.loads(out)["report"]
    assert report["bodies"] == []
    assert "surface.obj" in report["unavailable"]["elastic"]
    # One note says it, with what to do.
    (note,) = [line for line in err.splitlines() if "surface" in line]
    assert "elastic" in note
    # Told to do without them, it does not look for any.
    assert main(["fit", str(folder), "--output", str(fields / "one.safetensors"), "--gain-model", "smooth", *TINY]) == 0
    assert "elastic mode" not in capsys.readouterr().err


def test_a_stated_wall_that_the_object_cannot_have_ends_the_fit(tmp_path: Path, capsys: Streams) -> None:
    folder, output = fill_plate(tmp_path / "plate"), tmp_path / "plate.safetensors"
    for words in (["fit", str(folder)], ["fit", str(folder / "surface.ply"), "--material", "glass"]):
        assert main([*words, "--output", str(output), "--set", "body.wall=3", *TINY]) == 2
        assert "body.wall" in capsys.readouterr().err
    assert not output.exists()
    assert not list(folder.glob(".avmsf/modes.safetensors"))


@pytest.mark.parametrize("wrong", ["no mesh, seen before the modes", "a rate that diverges, seen after them"])
def test_a_refused_fit_leaves_nothing_behind(tmp_path: Path, capsys: Streams, wrong: str) -> None:
    early = wrong.endswith("before the modes")
    folder, output = fill_plate(tmp_path / "plate", surface=not early), tmp_path / "fields" / "plate.safetensors"
    words = ["--gain-model", "elastic", *SHEET, *TINY, *(() if early else ("--set", "fit.learning_rate=1e30"))]
    assert main(["fit", str(folder), "--output", str(output), *words]) == 2
    assert ("surface.obj" in capsys.readouterr().err) == early
    assert (folder / ".avmsf" / "modes.safetensors").exists() == (not early)
    assert [each.name for each in output.parent.glob("*") if each.suffix != ".bodies"] == []


def test_a_surface_in_another_unit_is_refused_once(tmp_path: Path, capsys: Streams) -> None:
    folder = fill_plate(tmp_path / "plate")
    (surface,) = folder.glob("surface.*")
    trimesh.load(surface, process=False).apply_scale(1000.0).export(surface)
    output = tmp_path / "field.safetensors"
    assert main(["fit", str(folder), "--output", str(output), "--gain-model", "smooth", *TINY]) == 2
    _, err = capsys.readouterr()
    assert err.count('is the surface\'s unit "mm"?') == 1
    assert not output.exists()


def test_without_a_surface_the_contacts_box_stands_for_the_object(tmp_path: Path, capsys: Streams) -> None:
    folder = fill_plate(tmp_path / "plate", surface=False)
    path = tmp_path / "plate.safetensors"
    assert main(["fit", str(folder), "--output", str(path), "--gain-model", "network", *TINY]) == 0
    assert "bounding box" in capsys.readouterr().err
    points = load(path).gain_field.points
    contacts = read_capture(folder).impacts.contacts
    # Points are float32.
    assert torch.allclose(points.amax(0).double(), contacts.amax(0), atol=1e-7)


def test_render_is_the_fields_own(field: Path, tmp_path: Path, capsys: Streams) -> None:
    output = tmp_path / "sounds"
    words = ["render", str(field), *AT, "--position", "50e-3", "0.12", "-1e-3", "--output", str(output), "--force", "2"]
    assert main(words) == 0
    out, err = capsys.readouterr()
    assert out.startswith(f"wrote 2 sounds to {output}")
    assert "forces are not known" in err
    contacts = torch.tensor([[0.05, 0.06, 0.0], [0.05, 0.12, -1e-3]], dtype=torch.float64)
    expected = load(field).render(contacts, forces=2.0)
    for row, name in enumerate(("001.wav", "002.wav")):
        sound, rate = soundfile.read(output / name, dtype="float32")
        assert rate == RATE
        assert soundfile.info(output / name).subtype == "FLOAT"
        assert np.array_equal(sound, expected[row].numpy())
    assert sorted(each.name for each in output.iterdir()) == ["001.wav", "002.wav"]


def test_render_takes_a_table_in_any_unit_and_a_length(field: Path, tmp_path: Path) -> None:
    table = tmp_path / "places.csv"
    table.write_text("File;X;Y;Z;who\nrim/one.wav;50,0;60;0;a\nwall;50;120;0;b\n")
    words = ["render", str(field), "--contact-table", str(table), "--unit", "mm", "--output", str(tmp_path / "out")]
    assert main([*words, "--seconds", "0.1"]) == 0
    contacts = torch.tensor([[0.05, 0.06, 0.0], [0.05, 0.12, 0.0]], dtype=torch.float64)
    expected = load(field).render(contacts, samples=800)
    for row, name in enumerate(("rim/one.wav", "wall.wav")):
        assert np.array_equal(soundfile.read(tmp_path / "out" / name, dtype="float32")[0], expected[row].numpy())


def test_render_sets_levels_by_one_factor_for_all(field: Path, tmp_path: Path) -> None:
    places = ["--position", "0.05", "0.06", "0", "--position", "0.02", "0.02", "0"]
    words = ["render", str(field), *places, "--output", str(tmp_path), "--normalize", "peak", "--level-db", "-6"]
    assert main([*words, "--coding", "int16"]) == 0
    plain = load(field).render(torch.tensor([[0.05, 0.06, 0.0], [0.02, 0.02, 0.0]]))
    expected = plain / plain.abs().max() * 10 ** (-6 / 20)
    for row, name in enumerate(("001.wav", "002.wav")):
        sound = soundfile.read(tmp_path / name)[0]
        # One step of 16 bits.
        assert np.abs(sound - expected[row].numpy()).max() <= 2**-15
        assert soundfile.info(tmp_path / name).subtype == "PCM_16"


def test_16_bits_are_filled_to_their_largest_value(field: Path, tmp_path: Path) -> None:
    places = ["--position", "0.05", "0.06", "0", "--position", "0.02", "0.02", "0"]
    words = ["render", str(field), *places, "--output", str(tmp_path), "--normalize", "peak", "--coding", "int16"]
    assert main(words) == 0
    written = [soundfile.read(tmp_path / name, dtype="int16")[0] for name in ("001.wav", "002.wav")]
    assert max(np.abs(each.astype(int)).max() for each in written) == 32767


def test_nothing_clips_in_silence(field: Path, tmp_path: Path, capsys: Streams) -> None:
    path = tmp_path / "loud.wav"
    words = ["render", str(field), *AT, "--output", str(path), "--normalize", "peak", "--level-db", "6"]
    assert main([*words, "--coding", "int16"]) == 2
    assert "got 2" in error_line(capsys)
    assert not path.exists()
    assert main(words) == 0
    assert "peaks at +6.0 dB over full scale" in capsys.readouterr().err
    assert np.abs(soundfile.read(path)[0]).max() == pytest.approx(10 ** (6 / 20), rel=1e-6)


def test_show_says_and_draws(field: Path, capture: Path, tmp_path: Path, capsys: Streams) -> None:
    output = tmp_path / "pictures"
    assert main(["info", str(field), "--capture", str(capture), "--plots", str(output), "--json"]) == 0
    out, err = capsys.readouterr()
    told, fitted = json.loads(out), load(field)
    assert told["capture"] == "plate"
    assert told["sample_rate"] == RATE
    frequency, is_mode = fitted.bank.frequency, fitted.is_mode
    assert told["mode_count"] == len(told["modes"])
    assert [each["frequency_hertz"] for each in told["modes"]] == frequency[is_mode].tolist()
    assert [each["frequency_hertz"] for each in told["supporting_poles"]] == frequency[~is_mode].tolist()
    assert told["compared_with"]["which"] == "not training recordings"
    assert set(told["compared_with"]["recordings"]).isdisjoint(fitted.origin.trained_on)
    assert len(told["compared_with"]["recordings"]) == 3
    assert (len(told["trained_on"]), told["trained_on"][0]) == (5, "002.wav")
    assert "field of plate" in err
    for name in ("modes", "gains", "spectrograms"):
        assert (output / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    # Without a capture, and without pictures.
    assert main(["info", str(field)]) == 0
    out = capsys.readouterr().out
    assert "field of plate" in out
    assert (told["pipeline"]["extraction"], told["pipeline"]["fit"]["seed"]) == ("high-resolution", 0)
    assert "extraction high-resolution" in out


def test_what_is_rendered_is_listed_as_json_and_nothing_else_is_on_the_standard_output(
    field: Path, tmp_path: Path, capsys: Streams
) -> None:
    assert main(["render", str(field), *AT, "-o", str(tmp_path / "a.wav"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["files"] == [str(tmp_path / "a.wav")]


def test_a_quiet_verb_prints_no_progress(capture: Path, capsys: Streams) -> None:
    assert main(["modes", str(capture), "--modes", "4", "--quiet"]) == 0
    out, err = capsys.readouterr()
    assert "frequency Hz" in out
    assert err == ""
