"""What a field's file says of the configuration that made it, and how many of its poles are modes."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import torch

from avmsf._utils.text import counted
from avmsf.capture.impacts import Impacts
from avmsf.field.sound_field import SoundField
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.quality import measure_quality
from avmsf.pipeline.config import PipelineConfig

RECORD = "pipeline"
"""What a field's report calls the configuration that made it."""

_RENAMED = {
    RECORD: {"method": "extraction"},
    "body": {"freedoms": "dofs"},
    "splat": {"dissent": "wrong_masks"},
    "lift": {"background": "encoder_background", "size": "feature_size"},
}
"""Settings in files of earlier versions, and their names now, by the record that holds them."""


def with_record(made: SoundField, config: PipelineConfig, features: Mapping[str, Any]) -> SoundField:
    """Return a field whose report has the configuration that made it, but for the fit's own, which it has anyway.

    `features` is the report of the features' file: it names the encoder that was taken and how the features were made,
    which decide where `config.scene` does not, as for a file from elsewhere. Empty where there is none.
    """
    values = asdict(config)
    del values["fit"]
    values["scene"] = features.get("scene")
    values["encoder"] = features.get("encoder")
    return replace(made, origin=replace(made.origin, report={**made.origin.report, RECORD: values}))


def supporting_poles(modes: Extraction, impacts: Impacts) -> list[int]:
    """Return the rows of the poles that are no modes of the object, from the recordings that they were found in."""
    quality = measure_quality(modes.aligned(impacts).sounds, modes, sample_rate=impacts.sample_rate)
    return torch.nonzero(~quality.is_mode).flatten().tolist()


def modes_words(poles: int, supporting: int) -> str:
    """Return how many of the poles of a model are modes of the object: "16 modes and 38 supporting poles"."""
    modes = counted(poles - supporting, "mode")
    return f"{modes} and {counted(supporting, 'supporting pole')}" if supporting else modes


def recorded(field: SoundField) -> dict[str, Any]:
    """Return the configuration in a field's report, by the names that settings have now; empty where there is none."""
    return _renamed(field.origin.report.get(RECORD, {}), RECORD)


def _renamed(values: Mapping[str, Any], owner: str) -> dict[str, Any]:
    names = _RENAMED.get(owner, {})
    return {
        names.get(name, name): _renamed(value, name) if isinstance(value, Mapping) else value
        for name, value in values.items()
    }
