"""Elastic modes in a file: the same to the last bit, or an error that names the file."""

import json

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from avmsf.errors import SimulationError
from avmsf.fem.elastic_modes import ElasticModes, elastic_modes, load_modes, save_modes
from avmsf.fem.material import GLASS
from factories.raising import raises
from oracles.block import block


@pytest.fixture(scope="module")
def modes() -> ElasticModes:
    return elastic_modes(block((0.07, 0.05, 0.011), (2, 1, 1)), GLASS, count=4, perturbed=True)


def test_what_is_read_is_what_was_written(modes, tmp_path):
    save_modes(modes, tmp_path / "new" / "modes.safetensors")
    back = load_modes(tmp_path / "new" / "modes.safetensors")
    for name in ("frequency", "nodes", "triangles", "shapes"):
        assert torch.equal(getattr(back, name), getattr(modes, name))
    for name in ("stiffness", "mass", "poisson"):
        assert (getattr(back.perturbations, name) == getattr(modes.perturbations, name)).all()
    assert (back.material, back.mass) == (modes.material, modes.mass)
    assert torch.equal(back.at(modes.nodes[:5]), modes.at(modes.nodes[:5]))


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("mass", lambda record, tensors: record.pop("mass")),
        ("modes", lambda record, tensors: tensors.pop("poisson")),
        ("modes", lambda record, tensors: tensors.update(other=torch.ones(1))),
    ],
)
def test_files_that_were_changed(modes, tmp_path, name, change):
    path = tmp_path / "modes.safetensors"
    save_modes(modes, path)
    tensors = load_file(path)
    record = json.loads(safe_open(path, "pt").metadata()["avmsf_elastic"])
    change(record, tensors)
    save_file(tensors, path, {"avmsf_elastic": json.dumps(record)})
    with raises(SimulationError, file=path, name=name):
        load_modes(path)
