"""Splits of an object's recordings into training and test recordings: those of the protocols as data, and by hand.

Contacts are chosen and counted, not recordings: all recordings at a contact are either training or test recordings. A
test at a training contact would be too easy.
"""

import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar, cast

from jaxtyping import Float64
from torch import Tensor

from avmsf._utils.arrays import as_count
from avmsf._utils.text import counted
from avmsf.capture.folder import Capture
from avmsf.capture.impacts import Impacts, rows_by_place
from avmsf.errors import EvaluationError, ExtractionError
from avmsf.mesh.points import farthest_points, nearest_points
from avmsf.modal.extraction.extract import Extraction, extract_modes

Recordings = TypeVar("Recordings", bound=Capture | Impacts)


@dataclass(frozen=True)
class Case:
    """One choice of training and test impacts, by their rows in an object's `Impacts`."""

    label: str
    """Heading in tables; the cases of one label are folds of one experiment, and their values are pooled."""
    train: tuple[int, ...]
    """Indices of training recordings, in the order of their choice."""
    test: tuple[int, ...]
    """Indices of test recordings, ascending."""
    fold: str = ""
    """Fold of the experiment, where it has several."""
    views: int | None = None
    """Maximum number of views for visual features; None for all."""
    target: str = ""
    """Material that the object is to change to, of the protocol `edit`."""
    goal: str = ""
    """Prompt, or name of the object whose recordings the edit is towards."""

    @property
    def key(self) -> str:
        """Unique name among the cases of the object."""
        return f"{self.label}: {self.fold}" if self.fold else self.label


def farthest(impacts: Impacts, fraction: float = 0.2) -> tuple[Case, ...]:
    """Return the case of a fraction of the contacts, two at least, by farthest-point sampling (paper, section 4.1)."""
    distinct = DistinctContacts.of(impacts)
    return (distinct.case("farthest", farthest_points(distinct.contacts, distinct.count_of(fraction))),)


def closest(impacts: Impacts, fraction: float = 0.2) -> tuple[Case, ...]:
    """Return the case of training contacts in one region: the first and those nearest to it (paper, supplement)."""
    distinct = DistinctContacts.of(impacts)
    count = distinct.count_of(fraction)
    return (distinct.case("closest", nearest_points(distinct.contacts, distinct.contacts[:1], count=count)[0]),)


def predefined(impacts: Impacts, test: Sequence[str] = ()) -> tuple[Case, ...]:
    """Return the case of these test recordings; all at other contacts are for training.

    Raises EvaluationError for a name that no recording has.
    """
    unknown = sorted(set(test) - set(impacts.names))
    if unknown:
        wanted = f"names of {counted(len(impacts), 'recording')}, {impacts.names[0]} to {impacts.names[-1]}"
        raise EvaluationError.expected(wanted, unknown[0], name="test")
    distinct = DistinctContacts.of(impacts)
    tested = {row for row, name in enumerate(impacts.names) if name in test}
    chosen = [contact for contact, rows in enumerate(distinct.rows) if tested.isdisjoint(rows)]
    distinct.check_count(len(chosen))
    return (replace(distinct.case("predefined", chosen), test=tuple(sorted(tested))),)


def edited(impacts: Impacts) -> tuple[Case, ...]:
    """Return the case of all recordings, of which the first eight contacts are rendered after an edit.

    An edit's goals make one each of it (`avmsf.evaluation.editing.Edits.cases`).
    """
    every = tuple(range(len(impacts)))
    return (Case("edit", every, every[:8]),)


def leave_one_out(impacts: Impacts) -> tuple[Case, ...]:
    """Return a case for each contact, named by its first recording, which trains on all others."""
    distinct = DistinctContacts.of(impacts)
    every = range(distinct.check_count(len(distinct.rows) - 1) + 1)
    return tuple(
        distinct.case("leave-one-out", [other for other in every if other != left], impacts.names[rows[0]])
        for left, rows in enumerate(distinct.rows)
    )


def shots(impacts: Impacts, counts: Sequence[int] = (16, 8, 4, 2, 1), starts: int = 1) -> tuple[Case, ...]:
    """Return a case for each number of training contacts, nested subsets by farthest-point sampling, and each start.

    The test contacts are those left by the largest number; numbers that would leave none are omitted. Starts are first
    contacts, evenly spaced in the table, each with subsets and test contacts of its own.
    """
    distinct = DistinctContacts.of(impacts)
    total = len(distinct.rows)
    given, several = dict.fromkeys(counts), min(starts, total)
    used = [count for count in given if count < total] or [distinct.check_count(min(given))]
    cases = []
    for first in (round(number * total / several) for number in range(several)):
        order = farthest_points(distinct.contacts, max(used), start=first).tolist()
        test = distinct.case("", order).test
        fold = f"from {impacts.names[distinct.rows[first][0]]}" if starts > 1 else ""
        cases += [
            Case(f"{count} shots" if count > 1 else "1 shot", distinct.case("", order[:count]).train, test, fold)
            for count in used
        ]
    return tuple(cases)


def fewer_views(impacts: Impacts) -> tuple[Case, ...]:
    """Return the case of `farthest` twice, with all views of the object and with 12."""
    (case,) = farthest(impacts)
    return tuple(replace(case, label=f"{views or 'all'} views", views=views) for views in (None, 12))


