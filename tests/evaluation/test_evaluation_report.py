"""What is concluded of kept figures, by hand; and pages that stand on their own."""

import base64
import io
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch
from PIL import Image
from test_runner import planned

from avmsf.capture.audio import read_recording
from avmsf.evaluation import report
from avmsf.evaluation.published import PUBLISHED, published_ratios
from avmsf.evaluation.registry import METHODS
from avmsf.evaluation.report import draw_spectrogram, markdown, picture_levels, write_page, write_summary
from avmsf.evaluation.results import (
    CaseRecord,
    ObjectRecord,
    Outcome,
    ResultsFolder,
    file_word,
    listening_gain,
    write_flac,
)
from avmsf.evaluation.runner import run_objects
from avmsf.evaluation.tables import CHOSEN_ON_TEST, Section, missing_of, sections, summarize, times_of, values_of
from factories.plate_set import fill_plates

IDENTITY = {"protocol": "farthest", "dataset": "ObjectFolder Real", "version": "0", "seed": 0}
IDENTITY |= {"methods": {"knn3": "", "paper": "", "paper-per-contact": "", "nearest": ""}}
IDENTITY |= {"metrics": {"kind": "m"}, "modes": {"kind": "n"}}


def record(name: str, figures: dict[str, tuple[float | None, ...] | str], *, label: str = "farthest") -> ObjectRecord:
    """Return an object with one case of two contacts, and for each method L1 at these or what made it fail."""
    outcomes = tuple(
        Outcome(label, method, failure=values) if isinstance(values, str) else Outcome(label, method, {"l1": values})
        for method, values in figures.items()
    )
    return ObjectRecord(name, cases=(CaseRecord(label, label, ("t",), ("u", "v")),), outcomes=outcomes)


THREE = (
    record("1", {"knn3": (1.0, 3.0), "paper": (1.0, 1.0)}),
    record("2", {"knn3": (4.0, 4.0), "paper": (16.0, None)}),
    record("10", {"knn3": (6.0, 6.0), "paper": "no modes"}),
)


def test_means_are_over_contacts_then_over_objects() -> None:
    summary = summarize(THREE, IDENTITY)
    assert summary["methods"] == {"knn3": {"l1": 4.0}, "paper": {"l1": 8.5}}
    # Of 2, 4 and 6 the standard deviation is 2; of 1 and 16, 7.5 sqrt 2.
    assert summary["standard_errors"]["knn3"]["l1"] == pytest.approx(2 / math.sqrt(3))
    assert summary["standard_errors"]["paper"]["l1"] == pytest.approx(7.5)
    assert summary["counts"] == {"knn3": 3, "paper": 2}
    assert summary["failures"] == [{"object": "10", "case": "farthest", "method": "paper", "failure": "no modes"}]


def best_of(records: tuple[ObjectRecord, ...]) -> tuple[list[str], Section]:
    """Return the methods that the main table marks as best, and its section."""
    (part,) = [each for each in sections(records, IDENTITY) if each.title == "All methods"]
    return [part.rows[row][0] for row, _ in sorted(part.best)], part


def test_the_best_is_marked_among_methods_that_have_all_objects() -> None:
    easy = record("1", {"knn3": (2.0, 2.0), "nearest": (3.0, 3.0), "paper": (1.0, 1.0)})
    hard = record("2", {"knn3": (9.0, 9.0), "nearest": (8.0, 8.0), "paper": "no modes"})
    best, part = best_of((easy, hard, record("3", {"knn3": (1.0, 1.0), "nearest": (1.5, 1.5)})))
    # Of three objects 4 and 4.17.
    assert best == ["knn3"]
    assert "paper" in part.remarks[0]
    whole = len(best_of((easy, hard))[1].remarks)
    best, part = best_of((easy,))
    assert best == ["paper"]
    assert len(part.remarks) == whole - 1
    # Where every method lacks an object there is no mean to compare.
    best, _ = best_of((easy, record("2", {"nearest": (8.0, 8.0)}), record("3", {"knn3": (1.0, 1.0)})))
    assert best == []


