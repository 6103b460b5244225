"""What `python -m benchmarks NAME` promises of its output, its arguments and its yardsticks; not its figures."""

import io
import json
import math
import pkgutil
import re
import sys
from pathlib import Path

import pytest
import torch

REPOSITORY = Path(__file__).resolve().parents[1]
# The benchmarks are no part of the package, and `python -m benchmarks` finds them from the repository's root alone.
sys.path.insert(0, str(REPOSITORY))

from avmsf.modal.modes import ModalBank  # noqa: E402
from benchmarks import field, speed  # noqa: E402
from benchmarks.__main__ import main  # noqa: E402
from benchmarks.extract import Match  # noqa: E402
from benchmarks.material import clips_in_place  # noqa: E402
from benchmarks.report import Options, Report, Table, show  # noqa: E402
from benchmarks.step import STEPS, PlainRun, full_setting, pass_warmup, start  # noqa: E402
from oracles.plate import PlateModes  # noqa: E402


def shown(report: Report, *, quick_look: bool = False) -> list[str]:
    out = io.StringIO()
    show(report, Options(("part",), quick_look=quick_look), name="name", out=out)
    return out.getvalue().splitlines()


def test_the_last_line_is_one_flat_object_of_numbers() -> None:
    table = Table("a table", ("method", "error"), [["field", 0.25], ["noise", math.nan]])
    lines = shown(Report(("how it was measured",), (table,), {"plate.field": 0.25, "plate.modes": 43}))
    assert json.loads(lines[-1]) == {"plate.field": 0.25, "plate.modes": 43.0, "quick_look": 0.0}
    assert "  how it was measured" in lines
    assert lines.index("field    0.25") == lines.index("noise       -") - 1


def test_what_was_not_measured_has_no_key_and_is_named() -> None:
    lines = shown(Report(figures={"good": 1.0, "no_number": math.nan, "endless": math.inf}))
    # Python's own NaN and Infinity are no JSON.
    assert json.loads(lines[-1], parse_constant=pytest.fail) == {"good": 1.0, "quick_look": 0.0}
    assert "not measured, and left out below: no_number, endless" in lines


