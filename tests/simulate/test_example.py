"""The built-in example is what its recipe says, and its files are what the recordings' truth says."""

from dataclasses import replace

import torch

from avmsf.capture import read_capture
from avmsf.capture.audio import read_recording
from avmsf.mesh.closest_point import ClosestPoints
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.modal.modes import ModalBank
from avmsf.photographs import read_views
from avmsf.photographs.mesh_views import MeshTracer
from avmsf.simulate.ground_truth import read_truth
from avmsf.simulate.recipe import EXAMPLE, EXAMPLE_FOLDER
from avmsf.simulate.simulation_folder import example_mesh


def test_the_example_was_made_by_its_recipe() -> None:
    kept = read_truth(EXAMPLE_FOLDER).recipe
    # It was made before these could be had.
    kept["imperfections"] = {"sensor": 0.0, "warming": 0.0} | kept["imperfections"]
    # Another version would make it anew with `make example`; until then what it was made with is what counts.
    assert kept | {"version": ""} == EXAMPLE.values() | {"version": ""}
    assert replace(EXAMPLE, seed=2) != EXAMPLE


def test_the_example_sounds_as_its_truth_says() -> None:
    truth, rate = read_truth(EXAMPLE_FOLDER), float(EXAMPLE.sample_rate)
    assert truth.names == read_capture(EXAMPLE_FOLDER).impacts.names
    # Each recording from its first sample after the impact on, and the truth as much later.
    firsts = truth.starts.ceil().long().tolist()
    recordings = [torch.from_numpy(read_recording(EXAMPLE_FOLDER / name).response()).float() for name in truth.names]
    sounds = torch.stack([row[first:][:44000] for row, first in zip(recordings, firsts, strict=True)])
    late = [(first - float(start)) / rate for first, start in zip(firsts, truth.starts, strict=True)]
    expected = torch.stack([truth.after(seconds).amplitudes[row] for row, seconds in enumerate(late)])
    gains = fit_gains(sounds, ModalBank(truth.frequency, truth.damping), sample_rate=rate)
    error = (-1j * gains - expected).abs().square()
    size = expected.abs().square()
    # Noise 40 dB down is a hundredth in amplitude and 1e-4 in energy, of which the modes catch a part.
    assert float(error.sum() / size.sum()) < 1e-3


def test_the_example_is_small_and_whole() -> None:
    views = read_views(EXAMPLE_FOLDER)
    assert len(views) == EXAMPLE.views
    assert all(view.mask is not None and bool(view.mask.any()) for view in views)
    assert sum(path.stat().st_size for path in EXAMPLE_FOLDER.rglob("*") if path.is_file()) < 5e6  # bytes
    assert torch.isfinite(read_capture(EXAMPLE_FOLDER).impacts.sounds).all()


def test_the_example_shows_its_shape_in_photographs_alone() -> None:
    assert read_capture(EXAMPLE_FOLDER).surface is None
    shape = example_mesh().surface
    contacts = read_truth(EXAMPLE_FOLDER).contacts
    nearest = ClosestPoints(shape.vertices.double().numpy()[shape.faces.numpy()])
    assert float(nearest(contacts.numpy()).distances.max()) < 1e-6  # meters
    for view in read_views(EXAMPLE_FOLDER)[::12]:
        assert view.mask is not None
        depth = MeshTracer(shape).depth(view.camera)
        # Masks are smooth at outlines: a pixel there may be on either side.
        assert float((torch.isfinite(depth) != (view.mask > 127)).float().mean()) < 0.005