def test_the_damping_of_lower_env_on_test_contacts_has_a_row_that_says_so_and_is_never_best() -> None:
    def tested(name: str, *both: tuple[float, float]) -> ObjectRecord:
        """Return an object with L1 and ENV of both forms of the paper's dampings."""
        forms = zip(("paper", "paper-per-contact"), both, strict=False)
        outcomes = [Outcome("farthest", form, {"l1": (l1, l1), "envelope": (env, env)}) for form, (l1, env) in forms]
        return replace(record(name, {}), outcomes=tuple(outcomes))

    # By ENV, object by object: where the loser has the lower L1, too.
    shared, own = tested("1", (4.0, 1.0), (3.0, 2.0)), tested("2", (1.0, 5.0), (2.0, 0.5))
    assert summarize((shared, own), IDENTITY)["methods"][CHOSEN_ON_TEST] == {"l1": 3.0, "envelope": 0.75}
    best, part = best_of((shared, own))
    assert CHOSEN_ON_TEST in [row[0] for row in part.rows]
    assert set(best) == {"paper", "paper-per-contact"}
    assert CHOSEN_ON_TEST not in values_of([tested("3", (1.0, 1.0))], "farthest")


def test_a_failure_is_not_missing_but_a_method_or_an_object_that_has_not_run_is() -> None:
    broken = ObjectRecord("3", failure="no recordings")
    methods = ["knn3", "paper"]
    assert missing_of((*THREE, broken), dict.fromkeys(("1", "10", "3"), methods)) == {}
    assert missing_of(THREE, {"1": ["knn3", "field"], "7": methods}) == {"1": ["field"], "7": methods}
    # One case of two.
    cases = (*THREE[0].cases, CaseRecord("other", "other", ("t",), ("u",)))
    assert missing_of((replace(THREE[0], cases=cases),), {"1": methods}) == {"1": methods}


def test_ratios_are_paired() -> None:
    summary = summarize(THREE, IDENTITY)
    # Objects 1 and 2: 1 / 2 and 16 / 4, whose geometric mean is sqrt 2; means 8.5 and 3.
    assert summary["ratio_to_knn3"]["paper"]["l1"] == pytest.approx(math.sqrt(2))
    assert summary["ratio_of_means_to_knn3"]["paper"]["l1"] == pytest.approx(8.5 / 3)
    assert summary["ratio_to_knn3"]["knn3"]["l1"] == pytest.approx(1.0)


def test_a_perfect_method_has_ratio_zero_and_a_perfect_baseline_no_ratio() -> None:
    summary = summarize((record("1", {"knn3": (2.0, 2.0), "paper": (0.0, 0.0)}),), IDENTITY)
    assert summary["ratio_to_knn3"]["paper"] == {"l1": 0.0}
    assert summary["standard_errors"]["paper"] == {"l1": None}
    summary = summarize((record("1", {"knn3": (0.0, 0.0), "paper": (1.0, 1.0)}),), IDENTITY)
    assert summary["ratio_to_knn3"] == {}


def test_parts_of_one_experiment_are_pooled_and_one_that_failed_spoils_all() -> None:
    parts = tuple(CaseRecord(f"all: {name}", "all", ("t",), (name,)) for name in "uv")
    outcomes = [
        Outcome(f"all: {name}", "knn3", {"l1": (value,)}, {"mac": 0.5}) for name, value in (("u", 1.0), ("v", 5.0))
    ]
    whole = ObjectRecord("1", cases=parts, outcomes=tuple(outcomes))
    assert values_of([whole], "all") == {"knn3": {"l1": {"1": 3.0}, "mac": {"1": 0.5}}}
    assert values_of([replace(whole, outcomes=tuple(outcomes[:1]))], "all") == {}
    assert values_of([whole.adding(Outcome("all: v", "knn3", failure="no"))], "all") == {}


def test_figures_of_which_more_is_better_have_no_ratio() -> None:
    cases = (CaseRecord("a", "a", ("t",), ("u",)),)
    outcomes = tuple(Outcome("a", method, {}, {"mac": 0.5}) for method in ("knn3", "paper"))
    summary = summarize((ObjectRecord("1", cases=cases, outcomes=outcomes),), IDENTITY)
    assert summary["methods"]["paper"] == {"mac": 0.5}
    assert summary["ratio_to_knn3"] == {"knn3": {}, "paper": {}}