@dataclass(frozen=True, eq=False)
class DistinctContacts:
    """The distinct contacts of an object, by `places_of`, in the order of their first recordings.

    Repeated recordings are of one contact even if its position was measured each time.
    """

    contacts: Float64[Tensor, "contacts 3"]
    """Position of the first recording at each, meters."""
    rows: tuple[tuple[int, ...], ...]
    """Indices of the recordings at each."""

    @classmethod
    def of(cls, impacts: Impacts) -> "DistinctContacts":
        """Find the distinct contacts of an object's impacts."""
        rows = rows_by_place(impacts.contacts)
        return cls(impacts.contacts.double()[[each[0] for each in rows]], rows)

    def check_count(self, wanted: int, *, least: int = 1) -> int:
        """Return `wanted`, or raise EvaluationError for fewer training contacts than `least` or no test contact."""
        if not least <= wanted < len(self.rows):
            total = f"{counted(sum(map(len, self.rows)), 'recording')} at {counted(len(self.rows), 'contact')}"
            expected, advice = f"{least} to {len(self.rows) - 1} training contacts of {total}", "record more contacts"
            raise EvaluationError.expected(expected, wanted, name="count", advice=f"choose another number or {advice}")
        return wanted

    def count_of(self, fraction: float) -> int:
        """Return the number of a fraction of the contacts, at least 2. Raises EvaluationError as `check_count`."""
        return self.check_count(max(2, round(fraction * len(self.rows))), least=2)

    def case(self, label: str, chosen: Iterable[int] | Tensor, fold: str = "") -> Case:
        """Return the case that trains on the chosen contacts: first recordings first, then the repeated ones."""
        taken = [self.rows[int(contact)] for contact in chosen]
        train = [rows[0] for rows in taken] + sorted(row for rows in taken for row in rows[1:])
        test = {row for rows in self.rows for row in rows} - set(train)
        return Case(label, tuple(train), tuple(sorted(test)), fold)


def impacts_of(recordings: Capture | Impacts, name: str) -> Impacts:
    """Return the impacts of an argument. Raises EvaluationError for what is neither a capture nor impacts."""
    impacts = recordings.impacts if isinstance(recordings, Capture) else recordings
    if not isinstance(impacts, Impacts):
        raise EvaluationError.expected("a Capture or Impacts", type(impacts).__name__, name=name)
    return impacts


def split(
    recordings: Recordings, train_size: float | int = 0.75, *, seed: int | None = None, start: int = 0
) -> tuple[Recordings, Recordings]:
    """Split recordings into training and test recordings, whose contacts are as far apart as possible.

    Contacts nearer to each other than 1 % of the bounding box's diagonal count as one (`places_of`), and all recordings
    at a contact are on one side. The choice is by farthest-point sampling.

    Args:
        recordings: A capture, or the impacts of one.
        train_size: Fraction of the contacts (float, 0 to 1; at least 2 contacts) or their number (int).
        seed: Draws the contact that the choice starts from.
        start: Row of that contact without a `seed`.

    Returns:
        (train, test), of the type of `recordings`. Training recordings are in the order of the choice, one a contact,
            and then the repeated ones; so with more contacts the first ones stay the same.

    Raises:
        EvaluationError: Where no contact would remain to train on, with a fraction fewer than 2, or none to test.
    """
    impacts = impacts_of(recordings, "recordings")
    if isinstance(train_size, float) and not 0.0 < train_size < 1.0:
        wanted = "a fraction of the contacts between 0 and 1, or their whole number"
        raise EvaluationError.expected(wanted, train_size, name="train_size")
    if seed is not None:
        if not hasattr(seed, "__index__"):
            raise EvaluationError.expected("a whole number", seed, name="seed")
        start = random.Random(int(seed)).randrange(len(impacts))
    distinct = DistinctContacts.of(impacts)
    if isinstance(train_size, float):
        count = distinct.count_of(train_size)
    else:
        count = distinct.check_count(as_count(train_size, "train_size", raising=EvaluationError))
    if not 0 <= start < len(impacts):
        raise EvaluationError.expected(f"the index of a recording, 0 to {len(impacts) - 1}", start, name="start")
    first = next(contact for contact, rows in enumerate(distinct.rows) if start in rows)
    case = distinct.case("", farthest_points(distinct.contacts, count, start=first))
    train, test = impacts.take(case.train), impacts.take(case.test)
    if isinstance(recordings, Impacts):
        return cast("tuple[Recordings, Recordings]", (train, test))
    return replace(recordings, impacts=train), replace(recordings, impacts=test)


def align_split(
    train: Impacts, test: Impacts, *, modes: Callable[[], Extraction] | None = None
) -> tuple[Impacts, Impacts]:
    """Return both with the starts that the training recordings have in common; without modes they keep their own.

    `avmsf evaluate` does this before it fits and scores methods. `modes` finds the modes of `train`, by default with
    the settings of `extract_modes`.
    """
    if train.before is None:
        return train, test
    try:
        found = extract_modes(train) if modes is None else modes()
    except ExtractionError:
        return replace(train, before=None, after=None), replace(test, before=None, after=None)
    return found.aligned(train), found.aligned(test)


def evenly_spaced(count: int, wanted: int) -> list[int]:
    """Return at most `wanted` of the rows 0 to `count` - 1, evenly spaced, in ascending order."""
    if wanted >= count:
        return list(range(count))
    return [(2 * number + 1) * count // (2 * wanted) for number in range(wanted)]
