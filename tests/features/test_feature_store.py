"""Features as a file: what was saved comes back to the last bit, and no other file does."""

import json

import pytest
import torch
from safetensors.torch import save_file

from avmsf.errors import SceneError
from avmsf.features.feature_field import FeatureField
from avmsf.features.store import load_features, read_report, save_features
from factories.raising import raises


def field() -> FeatureField:
    generator = torch.Generator().manual_seed(0)
    return FeatureField(
        torch.rand(20, 3, generator=generator), torch.randn(20, 5, generator=generator), "descriptors, 5 components"
    )


def test_what_was_saved_comes_back(tmp_path):
    path = tmp_path / "deep" / "features.safetensors"
    report = {"unseen": 3, "views": ["a", "b"], "agreement": 0.5}
    save_features(field(), path, report=report)
    found = load_features(path)
    assert torch.equal(found.points, field().points)
    assert torch.equal(found.features, field().features)
    assert found.encoder == field().encoder
    assert read_report(path) == report
    assert [each.name for each in path.parent.iterdir()] == [path.name]


def test_a_failed_save_leaves_the_old_file(tmp_path):
    path = tmp_path / "features.safetensors"
    save_features(field(), path)
    before = path.read_bytes()
    spoilt = FeatureField(field().points, torch.full((20, 5), torch.nan), "anyone")
    with raises(SceneError, file=path, name="features"):
        save_features(spoilt, path)
    for report in ({"a": float("nan")}, {"a": torch.zeros(1)}):
        with raises(SceneError, file=path, name="report"):
            save_features(field(), path, report=report)
    assert path.read_bytes() == before
    with raises(SceneError, file=path / "below"):
        save_features(field(), path / "below")


TENSORS = {"points": torch.zeros(20, 3), "features": torch.zeros(20, 5)}


@pytest.mark.parametrize(
    ("changes", "name", "value"),
    [
        ({"format": 2, "version": "9.9"}, "format", 2),
        ({"sizes": {"points": 20}}, "dim", None),
        ({"sizes": {"points": 20, "dim": 0}}, "header", None),
        ({"sizes": {"points": 20, "dim": True}}, "header", None),
        ({"encoder": 3}, "header", None),
        ({"report": []}, "header", None),
        ({"sizes": {"points": 20, "dim": 6}}, "features", "float32[20, 5]"),
    ],
)
def test_a_changed_record_is_refused(tmp_path, changes, name, value):
    path = tmp_path / "f"
    record = {"format": 1, "version": "0.1.0", "encoder": "x", "sizes": {"points": 20, "dim": 5}, "report": {}}
    save_file(TENSORS, path, {"avmsf_features": json.dumps(record | changes)})
    with raises(SceneError, file=path, name=name, value=value):
        load_features(path)


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "f"
    save_features(field(), path)
    whole = path.read_bytes()
    save_file(TENSORS, path)
    for content, name in ((None, None), (b"ply\n", None), (whole[:-10], None), (path.read_bytes(), "avmsf_features")):
        path.unlink(missing_ok=True)
        if content is not None:
            path.write_bytes(content)
        with raises(SceneError, file=path, name=name):
            load_features(path)