def test_a_quick_look_says_so() -> None:
    lines = shown(Report(figures={"good": 1.0}), quick_look=True)
    assert any(line.startswith("QUICK LOOK") for line in lines)
    assert json.loads(lines[-1])["quick_look"] == 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tea"], "invalid choice: 'tea'"),
        ([], "the following arguments are required: name"),
        (["field", "--parts", "plate", "saucer"], "field has no part saucer; it has plate, plate_impulse, aircraft"),
        (["speed", "--paper-minutes", "0"], "--paper-minutes is 0; expected a number above 0"),
    ],
)
def test_bad_arguments_are_told(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    printed = capsys.readouterr()
    assert end.value.code == 2
    assert message in printed.err
    assert printed.out == ""


def test_without_measured_data_the_place_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("AVMSF_SHARED", str(tmp_path / "nowhere"))
    assert main(["extract", "--parts", "hammer_clips"]) == 2
    printed = capsys.readouterr()
    assert f"no measured data at {tmp_path / 'nowhere' / 'data'}" in printed.err
    assert printed.out == ""


def test_a_run_ends_with_its_figures(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["speed", "--parts", "render", "--quick-look"]) == 0
    figures = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert set(figures) == {"render_seconds", "quick_look"}
    assert figures["render_seconds"] > 0


def test_every_benchmark_measures_all_its_parts_unless_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(speed, "PARTS", {name: lambda options, name=name: Report(figures={name: 1.0}) for name in "ab"})
    assert main(["speed"]) == 0
    assert set(json.loads(capsys.readouterr().out.splitlines()[-1])) == {"a", "b", "quick_look"}


@pytest.mark.slow
def test_the_field_benchmark_has_every_method_and_metric_by_its_key() -> None:
    report = field.measure(Options(("plate",), quick_look=True))
    for method in ("white_noise", "nearest", "knn3_waveform", "knn3_gains", "warmup", "field", "floor", "sine_floor"):
        for metric in ("", ".l1", ".l1_log", ".envelope"):
            assert math.isfinite(report.figures[f"plate.{method}{metric}"])
    # Perfect gains on the found modes, and noise beside them, are what everything else lies between.
    assert report.figures["plate.floor"] < report.figures["plate.nearest"] < report.figures["plate.white_noise"]


def test_modes_are_matched_one_to_one_and_the_rest_is_spurious() -> None:
    frequency = torch.tensor([100.0, 200.0, 300.0, 400.0], dtype=torch.float64)
    damping = torch.full((4,), 2.0, dtype=torch.float64)
    # 60 dB below the others, the last one need not be found.
    gains = torch.tensor([[1.0, 1.0, 1.0, 1e-3]], dtype=torch.float64)
    truth = PlateModes(frequency, damping, gains, torch.ones(4, 2, dtype=torch.long))
    # Two candidates for the first mode; one for the second, 1e-3 high and with 1.1 times its damping; 306 is 2 % off.
    found = ModalBank(
        torch.tensor([100.0, 100.2, 200.2, 306.0], dtype=torch.float64),
        torch.tensor([2.0, 2.0, 2.2, 2.0], dtype=torch.float64),
    )
    figures = Match.of(found, truth).figures()
    assert figures["recall"] == pytest.approx(2 / 3)
    assert figures["spurious"] == pytest.approx(2 / 4)
    assert figures["frequency_error"] == pytest.approx(1e-3)
    assert figures["damping_error"] == pytest.approx(0.1)


@pytest.mark.slow
def test_the_plain_form_of_a_step_has_the_same_loss_and_gradient() -> None:
    setting = full_setting(0.2)
    runs = []
    for kind in (None, PlainRun):
        run, targets = start(*setting, STEPS) if kind is None else start(*setting, STEPS, kind=kind)
        pass_warmup(run, targets)
        loss = run.spectral_loss(targets)
        loss.backward()
        runs.append((float(loss.detach()), run.network.to_gains.weight.grad, run.shift.grad))
    # Float32's error of the phase, 2 pi 16 kHz x .2 s x 2^-24 = 1e-3 rad at most, on the highest mode.
    assert runs[1][0] == pytest.approx(runs[0][0], rel=1e-4)
    for own, plain in zip(runs[0][1:], runs[1][1:], strict=True):
        # Where magnitudes all but agree, that error turns the sign of their difference, and the slope with it.
        assert float((own - plain).norm() / own.norm()) < 5e-2


def test_hammer_clips_end_before_the_next_blow(shared: Path) -> None:
    lengths = {clip.name: len(clip.sound) / clip.sample_rate for clip in clips_in_place("hammer_clips")}
    # From the force channel: first pushes begin .404, .820, 2.467 and .676 s into the files, the next ones at .830,
    # 1.366, 3.940 and .986 s; 2 ms are cut before each.
    expected = {"ceramic": 0.424, "polycarb": 0.543, "steel": 1.471, "wood": 0.307}
    assert lengths == pytest.approx(expected, abs=0.002)


def test_clips_keep_three_seconds_from_their_onset(shared: Path) -> None:
    clips = clips_in_place("bowl_clips")
    assert [clip.name for clip in clips] == [f"mic{number}" for number in range(8)]
    assert all(len(clip.sound) == 3 * 48_000 for clip in clips)
    # A second of silence comes before each blow in the file: none of it is left.
    assert all(float(clip.sound[:480].abs().max()) > 0.3 * float(clip.sound.abs().max()) for clip in clips)


def test_every_function_and_test_in_the_table_of_equations_exists() -> None:
    text = (REPOSITORY / "docs/paper-map.md").read_text()
    functions = re.findall(r"`(avmsf\.[\w.]+)`", text)
    tests = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", text)
    assert len(functions) > 10
    assert len(tests) > 10
    for function in functions:
        pkgutil.resolve_name(function)
    for file, name in tests:
        assert f"def {name}(" in (REPOSITORY / file).read_text(), f"{file} has no {name}"
