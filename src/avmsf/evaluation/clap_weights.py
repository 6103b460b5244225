"""CLAP's weights, from the hub or its cache, or a local folder; other models are reported by name."""

import hashlib
from pathlib import Path
from typing import Any, Final

from torch import nn

from avmsf._utils.hub import HUB_SECONDS, is_hub_name, read_settings, why_not
from avmsf.errors import EvaluationError

MODELS: Final = ("laion/clap-htsat-unfused", "laion/clap-htsat-fused", "laion/larger_clap_general")
"""Names under which the hub has networks that fit."""
_CONFIG, _EXTRACTOR = "config.json", "preprocessor_config.json"
_EXTRACTORS = (_EXTRACTOR, "processor_config.json")
"""Either holds the feature extractor's settings; which one depends on the transformers that wrote the folder."""
_WEIGHTS = ("model.safetensors", "pytorch_model.bin")
"""Either will do."""


def find_clap(source: str | Path) -> Path:
    """Return the folder that holds a network: `source` itself, or what the hub has under this name.

    Raises EvaluationError where there is no such folder or model, and where it cannot be downloaded.
    """
    folder = Path(source).expanduser()
    if folder.is_dir():
        return folder
    name = str(source)
    if not is_hub_name(source):
        raise EvaluationError.expected(
            f"a folder with a CLAP model, or a name such as {', '.join(MODELS)}",
            name,
            got="no such folder",
            file=folder,
            name="source",
            advice="check the path",
        )
    return _from_hub(name)


def transformers_clap(folder: Path) -> tuple[nn.Module, Any, str]:
    """Load a folder's `ClapModel` and `ClapProcessor`; return them and a digest of what decides embeddings.

    Raises EvaluationError where transformers is missing, and for a folder that holds another model or a part of one.
    """
    transformers = _transformers()
    weights = _expect_clap(folder)
    try:
        model, report = transformers.ClapModel.from_pretrained(folder, local_files_only=True, output_loading_info=True)
        processor = transformers.ClapProcessor.from_pretrained(folder, local_files_only=True)
    except Exception as error:  # whatever is wrong with a file, transformers and safetensors have their own errors
        raise EvaluationError(
            f"{folder}: expected a CLAP model, got files that cannot be loaded ({error}); copy them again", file=folder
        ) from error
    # Any weight that is not there would be left random.
    missing = sorted(name for name in report["missing_keys"] if not name.endswith("position_ids"))
    if missing:
        raise EvaluationError(
            f"{weights}: expected all weights of the model, {len(missing)} are missing such as {missing[0]}; copy it "
            f"and {_CONFIG} from one model",
            file=weights,
            name="weights",
            value=tuple(missing),
        )
    digest = hashlib.sha256()
    for path in (folder / _CONFIG, *(folder / name for name in _EXTRACTORS if (folder / name).is_file()), weights):
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return model, processor, digest.hexdigest()


def _expect_clap(folder: Path) -> Path:
    """Return the file of a folder's weights. Raises EvaluationError unless it holds a CLAP model."""
    if (folder / "model_index.json").is_file():
        kind = read_settings(folder / "model_index.json", raising=EvaluationError).get("_class_name")
        raise EvaluationError(
            f"{folder}: expected a CLAP model, got a pipeline of diffusers, {kind}; give a model such as {MODELS[0]}",
            file=folder,
            name="_class_name",
            value=kind,
        )
    lacking = [] if (folder / _CONFIG).is_file() else [_CONFIG]
    if not lacking:
        kind = read_settings(folder / _CONFIG, raising=EvaluationError).get("model_type")
        if kind != "clap":
            raise EvaluationError.expected(
                "a model of type 'clap' (ClapModel)", kind, file=folder / _CONFIG, name="model_type"
            )
    lacking += [
        " or ".join(each) for each in (_EXTRACTORS, _WEIGHTS) if not any((folder / name).is_file() for name in each)
    ]
    if lacking:
        raise EvaluationError.expected(
            "a CLAP model",
            tuple(lacking),
            got=f"none of its {' and '.join(lacking)}",
            file=folder,
            advice=_how_to_download(MODELS[0]),
        )
    return next(folder / name for name in _WEIGHTS if (folder / name).is_file())


def _from_hub(name: str) -> Path:
    """Return the folder of a model in the hub's cache, after downloading it where it is not there."""
    _transformers()
    from huggingface_hub import snapshot_download

    settings = ["*.json", "*.txt"]
    try:
        kept = Path(snapshot_download(name, allow_patterns=settings, local_files_only=True))
        if any((kept / weights).is_file() for weights in _WEIGHTS):
            return kept
    except Exception:  # not in the cache: the hub's client has an error of its own for each way of not being there
        pass
    try:
        for weights in _WEIGHTS:
            folder = Path(snapshot_download(name, allow_patterns=[*settings, weights], etag_timeout=HUB_SECONDS))
            if (folder / weights).is_file():
                return folder
        raise FileNotFoundError(f"no {' and no '.join(_WEIGHTS)}")
    except Exception as error:  # the hub's client raises whatever the network beneath it does
        raise EvaluationError(
            f"{name}: expected its weights, got none: they could not be downloaded ({why_not(error)}); "
            f"{_how_to_download(name)}",
            name="source",
            value=name,
        ) from error


def _how_to_download(name: str) -> str:
    return (
        f"on a computer with a network run hf download {name} --local-dir FOLDER, copy FOLDER here, and give its path"
    )


def _transformers() -> Any:
    try:
        import transformers
        from transformers import ClapModel, ClapProcessor  # noqa: F401
    except (ImportError, RuntimeError) as error:  # RuntimeError: one of its own optional packages is broken
        raise EvaluationError(
            f"CLAP score: expected the package transformers, got {error}; pip install 'avmsf[eval]'",
            name="transformers",
        ) from error
    return transformers
