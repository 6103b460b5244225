"""Descents of minutes: what the page asks for, the worker's task, and what may be made of the result."""

import base64
import binascii
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from avmsf.errors import EditError
from avmsf.studio.refusal import RefusedError
from avmsf.tasks.stableaudiofiles import STABLE_AUDIO

_KEYS = ("base", "like", "prompt")


@dataclass(frozen=True)
class Wish:
    """Where a field shall be led: towards a recording, or towards words."""

    like: bytes | None = None
    """A sound file."""
    prompt: str | None = None

    @classmethod
    def read(cls, words: Mapping[str, Any], *, model: str | None) -> "Wish":
        """Return the wish of a request. Raises RefusedError (400), and EditError for words without a `model`."""
        unknown = sorted(set(words) - set(_KEYS))
        if unknown:
            raise RefusedError(
                400,
                f"expected {', '.join(_KEYS)} alone, found {', '.join(unknown)} too: set the sliders before or after",
            )
        like, prompt = words.get("like"), words.get("prompt")
        if like is not None and prompt is not None:
            raise RefusedError(400, "expected a recording or words to lead the sound towards, found both: choose one")
        if like is not None:
            return cls(like=_unpacked(like))
        if model is None:
            raise EditError(
                "editing by words needs the extra and the model: pip install 'avmsf[text]' and start avmsf studio with "
                "--model FOLDER"
            )
        if not isinstance(prompt, str) or not prompt.strip():
            raise RefusedError(400, 'prompt: expected a description such as "a wooden bowl is hit", found none')
        return cls(prompt=prompt)

    def task(self, place: Path, *, steps: int, model: str | None) -> dict[str, Any]:
        """Return the worker's task, whose files lie in `place`; the field is to be written there as `field`."""
        task = {"task": "lead", "field": str(place / "field"), "output": str(place / "led"), "steps": steps}
        if self.like is None:
            return {**task, "prompt": self.prompt, "model": model}
        (place / "like.wav").write_bytes(self.like)
        return {**task, "recording": str(place / "like.wav")}


def is_wish(words: Mapping[str, Any]) -> bool:
    """Whether an edit asks for a descent and not for sliders."""
    return words.get("like") is not None or words.get("prompt") is not None


def words_model(given: str | None) -> str | None:
    """Return the model for edits by words: the given one, that of the hub's cache, or None where none can be used."""
    if any(find_spec(name) is None for name in ("diffusers", "torchsde", "transformers")):
        return None
    if given is not None:
        return given
    from huggingface_hub import try_to_load_from_cache

    return STABLE_AUDIO if isinstance(try_to_load_from_cache(STABLE_AUDIO, "model_index.json"), str) else None


def _unpacked(text: Any) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except (TypeError, ValueError, binascii.Error) as error:
        raise RefusedError(400, "like: expected a recording as base64, found what is none: reload the page") from error
