"""One case of one object: every method is fitted to the same impacts and scored on the same others."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.caching import Given, Result
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.evaluation.cases import Case
from avmsf.evaluation.field_methods import configured
from avmsf.evaluation.ground_truth import truth_at
from avmsf.evaluation.listening import keep_sound, listening_gain
from avmsf.evaluation.localization import located, write_map
from avmsf.evaluation.methods import report_of
from avmsf.evaluation.plan import Evaluation
from avmsf.evaluation.renderer import Renderer, expect_renderer
from avmsf.evaluation.results import CaseRecord, Outcome, failure_of
from avmsf.evaluation.sound_metrics import Judgement, spread
from avmsf.evaluation.splits import align_split
from avmsf.evaluation.task import Look, Method, Task
from avmsf.features.feature_field import FeatureField
from avmsf.fem.body_family import BodyFamily
from avmsf.field.gains.elastic import CandidateBodies
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.modal.extraction.extract import Extraction, extract_once
from avmsf.modal.extraction.finders import ModeFinder
from avmsf.simulate.ground_truth import Truth

LISTENED = 3
"""Test contacts of an experiment whose sounds are kept to be listened to."""
_RECORDED = "recorded"
"""What the recordings' own files are called beside the methods'."""


class _Recordings:
    """A case's recordings from one kind of start, aligned when first asked for, and their modes, kept in a file."""

    def __init__(self, impacts: Impacts, case: Case, finder: ModeFinder, path: Path) -> None:
        self.train, self.test = impacts.take(case.train), impacts.take(case.test)
        self._finder, self._path = finder, path
        self._found: Extraction | None = None

    def modes(self) -> Extraction:
        if self._found is None:
            self._found = extract_once(self.train, self._finder, self._path)
        return self._found

    def align(self) -> None:
        """Give all recordings the starts that the training ones have in common."""
        self.train, self.test = align_split(self.train, self.test, modes=self.modes)


