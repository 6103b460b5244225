"""DINOv2 through transformers (extra `vision`): by name, from the hub or its cache, or from a local folder."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional

from avmsf._utils.hub import HUB_SECONDS, read_settings, why_not
from avmsf.errors import SceneError
from avmsf.features.encoder import unit_image

MODELS: Final = tuple(
    f"facebook/dinov2{registers}-{size}" for registers in ("", "-with-registers") for size in ("small", "base", "large")
)
"""Names under which the hub has them; small, base and large give 384, 768 and 1024 features."""
IMAGENET_MEAN: Final = (0.485, 0.456, 0.406)
IMAGENET_DEVIATION: Final = (0.229, 0.224, 0.225)
_FILES = _CONFIG, _WEIGHTS, _PREPROCESSOR = "config.json", "model.safetensors", "preprocessor_config.json"


class DinoEncoder:
    """A DINOv2 model, with or without registers, as an encoder: its patches' last hidden states.

    The image is brought to `longest` pixels on its longer side, continued by its last row and column to whole patches,
    and the class and register tokens are dropped. Where the image ends inside a patch the tokens are interpolated at
    the middles of equal cells of the image, so that the map covers the image alone.
    """

    def __init__(
        self,
        model: nn.Module,
        *,
        name: str,
        longest: int | None = 518,
        mean: Sequence[float] = IMAGENET_MEAN,
        deviation: Sequence[float] = IMAGENET_DEVIATION,
    ) -> None:
        """Wrap a transformers model on whatever device and in whatever precision it is.

        `longest`, pixels, is the resolution encoded, None for each image's own; `mean` and `deviation` are what the
        model was trained to have colors normalized with.
        """
        if longest is not None and longest < 1:
            raise SceneError.expected("the pixels of the longer side, such as 518", longest, name="longest")
        self.model, self.name, self.longest = model.eval().requires_grad_(False), name, longest
        self._mean, self._deviation = torch.tensor(mean), torch.tensor(deviation)

    @classmethod
    def load(
        cls,
        source: str | Path,
        *,
        longest: int | None = 518,
        device: str | torch.device = "cpu",
    ) -> "DinoEncoder":
        """Load a model of the hub (one of `MODELS`), or a folder with config.json and model.safetensors.

        It computes in float32, so that features differ between devices by rounding only; by PyTorch's default a GPU
        rounds the factors of the first layer to TF32. Raises SceneError where transformers is missing, where the model
        is neither here nor to be downloaded, and for a folder that holds another model or a part of one.
        """
        folder, name = _model_folder(source)
        model = _load_model(folder, torch.device(device))
        mean, deviation = _constants(folder / _PREPROCESSOR)
        return cls(model, name=name, longest=longest, mean=mean, deviation=deviation)

    def describe(
        self, image: UInt8[Tensor, "height width 3"] | Float[Tensor, "height width 3"]
    ) -> Float[Tensor, "dim rows columns"]:
        """Return the patches' features, float32, on a grid that covers the image evenly."""
        color = unit_image(image).permute(2, 0, 1)
        height, width = self._size(color.shape[1], color.shape[2])
        color = functional.interpolate(
            color[None], (height, width), mode="bicubic", align_corners=False, antialias=True
        ).clamp(0.0, 1.0)
        color = (color - self._mean.to(color)[:, None, None]) / self._deviation.to(color)[:, None, None]
        patch = int(self.model.config.patch_size)  # type: ignore[union-attr,arg-type]
        rows, columns = -(-height // patch), -(-width // patch)
        color = functional.pad(color, (0, columns * patch - width, 0, rows * patch - height), mode="replicate")
        weights = next(self.model.parameters())
        with torch.no_grad():
            tokens = self.model(pixel_values=color.to(weights)).last_hidden_state[0].float()
        tokens = tokens[len(tokens) - rows * columns :].T.reshape(-1, rows, columns)
        down, across = _interpolation(height, patch).to(tokens), _interpolation(width, patch).to(tokens)
        return (down @ tokens @ across.T).to(image.device)

    def _size(self, height: int, width: int) -> tuple[int, int]:
        if self.longest is None:
            return height, width
        factor = self.longest / max(height, width)
        return max(1, round(height * factor)), max(1, round(width * factor))


def _interpolation(length: int, patch: int) -> Float[Tensor, "cells patches"]:
    """Return what interpolates linearly from patches' centers to those of as many equal cells of `length` pixels.

    The identity where the patches end with the image.
    """
    count = -(-length // patch)
    places = (torch.arange(count, dtype=torch.float64) + 0.5) * length / count / patch - 0.5
    places = places.clamp(0.0, count - 1.0)
    return (1 - (places[:, None] - torch.arange(count)).abs()).clamp(min=0.0)


def _model_folder(source: str | Path) -> tuple[Path, str]:
    """Return the folder that holds a model, downloaded where that is needed, and the name of its features."""
    folder, name = Path(source).expanduser(), str(source)
    if folder.is_dir():
        return folder, f"DINOv2 from the folder {folder.resolve().name}"
    if name not in MODELS:
        wanted, got = f"a folder with {_CONFIG} and {_WEIGHTS}, or one of {', '.join(MODELS)}", "no such folder"
        raise SceneError.expected(wanted, name, got=got, name="encoder", file=folder, advice="check the path")
    _transformers()
    from huggingface_hub import snapshot_download, try_to_load_from_cache

    cached = [try_to_load_from_cache(name, file) for file in _FILES]
    if all(isinstance(path, str) for path in cached):
        return Path(str(cached[0])).parent, name
    try:
        return Path(snapshot_download(name, allow_patterns=list(_FILES), etag_timeout=HUB_SECONDS)), name
    except Exception as error:  # the hub's client raises whatever the network beneath it does
        got = f"none: they could not be downloaded ({why_not(error)})"
        advice = (
            f"save {', '.join(_FILES)} from https://huggingface.co/{name}/tree/main in one FOLDER and use "
            "--lift.encoder FOLDER, or use --lift.encoder descriptors, which needs no download"
        )
        raise SceneError.expected(f"the weights of {name}", name, got=got, name="encoder", advice=advice) from error


def _load_model(folder: Path, device: torch.device) -> nn.Module:
    transformers = _transformers()
    lacking = [name for name in (_CONFIG, _WEIGHTS) if not (folder / name).is_file()]
    advice = f"copy {', '.join(_FILES)} of one model such as {MODELS[0]} there"
    if lacking:
        got = f"no {' and no '.join(lacking)}"
        raise SceneError.expected("a DINOv2 model", got=got, file=folder, name=lacking[0], advice=advice)
    kind = read_settings(folder / _CONFIG, raising=SceneError).get("model_type")
    classes = {"dinov2": "Dinov2Model", "dinov2_with_registers": "Dinov2WithRegistersModel"}
    if kind not in classes:
        raise SceneError.expected(
            f"a model of type {' or '.join(classes)}", kind, file=folder / _CONFIG, name="model_type"
        )
    try:
        model, report = getattr(transformers, classes[kind]).from_pretrained(
            folder, local_files_only=True, use_safetensors=True, dtype=torch.float32, output_loading_info=True
        )
    except Exception as error:  # whatever is wrong with the file, transformers and safetensors have their own errors
        got = f"a file that cannot be loaded ({error})"
        raise SceneError.expected("the model's weights", got=got, file=folder / _WEIGHTS, advice=advice) from error
    # The mask token is for training alone. Any other weight would be left random.
    missing = sorted(name for name in report["missing_keys"] if not name.endswith("mask_token"))
    if missing:
        got = f"{len(missing)} fewer, without {missing[0]}"
        raise SceneError.expected(
            "all of the model's weights", len(missing), got=got, file=folder / _WEIGHTS, name=missing[0], advice=advice
        )
    return model.to(device)


def _constants(path: Path) -> tuple[Sequence[float], Sequence[float]]:
    """Return the mean and standard deviation of colors in a preprocessor's file, ImageNet's without one."""
    if not path.is_file():
        return IMAGENET_MEAN, IMAGENET_DEVIATION
    record = read_settings(path, raising=SceneError)
    found = record.get("image_mean", list(IMAGENET_MEAN)), record.get("image_std", list(IMAGENET_DEVIATION))
    numbers = [number for each in found if isinstance(each, list) and len(each) == 3 for number in each]
    if len(numbers) != 6 or not all(isinstance(each, float | int) for each in numbers):
        raise SceneError.expected(
            "image_mean and image_std of three numbers", found, file=path, name="image_mean", advice="copy it again"
        )
    return found


def _transformers() -> Any:
    try:
        import transformers
        from transformers import Dinov2Model, Dinov2WithRegistersModel  # noqa: F401
    except (ImportError, RuntimeError) as error:  # RuntimeError: one of its own optional packages is broken
        wanted, got = "the package transformers for DINOv2", f"an import error ({error})"
        advice = "pip install 'avmsf[vision]', or use --lift.encoder descriptors"
        raise SceneError.expected(wanted, got=got, name="transformers", advice=advice) from error
    return transformers
