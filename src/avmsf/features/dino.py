"""DINOv2 through transformers (extra `vision`): by name, from the hub or its cache, or from a local folder."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from avmsf._utils.text import read_json_object
from avmsf.errors import SceneError, download_failure, from_extra
from avmsf.features.encoder import PatchEncoder

MODELS: Final = tuple(
    f"facebook/dinov2{registers}-{size}" for registers in ("", "-with-registers") for size in ("small", "base", "large")
)
"""Names under which the hub has them; small, base and large give 384, 768 and 1024 features."""
IMAGENET: Final = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
"""Mean and standard deviation of the colors that a model was trained with, where its files do not say."""
_FILES = _CONFIG, _WEIGHTS, _PREPROCESSOR = "config.json", "model.safetensors", "preprocessor_config.json"


@dataclass(frozen=True, eq=False)
class DinoEncoder(PatchEncoder):
    """A DINOv2 model, with or without registers, as an encoder: its patches' last hidden states.

    The class and register tokens are dropped.
    """

    @classmethod
    def load(
        cls, source: str | Path, *, longest: int | None = 518, device: str | torch.device = "cpu"
    ) -> "DinoEncoder":
        """Load a model of the hub (one of `MODELS`), or a folder with config.json and model.safetensors.

        It computes in float32, so that features differ between devices by rounding only; by PyTorch's default a GPU
        rounds the factors of the first layer to TF32. Raises SceneError where transformers is missing, where the model
        is neither here nor to be downloaded, and for a folder that holds another model or a part of one.
        """
        if longest is not None and longest < 1:
            raise SceneError.expected("the pixels of the longer side, such as 518", longest, name="longest")
        folder, name = Path(source).expanduser(), str(source)
        if folder.is_dir():
            name = f"DINOv2 from the folder {folder.resolve().name}"
        else:
            folder = _download(name)
        model = _load_model(folder).to(device)
        patch = int(model.config.patch_size)  # type: ignore[union-attr,arg-type]
        return cls(model, name, longest, patch, *_read_normalization(folder / _PREPROCESSOR))

    def tokens(self, color: Float[Tensor, "1 3 pixel_rows pixel_columns"]) -> Float[Tensor, "dim rows columns"]:
        """Return the patches' last hidden states."""
        states = self.model(pixel_values=color).last_hidden_state[0]
        rows, columns = (side // self.patch for side in color.shape[2:])
        return states[len(states) - rows * columns :].T.reshape(-1, rows, columns)


def _download(name: str) -> Path:
    """Return the folder in the hub's cache that holds a model of this name, downloaded where it is not there."""
    if name not in MODELS:
        wanted, got = f"a folder with {_CONFIG} and {_WEIGHTS}, or one of {', '.join(MODELS)}", "no such folder"
        raise SceneError.expected(wanted, name, got=got, name="encoder", file=name, advice="check the path")
    _model_classes()
    from huggingface_hub import snapshot_download, try_to_load_from_cache

    cached = [try_to_load_from_cache(name, file) for file in _FILES]
    if all(isinstance(path, str) for path in cached):
        return Path(str(cached[0])).parent
    try:
        return Path(snapshot_download(name, allow_patterns=list(_FILES), etag_timeout=5.0))
    except Exception as error:  # the hub's client raises whatever the network beneath it does
        got = f"none: they could not be downloaded ({download_failure(error)})"
        advice = (
            f"save {', '.join(_FILES)} from https://huggingface.co/{name}/tree/main in one FOLDER and use "
            "--set lift.encoder=FOLDER, or lift.encoder=descriptors, which needs no download"
        )
        raise SceneError.expected(f"the weights of {name}", name, got=got, name="encoder", advice=advice) from error


def _load_model(folder: Path) -> nn.Module:
    classes, weights = _model_classes(), folder / _WEIGHTS
    advice = f"copy {', '.join(_FILES)} of one model such as {MODELS[0]} there"
    for name in (_CONFIG, _WEIGHTS):
        if not (folder / name).is_file():
            raise SceneError.expected("a DINOv2 model", got=f"no {name}", file=folder, name=name, advice=advice)
    kind = read_json_object(folder / _CONFIG, raising=SceneError).get("model_type")
    if kind not in list(classes):
        wanted = f"a model of type {' or '.join(classes)}"
        raise SceneError.expected(wanted, kind, file=folder / _CONFIG, name="model_type")
    try:
        model, report = classes[kind].from_pretrained(
            folder, local_files_only=True, use_safetensors=True, dtype=torch.float32, output_loading_info=True
        )
    except Exception as error:  # whatever is wrong with the file, transformers and safetensors have their own errors
        got = f"a file that cannot be loaded ({error})"
        raise SceneError.expected("the model's weights", got=got, file=weights, advice=advice) from error
    # The mask token is for training alone. Any other weight would be left random.
    missing = sorted(name for name in report["missing_keys"] if not name.endswith("mask_token"))
    if missing:
        wanted, got = "all of the model's weights", f"{len(missing)} fewer, without {missing[0]}"
        raise SceneError.expected(wanted, len(missing), got=got, file=weights, name=missing[0], advice=advice)
    return model


def _read_normalization(path: Path) -> list[Float[Tensor, "3 1 1"]]:
    """Return the mean and standard deviation of colors in a preprocessor's file, ImageNet's without one."""
    record = IMAGENET | (read_json_object(path, raising=SceneError) if path.is_file() else {})
    found = [record[name] for name in IMAGENET]
    try:
        return [torch.tensor(values, dtype=torch.float32).reshape(3, 1, 1) for values in found]
    except (TypeError, ValueError, RuntimeError) as error:
        wanted = "image_mean and image_std of three numbers"
        raise SceneError.expected(wanted, found, file=path, name="image_mean", advice="copy it again") from error


def _model_classes() -> dict[str, Any]:
    """Return the classes of transformers by the type of model in their settings."""
    with from_extra("vision", "transformers", raising=SceneError, instead="use --set lift.encoder=descriptors"):
        from transformers import Dinov2Model, Dinov2WithRegistersModel
    return {"dinov2": Dinov2Model, "dinov2_with_registers": Dinov2WithRegistersModel}
