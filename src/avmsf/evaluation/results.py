"""A folder of results: one file per object, written atomically after every method, so that a kill loses one method.

Some of the sounds are stored too, to be listened to and drawn.
"""

import io
import json
import math
import re
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import soundfile
from jaxtyping import Float
from scipy.signal import resample_poly
from torch import Tensor

from avmsf._utils.caching import content_digest
from avmsf._utils.files import write_whole
from avmsf._utils.text import flat, in_order, json_text, read_json_object
from avmsf.errors import AvmsfError, EvaluationError
from avmsf.evaluation.splits import Case

IDENTITY, SPACES, OBJECTS = "protocol.json", "spaces.json", "objects"
"""The files that identify the evaluation and embed the objects of `edit`, and the folder of the objects' files."""
_MAX_BYTES = 64 << 20
"""Largest file of results that is read: three million values, as of 100 contacts by 10 metrics in 3000 cases."""
_MAX_WORD = 40
"""Characters of a path in a file's name, which may take four bytes each."""
_MAX_SHOWN = 160
"""Characters of a setting in a message."""
RECORDED = "recorded"
"""What the recordings are called next to the methods."""
_PEAK = 0.25
"""What recordings peak at, of full scale: louder sounds of a method have room above."""
_RATES_HZ = 8000.0, 655_350.0
"""Below the first browsers do not play; FLAC has none above the second."""
_FULL_SCALE = 1 - 2**-15


@dataclass(frozen=True)
class Outcome:
    """Result of one method in one case of an object."""

    case: str
    """The case's key."""
    method: str
    values: Mapping[str, tuple[float | None, ...]] = field(default_factory=dict)
    """Each metric's value for every test contact, in the case's order; None where it was not computed."""
    figures: Mapping[str, float | None] = field(default_factory=dict)
    """Values over all test contacts."""
    fit_seconds: float = 0.0
    """Without the modes and features, which methods share."""
    render_seconds: float = 0.0
    """For all test contacts."""
    sounds: Mapping[str, str] = field(default_factory=dict)
    """Files of sounds for the page, relative to the folder, by the names of their recordings."""
    report: Mapping[str, Any] = field(default_factory=dict)
    """Choices that the method made."""
    maps: Mapping[str, str] = field(default_factory=dict)
    """Files of located contacts' maps, likewise."""
    failure: str | None = None
    """Reason for missing values, in the first line (`failure_of`)."""
    digest: str = ""
    """Of the files that a method's sounds are read from (`RecordedMethod`); empty for all other methods."""


@dataclass(frozen=True)
class CaseRecord:
    """One case of an object, with names in place of indices."""

    key: str
    label: str
    train: tuple[str, ...]
    test: tuple[str, ...]
    sounds: Mapping[str, str] = field(default_factory=dict)
    """Files of the recordings for the page."""
    shared_seconds: float = 0.0
    """Time of modes and features, which all methods share."""

    @classmethod
    def of(cls, case: Case, names: Sequence[str]) -> "CaseRecord":
        """Return the record of a case of recordings of these names."""
        train, test = (tuple(names[row] for row in rows) for rows in (case.train, case.test))
        return cls(case.key, case.label, train, test)


@dataclass(frozen=True)
class ObjectRecord:
    """Evaluation of one object."""

    identifier: str
    name: str = ""
    material: str | None = None
    digest: str = ""
    """Of the recordings, and of the ground truth where it is known."""
    sample_rate: float = 0.0
    """Of the recordings, Hz."""
    cases: tuple[CaseRecord, ...] = ()
    outcomes: tuple[Outcome, ...] = ()
    failure: str | None = None
    """Why the object could not be evaluated at all."""

    def done(self, case: str, method: str, digest: str = "") -> bool:
        """Whether this method has values in this case, of files with this digest; failures are retried."""
        wanted = (case, method, digest, None)
        return any((each.case, each.method, each.digest, each.failure) == wanted for each in self.outcomes)

    def adding(self, outcome: Outcome) -> "ObjectRecord":
        """Return the record with this outcome in place of an earlier one of its case and method."""
        others = (each for each in self.outcomes if (each.case, each.method) != (outcome.case, outcome.method))
        return replace(self, outcomes=(*others, outcome))


