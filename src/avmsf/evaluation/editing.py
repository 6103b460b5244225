"""Evaluation of material edits: the paper's protocol, its baselines, and one without prompts (supplement).

An object of one material is edited towards another, by a prompt or by recordings of objects of that material. Scores
are the distance of its modes from those of labelled objects (`avmsf.evaluation.mode_embedding`), of its sounds from the
reference's, and, for prompts, the CLAP score; they are compared with those of the unedited object.
"""

import json
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from avmsf._utils.files import write_whole
from avmsf.editing.clips import lasting, level
from avmsf.editing.reference import Reference
from avmsf.errors import AvmsfWarning, CaptureError, EditError, EvaluationError, ExtractionError
from avmsf.evaluation.clap import Clap
from avmsf.evaluation.editing_methods import Edited, EditMethod
from avmsf.evaluation.editing_tasks import EditTask
from avmsf.evaluation.metrics import default_fft_sizes
from avmsf.evaluation.mode_embedding import MaterialSpace
from avmsf.modal.spectra import magnitude_stft


@dataclass(frozen=True)
class EditScore:
    """Scores of one method in one task."""

    method: str
    object: str
    source: str
    target: str
    prompt: str | None
    seed: int
    umap: Mapping[str, float]
    """Distance to the center of the target's cluster, by the names of the spaces; in UMAP's units."""
    octaves: Mapping[str, float]
    """The same without UMAP, in octaves."""
    spectral: float | None
    """Mean relative STFT error of the sounds from the nearest clip of the reference, at equal level."""
    clap: float | None
    """Mean cosine of the sounds and the prompt."""
    seconds: float
    """Time of the edit."""
    places: Mapping[str, tuple[float, float]]
    """Position of the modes in each space, by the names of the spaces; in UMAP's units."""
    clap_curve: tuple[tuple[int, float], ...] = ()
    """Steps of the edit and the CLAP score after each, at one contact; step 0 is the unedited object."""


def judge(
    tasks: Sequence[EditTask],
    methods: Sequence[EditMethod],
    spaces: Mapping[str, MaterialSpace],
    *,
    clap: Clap | None = None,
    progress: Callable[[EditScore], None] | None = None,
) -> tuple[EditScore, ...]:
    """Return every method's scores in every task. The time of fitting an object's field does not count.

    A sound without an impact or without modes, and a method that fails, have no score, and a warning says so: a
    generative model may return anything.
    """
    scores = []
    for task in tasks:
        _ = task.object.sound_field
        for method in methods:
            begun = time.perf_counter()
            try:
                made = method.edit(task)
            except (CaptureError, ExtractionError, EditError, EvaluationError) as error:
                warnings.warn(
                    AvmsfWarning(
                        f"{task.object.name} to {task.target}, {method.name}: no score, since {error}",
                        **{**error.attributes, "name": f"{task.object.name} to {task.target}, {method.name}"},
                    ),
                    stacklevel=2,
                )
                continue
            seconds = time.perf_counter() - begun
            said: float | None = None
            curve: tuple[tuple[int, float], ...] = ()
            if clap is not None and task.prompt is not None:
                said = float(clap.score(made.sounds, [task.prompt], sample_rate=made.sample_rate).mean())
                curve = clap_curve(made, task.prompt, clap)
            places = {name: space.place(made.bank) for name, space in spaces.items()}
            scores.append(
                EditScore(
                    method.name,
                    task.object.name,
                    task.object.material,
                    task.target,
                    task.prompt,
                    task.seed,
                    {name: space.distance(places[name], task.target) for name, space in spaces.items()},
                    {name: space.plain_distance(made.bank, task.target) for name, space in spaces.items()},
                    None if task.reference is None else spectral_distance(made, task.reference),
                    said,
                    seconds,
                    {name: (float(place[0]), float(place[1])) for name, place in places.items()},
                    curve,
                )
            )
            if progress is not None:
                progress(scores[-1])
    return tuple(scores)


def clap_curve(made: Edited, prompt: str, clap: Clap) -> tuple[tuple[int, float], ...]:
    """Return the steps of an edit's previews and their CLAP scores; silent previews have none."""
    heard = [(step, sound) for step, sound in made.previews if bool(sound.any())]
    if not heard:
        return ()
    scores = clap.score(torch.stack([sound for _, sound in heard]), [prompt], sample_rate=made.sample_rate)
    return tuple((step, float(score)) for (step, _), score in zip(heard, scores, strict=True))


def write_scores(scores: Sequence[EditScore], spaces: Mapping[str, MaterialSpace], path: Path) -> None:
    """Write scores and the embeddings that they rest on to one JSON file. Raises EvaluationError where it cannot."""
    record = {
        "scores": [asdict(score) for score in scores],
        "spaces": {name: space.record() for name, space in spaces.items()},
    }
    text = json.dumps(record, allow_nan=False, indent=1)
    write_whole(path, lambda place: place.write_text(text, encoding="utf-8"), raising=EvaluationError)


def spectral_distance(made: Edited, reference: Reference) -> float:
    """Return the mean over sounds of the relative STFT error from the nearest clip, all clips at the sound's level.

    Free of level; 0 for a sound that is one of the clips, 1 for silence. Raises EvaluationError for another rate.
    """
    if made.sample_rate != reference.sample_rate:
        raise EvaluationError(
            f"expected a reference at {made.sample_rate:g} Hz, got {reference.sample_rate:g} Hz; resample one of them",
            name="reference",
            value=reference.sample_rate,
        )
    clips = lasting(reference.clips, made.sounds.shape[1]).double()
    heard, wanted = (
        sounds / level(sounds, sample_rate=made.sample_rate)[:, None] for sounds in (made.sounds.double(), clips)
    )
    sizes = default_fft_sizes(made.sample_rate)
    errors = torch.zeros(len(heard), len(wanted), dtype=torch.float64)
    for size in sizes:
        own, aims = (magnitude_stft(sounds, fft_size=size, hop=max(1, size // 4)) for sounds in (heard, wanted))
        sums = torch.stack([(one - aims).abs().sum(dim=(1, 2)) for one in own])
        errors += sums / aims.sum(dim=(1, 2)) / len(sizes)
    return float(errors.amin(dim=1).mean())
