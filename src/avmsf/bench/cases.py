"""Which contacts of an object are learnt from and which are judged by: the ways of choosing them, as data.

Places are chosen, counted and left out, not recordings: all recordings at a place go to one side. A test at a place
that was trained on would be too easy.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float64
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.capture.places import rows_by_place
from avmsf.errors import EvaluationError
from avmsf.scene.points import closest_points, farthest_points
from avmsf.wording import counted

COUNTS = (3, 4, 6, 8, 12, 16, 24, 32, 48)
"""Numbers of places learnt from, where no others are asked for."""
_LEFT = 0.25
"""Part of the places that is kept to be judged by, where counts are not asked for."""


@dataclass(frozen=True)
class Case:
    """One choice of training and test impacts, by their rows in an object's `Impacts`."""

    label: str
    """What tables call it; the cases of one label are parts of one experiment, and their figures are pooled."""
    train: tuple[int, ...]
    """Rows to learn from, in the order of their choice."""
    test: tuple[int, ...]
    """Rows to be judged by, ascending."""
    fold: str = ""
    """Which part of the experiment this is, where it has several."""
    views: int | None = None
    """Most views that looks may be drawn from; None for all."""

    @property
    def key(self) -> str:
        """A name that no other case of the object has."""
        return f"{self.label}: {self.fold}" if self.fold else self.label


@runtime_checkable
class Choosing(Protocol):
    """A way to choose training places, with all recordings there."""

    def cases(self, impacts: Impacts) -> tuple[Case, ...]:
        """Return the cases of an object. Raises EvaluationError where its places are too few."""
        ...


@dataclass(frozen=True)
class Farthest:
    """Training contacts as far apart as they go, from the first one on (paper, section 4.1)."""

    fraction: float = 0.2
    """Part of the places to train on, at least 2 places."""

    def cases(self, impacts: Impacts) -> tuple[Case, ...]:
        """Return the one case, the same as that of `avmsf.bench.evaluation.split`."""
        places = Places.of(impacts)
        wanted = places.expect_part(self.fraction)
        return (places.case("farthest", farthest_points(places.contacts, wanted)),)


@dataclass(frozen=True)
class Closest:
    """Training contacts in one region: the first contact and those nearest to it (paper, supplement)."""

    fraction: float = 0.2
    """Part of the places to train on, at least 2 places."""

    def cases(self, impacts: Impacts) -> tuple[Case, ...]:
        """Return the one case."""
        places = Places.of(impacts)
        wanted = places.expect_part(self.fraction)
        return (places.case("closest", closest_points(places.contacts, wanted)),)


@dataclass(frozen=True)
class LeaveOneOut:
    """Every place is judged by once, after learning from all others."""

    def cases(self, impacts: Impacts) -> tuple[Case, ...]:
        """Return a case for each place, named by its first recording."""
        places = Places.of(impacts)
        count = len(places.rows)
        places.expect(count - 1)
        return tuple(
            places.case("leave-one-out", (place for place in range(count) if place != left), fold=impacts.names[row[0]])
            for left, row in enumerate(places.rows)
        )


@dataclass(frozen=True)
class Shots:
    """Fewer and fewer training places, each choice within the one before, judged by the same places throughout."""

    counts: tuple[int, ...] = (16, 8, 4, 2, 1)
    """Numbers of training places; those that would leave no place to judge by are left out."""

    def cases(self, impacts: Impacts) -> tuple[Case, ...]:
        """Return a case for each number; all are judged by the places that the largest leaves over."""
        places = Places.of(impacts)
        counts = [count for count in self.counts if count < len(places.rows)] or [places.expect(min(self.counts))]
        order = farthest_points(places.contacts, max(counts)).tolist()
        test = places.case("", order).test
        cases = [places.case(f"{count} shots" if count > 1 else "1 shot", order[:count]) for count in counts]
        return tuple(Case(case.label, case.train, test) for case in cases)


