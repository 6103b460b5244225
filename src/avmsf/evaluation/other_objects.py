"""The recording of another object, which says how much it takes to tell this object from any other."""

import zlib
from fractions import Fraction

import numpy as np
import torch
from jaxtyping import Float
from scipy.signal import resample_poly
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.datasets.dataset import Dataset
from avmsf.errors import AvmsfError, EvaluationError


def draw_stranger(dataset: Dataset, identifier: str, train: Impacts, *, seed: int) -> Float[Tensor, " samples"]:
    """Return a recording of another object of the dataset, at the rate and of the length of `train`.

    The draw depends on the seed and the object alone. Objects that cannot be read are passed over. Shorter recordings
    end in silence, longer ones are cut. Raises EvaluationError where there is no other object.
    """
    others = [other for other in dataset.objects() if other != identifier]
    generator = torch.Generator().manual_seed(zlib.crc32(identifier.encode(), seed))
    for place in torch.randperm(len(others), generator=generator).tolist():
        try:
            impacts = dataset.capture(others[place]).impacts
        except AvmsfError:
            continue
        row = int(torch.randint(len(impacts), (), generator=generator))
        sound = _at_rate(impacts.sounds[row], impacts.sample_rate, train.sample_rate)
        samples = train.sounds.shape[1]
        return torch.nn.functional.pad(sound, (0, max(0, samples - len(sound))))[:samples].to(train.sounds.dtype)
    raise EvaluationError.expected(
        f"another readable object in {dataset.name}", name=identifier, advice="download more of the dataset"
    )


def _at_rate(sound: Float[Tensor, " samples"], found: float, wanted: float) -> Float[Tensor, " resampled"]:
    if found == wanted:
        return sound
    ratio = Fraction(wanted).limit_denominator(1000) / Fraction(found).limit_denominator(1000)
    ratio = ratio.limit_denominator(1000)
    resampled = resample_poly(sound.double().numpy(), ratio.numerator, ratio.denominator)
    return torch.from_numpy(resampled.astype(np.float32))