class CaseRun:
    """Runs methods in one case, with modes that are found once and kept in a file."""

    def __init__(
        self,
        evaluation: Evaluation,
        identifier: str,
        case: Case,
        impacts: Impacts,
        truth: Truth | None,
        *,
        folder: Path,
        place: str,
        look: Callable[[Look], FeatureField],
        bodies: Callable[[], CandidateBodies],
        family: Callable[[], BodyFamily],
        material: str | None,
        stranger: Callable[[], Float[Tensor, " samples"]],
        vertices: Float[Tensor, "vertices 3"] | None,
        listened: bool,
        own_starts: Impacts | None = None,
    ) -> None:
        """Prepare a case of an object; `place` is its own path beneath the results' folder.

        All methods are scored on `impacts`. Where these start at their peaks, `own_starts` are the same recordings with
        the dataset's own starts, for fields that are not of the paper's configuration: from its peak a recording's
        modes have phases of its own, which hide the signs of the gains.
        """
        self.evaluation, self.identifier, self.case, self.impacts = evaluation, identifier, case, impacts
        modes, finder = folder / "modes", evaluation.finder
        self.scored = self.own = _Recordings(impacts, case, finder, modes / f"{place}.safetensors")
        if own_starts is not None:
            self.own = _Recordings(own_starts, case, finder, modes / f"{place} own starts.safetensors")
        self.truth = None if truth is None else truth_at(truth, self.scored.test.names)
        self.folder, self.place, self.look, self.stranger = folder, place, look, stranger
        self.bodies, self.family, self.material, self.vertices = bodies, family, material, vertices
        self.listened = spread(len(case.test), LISTENED) if listened else []
        self.shared = 0.0

    def outcome(self, method: Method) -> Outcome:
        """Return what a method comes to; whatever it raises, but for an interruption, is its failure."""
        begun, shared = time.perf_counter(), self.shared
        settings = configured(method)
        recordings = self.scored if settings is None or settings.published else self.own
        try:
            for each in (self.scored, recordings):
                with self._sharing():
                    each.align()
            renderer = expect_renderer(method.fit(self._task(recordings)))
            fit_seconds = time.perf_counter() - begun - (self.shared - shared)
            begun = time.perf_counter()
            with torch.no_grad():
                sounds = renderer.render(recordings.test.contacts, directions=recordings.test.directions)
            render_seconds = time.perf_counter() - begun
            judgement, maps = self._judgement(method, recordings, renderer, sounds)
        except Exception as error:  # A fault in one method must not cost the others their hours.
            return Outcome(self.case.key, method.name, failure=failure_of(error))
        return Outcome(
            self.case.key,
            method.name,
            judgement.values,
            judgement.figures,
            round(fit_seconds, 4),
            round(render_seconds, 4),
            self._keep_sounds(method.name, sounds),
            report_of(renderer),
            maps,
        )

    def described(self, known: CaseRecord) -> CaseRecord:
        """Return the case's record with the recordings' files, and with what modes and features have taken so far."""
        sounds = known.sounds or self._keep_sounds(_RECORDED, self.scored.test.sounds)
        seconds, self.shared = known.shared_seconds + self.shared, 0.0
        return replace(known, sounds=sounds, shared_seconds=round(seconds, 4))

    def _judgement(
        self, method: Method, recordings: _Recordings, renderer: Renderer, sounds: Float[Tensor, "contacts samples"]
    ) -> tuple[Judgement, dict[str, str]]:
        """Return the metrics, and the files of contacts' maps by the names of their recordings."""
        if not self.evaluation.protocol.locating:
            loudest = float(self.impacts.sounds.abs().max())
            return self.evaluation.judging.judge(renderer, sounds, self.scored.test, self.truth, loudest=loudest), {}
        points, settings = self._shared(self.look)("surface").points, configured(method)
        published = settings is not None and settings.published
        found = located(
            renderer,
            recordings.train,
            recordings.test,
            points,
            vertices=self.vertices,
            published=published,
            map_rows=self.listened,
        )
        maps = {}
        for row, each in found.maps.items():
            file = f"maps/{self.place}/{row:03d} {_file_word(method.name)}.safetensors"
            write_map(self.folder / file, each, truth=recordings.test.contacts[row])
            maps[recordings.test.names[row]] = file
        return Judgement(dict(found.errors), {}), maps

    def _task(self, recordings: _Recordings) -> Task:
        return Task(
            name=self.identifier,
            train=recordings.train,
            contacts=self.impacts.contacts,
            names=self.impacts.names,
            seed=self.evaluation.seed,
            modes=self._shared(recordings.modes),
            features=self._shared(self.look),
            bodies=self._shared(self.bodies),
            stranger=self._shared(self.stranger),
            family=self._shared(self.family),
            material=self.material,
            gaussians=self._gaussians,
            device=self.evaluation.device,
        )

    def _shared(self, make: Callable[Given, Result]) -> Callable[Given, Result]:
        def made(*given: Given.args, **named: Given.kwargs) -> Result:
            with self._sharing():
                return make(*given, **named)

        return made

    def _gaussians(self) -> GaussianCloud:
        if self.evaluation.clouds is None:
            raise EvaluationError.expected(
                "Gaussians, views or a mesh", name=self.identifier, advice="give one, or omit the method"
            )
        with self._sharing():
            return self.evaluation.clouds(self.identifier, self.case.views)

    @contextmanager
    def _sharing(self) -> Iterator[None]:
        """Count the time to no method: whichever asks first would seem the slowest."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            self.shared += time.perf_counter() - begun

    def _keep_sounds(self, name: str, sounds: Float[Tensor, "contacts samples"]) -> dict[str, str]:
        """Write the sounds to listen to, and return their files by the names of their recordings."""
        kept = {}
        word = _file_word(name)
        for row in self.listened:
            file = f"sounds/{self.place}/{row:03d} {word}.flac"
            test = self.scored.test
            keep_sound(
                self.folder / file, sounds[row], sample_rate=test.sample_rate, gain=listening_gain(test.sounds[row])
            )
            kept[test.names[row]] = file
        return kept


def _file_word(method: str) -> str:
    """Return a method's name for files: methods that read a folder have its path in their name."""
    return "".join(mark if mark.isalnum() or mark in "-_" else "-" for mark in method)
