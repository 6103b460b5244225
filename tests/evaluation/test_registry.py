"""A new method or metric is a function and a line, as the tutorial has them."""

import json
import pickle
import re
from pathlib import Path
from unittest.mock import patch

import pytest

from avmsf.capture import read_capture
from avmsf.errors import EvaluationError
from avmsf.evaluation.methods import method_named
from avmsf.evaluation.registry import METHODS, METRICS, MetricEntry, resolve
from avmsf.evaluation.scores import score
from avmsf.evaluation.simple_methods import MeanWaveform
from avmsf.evaluation.splits import align_split, split
from factories.plate_set import fill_plates
from factories.raising import raises

TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorials" / "evaluate.md"


def test_a_method_and_a_metric_of_the_tutorial_are_in_the_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill_plates(tmp_path / "objects", ("mug",))
    monkeypatch.chdir(tmp_path)
    (block,) = (
        block for block in re.findall(r"```python\n(.*?)```", TUTORIAL.read_text(), re.DOTALL) if "METHODS[" in block
    )
    with patch.dict(METHODS), patch.dict(METRICS):
        exec(block, {})
    report = (tmp_path / "mean-of-all" / "report.md").read_text()
    assert "| peak error, dB |" in report
    assert "mean-of-all: mean waveform of all training recordings" in report
    summary = json.loads((tmp_path / "mean-of-all" / "summary.json").read_text())
    train, test = align_split(*split(read_capture(tmp_path / "objects" / "mug").impacts, 0.2))
    ratio = MeanWaveform(train, len(train)).render(test.contacts).abs().amax(1) / test.sounds.abs().amax(1)
    expected = float((20 * ratio.log10().abs()).mean())
    assert summary["methods"]["mean-of-all"]["peak_error"] == pytest.approx(expected, rel=1e-3)
    assert summary["ratio_to_knn3"]["mean-of-all"]["peak_error"] > 0


def test_a_metric_has_a_value_for_each_contact(tmp_path: Path) -> None:
    impacts = read_capture(fill_plates(tmp_path, ("mug",)) / "mug").impacts
    entry = MetricEntry("mean", lambda predicted, truth, *, sample_rate: predicted.mean())
    with patch.dict(METRICS, mean=entry), raises(EvaluationError, name="mean", value=[]):
        score(impacts.sounds, impacts)


def test_every_import_path_leads_to_a_function() -> None:
    for name, entry in METHODS.items():
        assert callable(resolve(entry.make or entry.fit)), name
        assert entry.path or method_named(name).name == name
    assert all(callable(resolve(entry.function)) for entry in METRICS.values() if entry.function is not None)


def test_every_method_can_be_sent_to_a_worker() -> None:
    methods = [method_named(name) for name, entry in METHODS.items() if not entry.path]
    assert [each.name for each in pickle.loads(pickle.dumps(methods))] == [each.name for each in methods]
