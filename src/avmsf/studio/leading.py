"""Descents of minutes: what the page asks for, the worker's task, and what may be made of the result."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from avmsf.editing.config import STABLE_AUDIO
from avmsf.errors import EditError
from avmsf.studio.refusal import RefusedError, bad_request, echo

_KEYS = ("base", "prompt")
_MAX_PROMPT = 2000
"""Characters, several paragraphs: a description of a sound is a sentence."""


@dataclass(frozen=True)
class Wish:
    """Target of a guided edit: a recording or a text."""

    like: bytes | None = None
    """A sound file."""
    prompt: str | None = None

    @classmethod
    def read(cls, words: Mapping[str, Any], *, model: str | None) -> "Wish":
        """Return the target of a request with a text. Raises RefusedError (400), and EditError without a `model`."""
        unknown = sorted(set(words) - set(_KEYS))
        if unknown:
            raise RefusedError(
                400,
                f"expected only {', '.join(_KEYS)}, got {echo(unknown)} too; set the sliders before or after",
                name="prompt",
                value=unknown,
            )
        if model is None:
            raise EditError(
                "expected the extra and the model for edits by text, got none; pip install 'avmsf[text]' and start "
                "avmsf studio with --model FOLDER",
                name="model",
            )
        prompt = words.get("prompt")
        if not isinstance(prompt, str) or not prompt.strip() or len(prompt) > _MAX_PROMPT:
            raise bad_request("prompt", f'1 to {_MAX_PROMPT} characters, such as "a wooden bowl is hit"', prompt)
        return cls(prompt=prompt)

    def task(self, place: Path, *, steps: int, model: str | None) -> dict[str, Any]:
        """Return the worker's task, with its files in `place`; the edited field is written there as `field`."""
        task = {"task": "lead", "field": str(place / "field"), "output": str(place / "led"), "steps": steps}
        if self.like is None:
            return {**task, "prompt": self.prompt, "model": model}
        (place / "like.wav").write_bytes(self.like)
        return {**task, "recording": str(place / "like.wav")}


def is_wish(words: Mapping[str, Any]) -> bool:
    """Whether an edit asks for a descent and not for sliders."""
    return words.get("prompt") is not None


def words_model(given: str | None) -> str | None:
    """Return the model for text edits: the given one, or that in the hub's cache; None if there is none."""
    if any(find_spec(name) is None for name in ("diffusers", "torchsde", "transformers")):
        return None
    if given is not None:
        return given
    from huggingface_hub import try_to_load_from_cache

    return STABLE_AUDIO if isinstance(try_to_load_from_cache(STABLE_AUDIO, "model_index.json"), str) else None
