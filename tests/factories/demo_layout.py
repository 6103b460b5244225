"""The arrays of a folder in the layout of the paper's demo, by its manifest."""

import json
import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor


def read_arrays(folder: Path) -> dict[str, Tensor]:
    """Return the arrays that a manifest places in its file by offset, type and shape."""
    manifest = json.loads((folder / "manifest.json").read_text())
    content = (folder / manifest["file"]).read_bytes()
    return {
        name: torch.from_numpy(
            np.frombuffer(content, record["dtype"], math.prod(record["shape"]), record["offset"])
            .reshape(record["shape"])
            .copy()
        )
        for name, record in manifest["arrays"].items()
    }