def test_groups_of_objects_have_their_own_means() -> None:
    summary = summarize(THREE, IDENTITY, subsets={"odd": frozenset({"1"}), "none": frozenset({"7"})})
    assert summary["subsets"] == {"odd": {"objects": 1, "methods": {"knn3": {"l1": 2.0}, "paper": {"l1": 1.0}}}}


def test_tables_have_the_papers_rows_for_its_datasets_alone() -> None:
    words = markdown(sections(THREE, IDENTITY))
    assert "| paper: AV-MSF | 0.0130 |" in words
    assert "| knn3 | **4.00 ± 1.2** | 3 |" in words
    assert "| 10 | farthest | paper | no modes |" in words
    assert "| paper: AV-MSF | 972 | 0.0438 |" in words
    assert f"paper: {METHODS['paper'].title}" in words
    for folder in ("sim-20", "ObjectFolder Real of mine", "ObjectFolder Real (captures)"):
        assert "paper: AV-MSF" not in markdown(sections(THREE, {**IDENTITY, "dataset": folder}))
    other = markdown(sections(THREE, {**IDENTITY, "dataset": "sim-20"}))
    # The ratios that its tables allow stand beside ours everywhere.
    assert "| paper, ObjectFolder Real: paper | 0.929 |" in other


def test_the_papers_ratio_is_of_its_own_rows() -> None:
    ratios = published_ratios("farthest")
    assert ratios["ObjectFolder Real"]["paper"]["cdpam"] == pytest.approx(1.35 / 1.53)
    assert ratios["ObjectFolder Real"]["white-noise"]["l1"] == pytest.approx(3.774 / 0.014)
    assert ratios["ObjectFolder Real"]["diffsound"] == ratios["ObjectFolder Real"]["paper-diffsound"]
    assert set(published_ratios("non-symmetric")) == {"ObjectFolder Real"}
    assert published_ratios("closest")["RealImpact"]["paper"]["l1"] == pytest.approx(21 / 26)
    assert sum(map(len, PUBLISHED.values())) == 44


def test_edits_move_from_where_their_own_object_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def edited(name: str, place: float) -> ObjectRecord:
        reports = {"unedited": [place, place], "edit-physics": [place + 1.0, place]}
        outcomes = [
            Outcome("to wood", method, report={"places": {"umap": at}, "source": "ceramic", "target": "wood"})
            for method, at in reports.items()
        ]
        return replace(record(name, {}), outcomes=tuple(outcomes))

    drawn, results = [], ResultsFolder(tmp_path)
    monkeypatch.setattr(ResultsFolder, "records", lambda _: (edited("1", 0.0), edited("2", 5.0)))
    monkeypatch.setattr(report, "read_json", lambda _: {"umap": {"names": [], "embedding": [], "materials": []}})
    monkeypatch.setattr(report, "draw_embedding", lambda *given, **_: drawn.append(given[2]))
    monkeypatch.setattr(report, "_write_figure", lambda *_: tmp_path)
    report.write_figures(results)
    assert drawn == [{"edit-physics": [([0.0, 0.0], [1.0, 0.0]), ([5.0, 5.0], [6.0, 5.0])]}]


def test_times_are_those_of_what_is_done() -> None:
    def timed(name: str, **more: Any) -> ObjectRecord:
        return replace(record(name, {}), outcomes=(Outcome("farthest", "knn3", **more),))

    records = timed("1", fit_seconds=10.0), timed("2", failure="no"), ObjectRecord("3", failure="broken")
    found = {name: each["methods"] for name, each in times_of(records).items()}
    assert found == {"1": {"knn3": {"fit": 10.0, "render": 0.0}}, "2": {}}


def test_methods_of_different_folders_have_files_of_different_names() -> None:
    words = {file_word(f"recorded:{path}") for path in ("runs/v1", "runs-v1", "\u97f3" * 300)}
    assert len(words) == 3
    assert max(len(each.encode()) for each in words) < 200
    assert file_word("16 shots") == "16-shots"


