"""Stable Audio's weights: a folder, the hub's cache, or the hub."""

import hashlib
import json
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import torch
from torch import nn

from avmsf._utils.hub import is_hub_name, read_settings, why_not
from avmsf.editing.config import STABLE_AUDIO
from avmsf.errors import EditError

_CLASS, _INDEX = "StableAudioPipeline", "model_index.json"
_NETWORKS: Final = ("vae", "text_encoder", "projection_model", "transformer")
_PARTS: Final = (*_NETWORKS, "tokenizer", "scheduler")
_PRECONDITIONING: Final = ("precondition_inputs", "precondition_noise", "precondition_outputs")
_SAMPLED = 64
"""Numbers of each weight that a digest looks at, evenly spaced."""
_ON_SAVING: Final = ("architectures", "dtype", "torch_dtype", "transformers_version")
"""Settings that transformers adds when it saves: they say nothing that the weights do not."""


def load_pipeline(source: str | Path, dtype: torch.dtype) -> tuple[Any, str]:
    """Return a `StableAudioPipeline` on the CPU and what it is to be called. Raises `EditError`.

    All but its autoencoder is in `dtype`: in bfloat16 a waveform would have eight bits.
    """
    kind = _pipeline_class()
    folder = Path(source).expanduser()
    named = not folder.is_dir()
    if named and not is_hub_name(source):
        raise EditError.expected(
            f"a folder with a {_CLASS}, or a name of the hub such as {STABLE_AUDIO}",
            str(source),
            got="no such folder",
            file=folder,
            name="source",
            advice="check the path",
        )
    name = str(source) if named else folder.resolve().name
    folder = _from_hub(kind, name) if named else folder
    _expect_pipeline(folder)
    try:
        with warnings.catch_warnings():
            # No user of this package can fix it.
            warnings.filterwarnings("ignore", message="`torch.nn.utils.weight_norm` is deprecated")
            pipeline = kind.from_pretrained(folder, local_files_only=True, use_safetensors=True)
    except Exception as error:  # whatever is wrong with the files, the libraries have their own errors
        raise EditError(
            f"{folder}: expected a {_CLASS}, got files that cannot be loaded ({error}); copy them again", file=folder
        ) from error
    for part in _NETWORKS:
        _expect_weights(folder / part, getattr(pipeline, part))
    for part in _NETWORKS:
        # By hand, for how a pipeline is told its precision changed between versions of diffusers.
        getattr(pipeline, part).to(torch.float32 if part == "vae" else dtype)
    lacking = [each for each in _PRECONDITIONING if not hasattr(pipeline.scheduler, each)]
    if lacking:
        raise EditError(
            f"{folder / 'scheduler'}: expected a scheduler of the EDM family, such as "
            f"CosineDPMSolverMultistepScheduler, got {type(pipeline.scheduler).__name__}; copy the files again",
            file=folder / "scheduler",
            name="scheduler",
            value=type(pipeline.scheduler).__name__,
        )
    return pipeline, name


def digest(pipeline: Any) -> str:
    """Return what tells a pipeline from others wherever its files are: of its settings and samples of its weights."""
    found = hashlib.sha256()
    for part in (*_NETWORKS, "scheduler"):
        config = getattr(pipeline, part).config
        settings = config if isinstance(config, dict) else config.to_dict()
        # Those that begin with an underscore name the folder and the libraries' versions.
        plain = {name: each for name, each in settings.items() if not name.startswith("_") and name not in _ON_SAVING}
        found.update(f"{part} {json.dumps(plain, sort_keys=True, default=str)}".encode())
    for part in _NETWORKS:
        for name, weight in getattr(pipeline, part).state_dict().items():
            rows = torch.linspace(0, weight.numel() - 1, min(weight.numel(), _SAMPLED), dtype=torch.float64).long()
            sampled = weight.flatten()[rows.to(weight.device)].cpu().double()
            found.update(f"{part} {name} {weight.dtype} {tuple(weight.shape)}".encode())
            found.update(sampled.numpy().tobytes())
    return found.hexdigest()


