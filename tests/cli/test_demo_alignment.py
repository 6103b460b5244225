"""The demo's page and its sounds to compare hold recordings that start where those start that its field is of."""

from dataclasses import replace
from pathlib import Path

import pytest
import soundfile
import torch
from torch import Tensor

from avmsf.capture import Impacts, read_capture
from avmsf.cli import demo
from avmsf.evaluation.simple_methods import MeanWaveform
from avmsf.evaluation.splits import split
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.store import save
from avmsf.gaussians.points import farthest_points
from avmsf.modal.extraction.extract import extract_modes
from avmsf.pipeline.fit import StagedFit
from avmsf.pipeline.scene import CLOUD, ProgressListener
from avmsf.pipeline.stages import StageFolder
from factories.delayed_plate import ALIGNED, delays, distance, strikes, without_delays

COUNT = 16


def sounds_of(folder: Path, kind: str) -> Tensor:
    """Return the demo's sounds of a kind, each of unit norm."""
    files = sorted((folder / "sounds").glob(f"*-{kind}.wav"))
    sounds = torch.stack([torch.from_numpy(soundfile.read(each, dtype="float32")[0]) for each in files])
    return torch.nn.functional.normalize(sounds)


def test_the_demos_page_and_sounds_do_not_depend_on_delays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    delayed = strikes(COUNT, starts=delays(COUNT))
    train, test = split(delayed, demo.TRAIN)
    modes = extract_modes(train)
    config = FitConfig(steps=0, residual=False)
    field = fit(
        train, FeatureField.from_contacts(delayed.contacts), modes, config, gains=MixtureEstimator(("thin-plate",))
    )
    shown: list[Impacts] = []

    def fit_in_stages(capture: object, config: object, stages: StageFolder, **named: object) -> StagedFit:
        stages.folder.mkdir(exist_ok=True)
        stages.path(CLOUD).touch()
        save(field, stages.path("field.safetensors"))
        return StagedFit(stages.path("field.safetensors"), (), {}, modes)

    monkeypatch.setattr(demo, "read_capture", lambda folder: replace(read_capture(folder), impacts=delayed))
    monkeypatch.setattr(demo, "fit_in_stages", fit_in_stages)
    monkeypatch.setattr(demo, "write_webpage", lambda *arguments, strikes, **named: shown.append(strikes))
    monkeypatch.setattr(demo, "save_picture", lambda picture, path: None)
    demo._go_all_the_way(tmp_path, ProgressListener())
    exact_train, exact_test = (without_delays(each, modes, delays(COUNT)) for each in (train, test))
    assert distance(shown[0].sounds, exact_test.sounds) < ALIGNED
    heard = exact_test.take(farthest_points(test.contacts, 2).tolist())
    mean = MeanWaveform(exact_train).render(heard.contacts)
    for kind, expected in (("1-recorded", heard.sounds), ("3-mean-of-nearest", mean)):
        assert distance(sounds_of(tmp_path, kind), torch.nn.functional.normalize(expected)) < 2 * ALIGNED
