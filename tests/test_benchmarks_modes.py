"""How the benchmarks count modes, and what they count in measured data."""

import sys
from pathlib import Path

import pytest
import torch

# The benchmarks are no part of the package, and `python -m benchmarks` finds them from the repository's root alone.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from avmsf.capture import CaptureSettings, read_capture
from avmsf.modal.extraction.extract import extract_modes
from benchmarks.modes import AIRCRAFT, LEAST_SHARE, ModeCount, count_modes, match_modes, tree_frequencies


def test_modes_are_matched_one_to_one_and_others_counted_by_energy() -> None:
    frequency = torch.tensor([99.9, 100.2, 150.0, 160.0, 200.1, 300.0], dtype=torch.float64)
    share = torch.tensor([0.3, 0.2, 0.2, 0.001, 0.2, 0.099], dtype=torch.float64)
    # 99.9 alone is 100; 100.2, 150 and 160 lie between 100 and 200, 300 does not.
    assert match_modes(frequency, share, [100.0, 200.0]) == ModeCount(2, 3)
    assert match_modes(frequency, share, [100.0, 200.0], least_share=0.01) == ModeCount(2, 2)
    assert match_modes(frequency, share, [100.0, 100.1, 200.0], least_share=0.01) == ModeCount(3, 1)
    assert match_modes(frequency, share, [100.0, 180.0, 200.0], least_share=0.01) == ModeCount(2, 2)


@pytest.mark.slow
def test_the_aircrafts_thirteen_modes_are_found_and_hardly_any_other(shared: Path) -> None:
    impacts = read_capture(shared / "aircraft_response").impacts
    counted = count_modes(impacts, extract_modes(impacts), AIRCRAFT, least_share=LEAST_SHARE)
    assert counted.found == 13
    assert counted.extra <= 4


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*at one and the same contact")
def test_the_trees_modes_are_found_and_no_other(shared: Path) -> None:
    impacts = read_capture(shared / "tree43", CaptureSettings(align=False)).impacts
    assert count_modes(impacts, extract_modes(impacts), tree_frequencies()) == ModeCount(24, 0)