def _from_hub(kind: Any, name: str) -> Path:
    """Return the folder of a pipeline in the hub's cache, after downloading it where it is not there."""
    try:
        return Path(kind.download(name, local_files_only=True))
    except Exception:  # not there, or not whole; the client raises whatever it does
        pass
    try:
        return Path(kind.download(name))
    except Exception as error:  # the hub's client raises whatever the network beneath it does
        raise EditError(
            f"{name}: expected a model in the cache or one that can be downloaded, got neither ({why_not(error)}); "
            f"accept the license at https://huggingface.co/{name}, create a token at "
            "https://huggingface.co/settings/tokens and run hf auth login; or, on a computer with a network, run "
            f"hf download {name} --local-dir FOLDER --exclude 'model.*', copy FOLDER here and give its path",
            name="source",
            value=name,
        ) from error


def _expect_pipeline(folder: Path) -> None:
    """Raise `EditError` for a folder that holds another model or lacks a part."""
    index = folder / _INDEX
    if not index.is_file():
        found = sorted(each.name for each in folder.iterdir())
        raise EditError(
            f"{folder}: expected a {_CLASS} of diffusers, with {_INDEX} and the folders {', '.join(_PARTS)}, got "
            f"{', '.join(found[:6]) or 'an empty folder'}; give the folder of {_INDEX}",
            file=folder,
            name=_INDEX,
            value=tuple(found),
        )
    kind = read_settings(index, raising=EditError).get("_class_name")
    if kind != _CLASS:
        raise EditError(
            f"{folder}: expected a {_CLASS}, got {kind}; give the folder of a Stable Audio model",
            file=folder,
            name="_class_name",
            value=kind,
        )
    lacking = [part for part in _PARTS if not (folder / part).is_dir()]
    if lacking:
        raise EditError.expected(
            f"the folders {', '.join(_PARTS)}",
            tuple(lacking),
            got=f"no {', '.join(lacking)}",
            file=folder,
            name="parts",
            advice="copy them again",
        )
    bare = [part for part in _NETWORKS if not any((folder / part).glob("*.safetensors"))]
    if bare:
        raise EditError.expected(
            f"weights (*.safetensors) in {', '.join(bare)}",
            tuple(bare),
            got="none",
            file=folder,
            name="weights",
            advice=f"accept the license at https://huggingface.co/{STABLE_AUDIO}, run hf auth login and hf download "
            f"{STABLE_AUDIO} --local-dir {folder} --exclude 'model.*'",
        )


def _expect_weights(folder: Path, network: nn.Module) -> None:
    """Raise `EditError` where weights are missing in the files: they would have been left random."""
    from safetensors import safe_open

    there: set[str] = set()
    for path in sorted(folder.glob("*.safetensors")):
        with safe_open(path, framework="pt") as file:
            there |= set(file.keys())
    held = network.state_dict(keep_vars=True)
    stored = {held[name].data_ptr() for name in there & held.keys()}
    # What shares its memory with a weight that is there is another name of it.
    missing = sorted(name for name, weight in held.items() if name not in there and weight.data_ptr() not in stored)
    if missing:
        raise EditError(
            f"{folder}: expected all weights of the model, {len(missing)} are missing such as {missing[0]}; copy them "
            "and config.json from one model",
            file=folder,
            name="weights",
            value=tuple(missing),
        )


def _pipeline_class() -> Any:
    try:
        from diffusers import StableAudioPipeline

        if find_spec("torchsde") is None:  # the scheduler imports it late, and its error names no remedy
            raise ImportError("no module named 'torchsde'")
    except (ImportError, RuntimeError) as error:  # RuntimeError: one of its own optional packages is broken
        raise EditError(
            f"text prompts: expected the packages diffusers, transformers and torchsde, got {error}; "
            "pip install 'avmsf[text]', or edit towards a recording",
            name="diffusers",
        ) from error
    return StableAudioPipeline
