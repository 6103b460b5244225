"""What the user can get wrong at the command line: exit code 2 and one line that says what to do."""

import subprocess
import sys
from pathlib import Path

import pytest

from avmsf.cli import main
from plate_capture import TINY, fill_plate

Streams = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with captures, a field, and tables of contacts that cannot be used."""
    folder = tmp_path_factory.mktemp("place")
    fill_plate(folder / "plate")
    fill_plate(folder / "fast", rate=9000.0)
    words = ["fit", str(folder / "plate"), "--output", str(folder / "field.safetensors"), *TINY]
    assert main([*words, "--gain-model", "smooth", "--steps", "1"]) == 0
    (folder / "not-ours.safetensors").write_bytes(b"RIFF and so on")
    (folder / "no-z.csv").write_text("file,x,y\na.wav,0,0\n")
    (folder / "empty.csv").write_text("x,y,z\n")
    (folder / "words.csv").write_text("x,y,z\n0,0,0\n0.1,left,0\n")
    (folder / "short.csv").write_text("x,y,z\n0,0\n")
    (folder / "twice.csv").write_text("file,x,y,z\na.wav,0,0,0\na,0.1,0,0\n")
    (folder / "outside.csv").write_text("file,x,y,z\n../a.wav,0,0,0\n")
    (folder / "wrong.toml").write_text('unit = "miles"\n')
    return folder


AT = "--position 0.1 0.05 0"
WRONG = {
    "check plate --settings wrong.toml": "'miles'",
    "modes nowhere": "nowhere: expected a capture folder",
    "modes plate --settings nowhere.toml": "nowhere.toml: expected a capture.toml",
    "modes plate --picture modes.gif": "ends in .png, .pdf or .svg, found .gif",
    "modes plate --modes 0": "modes = 0: expected 1 or more",
    "fit nowhere -o f.safetensors": "nowhere: expected a capture folder",
    "fit plate --output plate": "is a folder",
    "fit plate --output words.csv/f.safetensors": "is a file, so there can be no folder",
    "fit plate --output f.safetensors --train-count 8": "8 recordings at 8 places",
    "fit plate --output f.safetensors --train-fraction 1.5": "must lie between 0 and 1",
    "fit plate --output f.safetensors --train-count 4 --start 8": "0 to 7, got 8",
    "fit plate --output f.safetensors --train-count 4 --train-fraction 0.5": "leave one of them out",
    "fit plate --output f.safetensors --validation 2": "validation = 2.0: expected 0 to 0.5",
    "render nowhere.safetensors --position 0 0 0 -o s": "nowhere.safetensors: expected a field file",
    f"render not-ours.safetensors {AT} --output s": "RIFF",
    "render field.safetensors --output s": "expected contacts either by --position",
    f"render field.safetensors {AT} --contact-table no-z.csv --output s": "expected contacts either by --position",
    "render field.safetensors --position 50 60 0 --output s": "--unit says",
    "render field.safetensors --position nan 0 0 --output s": "expected finite numbers",
    f"render field.safetensors {AT} {AT} --output two.wav": "is one file and there are 2 contacts",
    f"render field.safetensors {AT} --output words.csv": "words.csv is a file",
    f"render field.safetensors {AT} --output s --seconds 0": "expected a time above 0",
    f"render field.safetensors {AT} --output s --seconds nan": "expected a time above 0",
    f"render field.safetensors {AT} --output s --level-db nan": "--level-db is nan",
    f"render field.safetensors {AT} --output s --force inf": "--force is inf",
    "render field.safetensors --contact-table nowhere.csv --output s": "nowhere.csv: expected a table of contacts",
    "render field.safetensors --contact-table no-z.csv --output s": "the column z is missing",
    "render field.safetensors --contact-table empty.csv --output s": "there is no row",
    "render field.safetensors --contact-table words.csv --output s": "line 3: y is 'left'",
    "render field.safetensors --contact-table short.csv --output s": "line 2: z is ''",
    "render field.safetensors --contact-table twice.csv --output s": "more than one row is to become a.wav",
    "render field.safetensors --contact-table outside.csv --output s": "line 2: file is '../a.wav'",
    "info nowhere.safetensors": "nowhere.safetensors: expected a field, Gaussians or features",
    "info field.safetensors --capture fast": "9000 Hz",
    "demo plate": "files that no demo wrote",
    "demo words.csv": "expected a folder, got a file",
}


@pytest.mark.parametrize("words", WRONG)
def test_one_line_says_what_is_wrong(words: str, place: Path, capsys: Streams, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    before = {path.name for path in place.iterdir()}
    assert main(words.split()) == 2
    err = capsys.readouterr().err
    # Progress may come before.
    line = err.splitlines()[-1]
    assert line.startswith(f"avmsf {words.split()[0]}: ")
    assert WRONG[words] in line
    assert "Traceback" not in err
    assert {path.name for path in place.iterdir()} == before


@pytest.mark.slow
def test_a_process_ends_with_2_and_an_empty_standard_output(place: Path) -> None:
    code = "import sys; from avmsf.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "modes", "nowhere", "--json"]
    ran = subprocess.run(command, cwd=place, capture_output=True, text=True, timeout=60, check=False)
    assert (ran.returncode, ran.stdout) == (2, "")
    assert ran.stderr.splitlines()[-1].startswith("avmsf modes: nowhere: expected a capture folder")