@dataclass(frozen=True)
class Growing:
    """More and more places to learn from, spread as far apart as they go, from several first ones.

    Each choice holds the smaller ones of its start, and all of a start are judged by the same places: those that the
    largest leaves over.
    """

    counts: tuple[int, ...] = ()
    """Numbers of places to learn from; of `COUNTS` those that leave a quarter to judge by, where there is none."""
    starts: int = 3
    """First places, spread evenly over the table."""

    def __post_init__(self) -> None:
        if any(count < 1 for count in self.counts):
            raise EvaluationError(
                f"expected numbers of contacts of 1 or more, got {list(self.counts)}",
                name="counts",
                value=list(self.counts),
            )
        if self.starts < 1:
            raise EvaluationError(f"expected 1 start or more, got {self.starts}", name="starts", value=self.starts)

    def cases(self, impacts: Impacts) -> tuple[Case, ...]:
        """Return a case for each start and number. Raises EvaluationError where a number leaves nothing to judge by."""
        places = Places.of(impacts)
        total = len(places.rows)
        counts = self._counts(total)
        firsts = dict.fromkeys(round(number * total / self.starts) for number in range(self.starts))
        orders = {first: farthest_points(places.contacts, max(counts), start=first).tolist() for first in firsts}
        tests = {first: places.case("", order).test for first, order in orders.items()}
        return tuple(
            Case(
                label_of(count),
                places.case("", order[:count]).train,
                tests[first],
                fold=f"from {impacts.names[places.rows[first][0]]}",
            )
            for count in counts
            for first, order in orders.items()
        )

    def _counts(self, places: int) -> tuple[int, ...]:
        if not self.counts:
            counts = tuple(count for count in COUNTS if count <= (1.0 - _LEFT) * places)
            if counts:
                return counts
            raise EvaluationError(
                f"expected more contacts than {places} to train on {min(COUNTS)} and test on a quarter; record more, "
                "or give the numbers of contacts",
                name="contacts",
                value=places,
            )
        if max(self.counts) >= places:
            raise EvaluationError(
                f"expected at most {places - 1} of {places} contacts to train on, got {max(self.counts)}",
                name="counts",
                value=max(self.counts),
            )
        return tuple(sorted(set(self.counts)))


def label_of(count: int) -> str:
    """Return what a number of places is called."""
    return counted(count, "place")


@dataclass(frozen=True)
class FewerViews:
    """The same training contacts, with all views of the object and with fewer."""

    counts: tuple[int | None, ...] = (None, 12)
    """Numbers of views; None is all."""
    choosing: Choosing = Farthest()
    """How training contacts are chosen."""

    def cases(self, impacts: Impacts) -> tuple[Case, ...]:
        """Return the cases of `choosing`, once for each number of views."""
        return tuple(
            Case("all views" if views is None else f"{views} views", case.train, case.test, case.fold, views)
            for views in self.counts
            for case in self.choosing.cases(impacts)
        )


@dataclass(frozen=True, eq=False)
class Places:
    """The places at which an object was struck, by `places_of`, in the order of their first recordings.

    Repeated recordings are of one place even if their contacts were measured anew each time.
    """

    contacts: Float64[Tensor, "places 3"]
    """Contact of the first recording at each, meters."""
    rows: tuple[tuple[int, ...], ...]
    """The recordings at each."""

    @classmethod
    def of(cls, impacts: Impacts) -> "Places":
        """Find the places of an object's impacts."""
        rows = rows_by_place(impacts.contacts)
        return cls(impacts.contacts.double()[[each[0] for each in rows]], rows)

    @property
    def recordings(self) -> int:
        """How many recordings there are at all places."""
        return sum(map(len, self.rows))

    def number_of(self, row: int) -> int:
        """Return the place of a recording. Raises EvaluationError for a row that is none."""
        for place, rows in enumerate(self.rows):
            if row in rows:
                return place
        raise EvaluationError(
            f"expected the index of a recording, 0 to {self.recordings - 1}, got {row}", name="start", value=row
        )

    def expect(self, wanted: int, *, least: int = 1) -> int:
        """Return `wanted`, or raise EvaluationError for fewer training contacts than `least` or no test contact."""
        if not least <= wanted < len(self.rows):
            raise EvaluationError(
                f"expected {least} to {len(self.rows) - 1} training contacts of "
                f"{counted(self.recordings, 'recording')} at {counted(len(self.rows), 'contact')}, got {wanted}; "
                "choose another number or record more contacts",
                name="count",
                value=wanted,
            )
        return wanted

    def expect_part(self, fraction: float) -> int:
        """Return how many places a fraction of them is, at least 2. Raises EvaluationError as `expect`."""
        return self.expect(max(2, round(fraction * len(self.rows))), least=2)

    def case(self, label: str, chosen: Iterable[int] | Tensor, *, fold: str = "") -> Case:
        """Return the case that trains on the chosen places: first recordings first, then the repeated ones."""
        taken = [self.rows[int(place)] for place in chosen]
        train = [rows[0] for rows in taken] + sorted(row for rows in taken for row in rows[1:])
        heard = set(train)
        test = tuple(row for row in range(self.recordings) if row not in heard)
        return Case(label, tuple(train), test, fold)
