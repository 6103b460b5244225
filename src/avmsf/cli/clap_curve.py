"""CLAP scores of an edit's previews, for `avmsf edit --clap`: stored next to the output for its continuation."""

import json
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf._utils.text_files import read_json
from avmsf.editing.guided import GuidedEditProgress
from avmsf.errors import EditError
from avmsf.evaluation.clap import Clap
from avmsf.field.sound_field import SoundField

CLAP = "clap"
"""The key of the scores in the last edit of a field's report."""


class ClapCurve:
    """The CLAP score of a field's sound at one contact over the steps of an edit; step 0 is the unedited field."""

    def __init__(self, clap: Clap, prompt: str, field: SoundField, kept: Path, *, resumed: bool) -> None:
        """Start a curve, or with `resumed` continue that of the file `kept`.

        Raises EditError for a file that is damaged or has scores of another network.
        """
        self.clap, self.prompt, self.field, self.kept = clap, prompt, field, kept
        self.scores = _read(kept, clap) if resumed and kept.is_file() else {}

    def add(self, progress: GuidedEditProgress) -> None:
        """Score a preview, and the unedited field before the first one. Silent sounds have no score."""
        if progress.preview is None or progress.place is None:
            return
        if not self.scores:
            self._score(0, self.field.render(progress.place[None])[0])
        self._score(progress.step, progress.preview)
        text = json.dumps({"digest": self.clap.digest, "scores": list(self.scores.items())})
        write_whole(self.kept, lambda path: path.write_text(text, encoding="utf-8"), raising=EditError)

    def record(self) -> dict[str, Any]:
        """Return the steps and scores as plain values."""
        return {"model": self.clap.name, "steps": [*self.scores], "scores": [*self.scores.values()]}

    def _score(self, step: int, sound: Float[Tensor, " samples"]) -> None:
        if bool(sound.any()):
            self.scores[step] = float(self.clap.score(sound[None], [self.prompt], sample_rate=self.field.sample_rate))


def _read(path: Path, clap: Clap) -> dict[int, float]:
    try:
        read = read_json(path)
        scores = {int(step): float(score) for step, score in read["scores"]}
        digest = read["digest"]
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise EditError(f"{path}: expected CLAP scores, got {error}; delete the file to continue", file=path) from error
    if digest != clap.digest:
        raise EditError(
            f"{path}: expected scores of {clap.name}, got those of another network; give that network",
            file=path,
            name="digest",
            value=digest,
        )
    return scores