def test_a_kept_sound_is_as_loud_beside_the_recording_as_it_was(tmp_path: Path) -> None:
    time = torch.arange(4000) / 8000.0
    recorded = 3.0 * torch.sin(2 * math.pi * 440 * time)
    gain = listening_gain(recorded)
    for name, factor, peak in (("same", 1.0, 0.25), ("half", 0.5, 0.125), ("loud", 10.0, 1.0)):
        write_flac(tmp_path / name, recorded * factor, sample_rate=8000.0, gain=gain)
        heard = read_recording(tmp_path / name)
        # One step of 16 bits.
        assert np.abs(heard.channels).max() == pytest.approx(peak, abs=2e-4)
    write_flac(tmp_path / "slow", recorded, sample_rate=400.0, gain=gain)
    slow = read_recording(tmp_path / "slow")
    assert (slow.sample_rate, slow.frames) == (8000.0, 20 * 4000)
    # FLAC counts rates in tens above 65,535 Hz, and has none above 655,350 Hz.
    for rate, written in ((65_536.0, 65_530.0), (800_000.0, 400_000.0)):
        write_flac(tmp_path / "fast", recorded, sample_rate=rate, gain=gain)
        assert read_recording(tmp_path / "fast").sample_rate == written
    write_flac(tmp_path / "silent", torch.zeros(100), sample_rate=8000.0, gain=listening_gain(torch.zeros(100)))


def test_a_pictures_line_is_where_the_tone_is(tmp_path: Path) -> None:
    time = torch.arange(16000) / 16000.0
    write_flac(tmp_path / "tone", torch.sin(2 * math.pi * 1000 * time), sample_rate=16000.0, gain=0.5)
    sound = read_recording(tmp_path / "tone")
    levels = picture_levels(sound)
    address = draw_spectrogram(levels, loudest=float(levels.max()))
    picture = Image.open(io.BytesIO(base64.b64decode(address.partition(",")[2])))
    shades = torch.from_numpy(np.array(picture)[:, :, 1])
    # From the top, on a logarithmic scale of 60 Hz to 8 kHz; a Hann window is two bins, some rows, wide at 1 kHz.
    expected = 120 * math.log(8000 / 1000) / math.log(8000 / 60)
    assert float(shades[:, 120].argmax()) == pytest.approx(expected, abs=2.5)
    assert shades[5, 120] == 1  # the darkest purple


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("evaluated")
    plates = fill_plates(place / "plates", ("a", "b <i>"))
    results = ResultsFolder(place / "results")
    run_objects(planned(plates, "knn3", "nearest", "paper"), ("a", "b <i>"), results)
    write_summary(results, subsets={"round": frozenset("a")})
    write_page(results)
    return place / "results"


def test_the_page_stands_on_its_own_and_can_be_read_by_all(evaluated: Path) -> None:
    text = (evaluated / "report.html").read_text()
    sources, links = re.findall(r' src="([^"]*)"', text), re.findall(r' href="([^"]*)"', text)
    assert all(each.startswith("data:") for each in sources)
    assert {*links} <= {f"#{name}" for name in re.findall(r' id="([^"]+)"', text)}
    assert "http" not in text.replace("http-equiv", "")
    assert "@import" not in text
    pictures, sounds = re.findall(r"<img [^>]*>", text), re.findall(r"<audio [^>]*>", text)
    assert all(re.search(r' alt="[^"]', each) for each in pictures)
    assert all(re.search(r' aria-label="[^"]', each) and " controls" in each for each in sounds)
    assert (text.count('<html lang="en"'), text.count("<h1")) == (1, 1)
    # Two objects, three contacts, the recording and two methods; the field, which shows nothing of plates, failed.
    assert len(sounds) == len(pictures) == 2 * 3 * 3
    assert "<i>" not in text
    sound = re.findall(r' src="([^"]*)"', sounds[0])[0]
    samples, rate = soundfile.read(io.BytesIO(base64.b64decode(sound.partition(",")[2])))
    assert (len(samples), rate) == (2000, 8000)


def test_the_page_is_the_same_each_time_and_stays_small(evaluated: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = (evaluated / "report.html").read_text()
    write_page(ResultsFolder(evaluated))
    assert (evaluated / "report.html").read_text() == whole
    monkeypatch.setattr("avmsf.evaluation.report.MAX_PAGE_CHARACTERS", len(whole) // 3)
    write_page(ResultsFolder(evaluated))
    smaller = (evaluated / "report.html").read_text()
    assert len(smaller) < len(whole) / 2
    assert 0 < smaller.count("<audio") < whole.count("<audio")