@dataclass(frozen=True)
class ResultsFolder:
    """Folder in which an evaluation stores its results."""

    path: Path

    def begin(self, identity: Mapping[str, Any], methods: Mapping[str, Mapping[str, str | None]]) -> None:
        """Use the folder for results of this identity, or continue with those that it holds.

        `identity` holds plain values that determine the results; `methods` describes each method. Methods may be added
        later. Raises EvaluationError where the folder's results are of another identity, or a method has changed.
        """
        wanted, path = json.loads(json.dumps(dict(identity))), self.path / IDENTITY
        # A kill may leave a hidden part of the file behind.
        if not path.exists() and self.path.is_dir() and any(self.path.glob("[!.]*")):
            empty, advice = f"an empty folder or one with {IDENTITY}", "choose a new --output"
            raise EvaluationError.expected(empty, got="other files", file=self.path, name="output", advice=advice)
        known = self.identity() if path.exists() else {**wanted, "methods": {}}
        stored = known.pop("methods")
        shared = {name: dict(methods[name]) for name in methods if name in stored}
        asked = dict(flat({**wanted, "methods": shared}))
        found = dict(flat({**known, "methods": {name: stored[name] for name in shared}}))
        name = next((each for each in (*asked, *found) if asked.get(each) != found.get(each)), None)
        if name is not None:
            theirs = found.get(name)
            made, got = f"results of {name} {_brief(asked.get(name))}", _brief(theirs)
            if name == "source":
                made, got = "results made by this version of avmsf", "those of another, whose code differs"
            if name == "columns":
                lacks, more = ({*ones} - {*others} for ones, others in permutations((wanted[name], theirs or ())))
                named = {"without": lacks, "with": more}.items()
                parts = [f"{word} {', '.join(in_order(names))}" for word, names in named if names]
                made, got = "results of the same metrics", f"those {' and '.join(parts)}"
            if name.startswith("among."):
                made, got = "results scored among the same objects and recordings", "those among others"
            advice = "give the same options, or choose another --output"
            raise EvaluationError.expected(made, theirs, got=got, file=self.path, name=name, advice=advice)
        write_json(path, {**wanted, "methods": {**stored, **methods}})

    def identity(self) -> dict[str, Any]:
        """Return the evaluation that the folder holds, with its methods. Raises EvaluationError where there is none."""
        read = _read(self.path / IDENTITY)
        if not isinstance(read.get("methods"), dict):
            raise _damaged(self.path / IDENTITY, "it names no methods")
        return read

    def read(self, identifier: str) -> ObjectRecord | None:
        """Return an object's record, or None where there is none yet."""
        path = self._path_of(identifier)
        return self._record(path) if path.exists() else None

    def write(self, record: ObjectRecord) -> None:
        """Write an object's record in place of an earlier one."""
        write_json(self._path_of(record.identifier), asdict(record))

    def records(self) -> tuple[ObjectRecord, ...]:
        """Return all objects' records, in natural order."""
        names = in_order(path.stem for path in (self.path / OBJECTS).glob("[!.]*.json"))
        return tuple(self._record(self._path_of(name)) for name in names)

    def _path_of(self, identifier: str) -> Path:
        return self.path / OBJECTS / f"{identifier}.json"

    def _record(self, path: Path) -> ObjectRecord:
        read = _read(path)
        try:
            cases = [{**each, "train": tuple(each["train"]), "test": tuple(each["test"])} for each in read.pop("cases")]
            outcomes = [
                {**each, "values": {name: tuple(values) for name, values in each["values"].items()}}
                for each in read.pop("outcomes")
            ]
            parts = tuple(CaseRecord(**each) for each in cases), tuple(Outcome(**each) for each in outcomes)
            return ObjectRecord(**read, cases=parts[0], outcomes=parts[1])
        except (KeyError, TypeError, AttributeError) as error:
            raise _damaged(path, error) from error


def listening_gain(recorded: Float[Tensor, " samples"]) -> float:
    """Return the gain of a recording and of the predictions next to it."""
    peak = float(recorded.abs().max())
    return _PEAK / peak if peak > 0 else 1.0


def write_flac(path: Path, sound: Float[Tensor, " samples"], *, sample_rate: float, gain: float) -> None:
    """Write a sound times `gain` as a FLAC file of 16 bits; what would clip is turned down to full scale.

    Sounds at rates that browsers do not play or FLAC does not have are resampled by a whole factor. Raises
    EvaluationError.
    """
    up, down = (max(1, math.ceil(each)) for each in (_RATES_HZ[0] / sample_rate, sample_rate / _RATES_HZ[1]))
    samples = resample_poly(sound.double().numpy() * gain, up, down)
    rate = round(sample_rate * up / down)
    # Above 65,535 Hz FLAC counts in tens.
    rate -= rate % 10 if rate > 65_535 else 0
    samples = samples * min(1.0, _FULL_SCALE / max(float(np.abs(samples).max(initial=0.0)), _FULL_SCALE))
    memory = io.BytesIO()
    soundfile.write(memory, samples, rate, subtype="PCM_16", format="FLAC")
    write_whole(path, memory.getvalue(), raising=EvaluationError)


_AGAIN = "delete the file to compute them again, or choose another --output"
_read = partial(read_json_object, raising=EvaluationError, advice=_AGAIN, max_bytes=_MAX_BYTES)


def _damaged(path: Path, error: object) -> EvaluationError:
    return EvaluationError.expected("results of this version", got=str(error), file=path, advice=_AGAIN)


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write plain values whole. Raises EvaluationError where that cannot be."""
    write_whole(path, json_text(values, indent=1) + "\n", raising=EvaluationError)


def failure_of(error: Exception) -> str:
    """Return an error of the package as one line; any other with its name, and its traceback in the lines below."""
    message = " ".join(str(error).split())
    if isinstance(error, AvmsfError):
        return message
    return "\n".join((f"{type(error).__name__}: {message}", *traceback.format_tb(error.__traceback__)))


def file_word(name: str) -> str:
    """Return a name for files: methods that read a folder have its path in their name, of which the end is kept."""
    word = re.sub(r"[^\w-]", "-", name)
    return word if ":" not in name else f"{word[-_MAX_WORD:]}-{content_digest(name)[:8]}"


def _brief(value: object) -> str:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= _MAX_SHOWN else f"{text[: _MAX_SHOWN - 3]}..."
