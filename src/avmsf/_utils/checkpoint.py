"""The state of work that may be interrupted, in a file from which the same work goes on."""

import io
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from avmsf._utils.files import write_whole
from avmsf.errors import AvmsfError, AvmsfWarning

SAVE_SECONDS = 30.0
"""Time between two savings: what a killed process loses at most."""


class Checkpoint:
    """A file that holds a state, tensors, numbers, text and containers of these, and what work it belongs to."""

    def __init__(
        self, path: str | Path | None, identity: Mapping[str, str], *, what: str, raising: type[AvmsfError]
    ) -> None:
        """`identity` is a digest of each thing that decides the result, by what errors call it; `what` the work.

        Without a path nothing is saved. `raising` is the class of errors.
        """
        self.path, self.identity = None if path is None else Path(path), dict(identity)
        self.what, self.raising = what, raising
        self.saved_at = time.monotonic()

    @property
    def due(self) -> bool:
        """Whether the last saving is so long ago that it is time for another."""
        return self.path is not None and time.monotonic() - self.saved_at > SAVE_SECONDS

    def save(self, state: Mapping[str, Any]) -> None:
        """Write a state, whole or not at all. Warns where it cannot be written: that costs the state, not the work."""
        if self.path is None:
            return
        # By way of memory: torch's own writer reports a full disk as a RuntimeError of its archive format.
        content = io.BytesIO()
        torch.save({"identity": self.identity, "state": dict(state)}, content)
        try:
            write_whole(self.path, content.getvalue(), raising=self.raising)
        except AvmsfError as error:
            message = f"{error}; {self.what} continues without a new checkpoint"
            warnings.warn(AvmsfWarning(message, **error.attributes), stacklevel=3)
        self.saved_at = time.monotonic()

    def read(self) -> dict[str, Any] | None:
        """Return the state, None where there is none.

        Raises the class of errors for a file that is no checkpoint of this work, and for one of another identity.
        """
        if self.path is None or not self.path.exists():
            return None
        try:
            content = torch.load(self.path, weights_only=True, map_location="cpu")
            state, found, mine = content["state"], content["identity"], self.identity
            other = sorted(name for name in mine.keys() | found.keys() if mine.get(name) != found.get(name))
        # torch.load raises whatever unpacking raises, with the advice to trust the file.
        except Exception as error:
            wanted, advice = f"a checkpoint of {self.what}", "delete it or name another"
            raise self.raising.expected(
                wanted, got="another or a damaged file", file=self.path, advice=advice
            ) from error
        if other:
            wanted = f"a checkpoint of {self.what} with the same {' and '.join(other)}"
            advice = "delete it to start again, or repeat its arguments to continue it"
            raise self.raising.expected(wanted, other, got="another", file=self.path, advice=advice)
        return dict(state)
