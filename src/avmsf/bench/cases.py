"""Which contacts of an object are learnt from and which are judged by: the ways of choosing them, as data."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.scene.points import closest_points, farthest_points


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
    """A way to choose training contacts.

    Impacts at one and the same contact stay on one side, lest a test be at a place already heard.
    """

    def cases(self, impacts: Impacts) -> tuple[Case, ...]:
        """Return the cases of an object. Raises EvaluationError where its contacts are too few."""
        ...


@dataclass(frozen=True)
class Farthest:
    """Training contacts as far apart as they go, from the first one on (paper, section 4.1)."""

    fraction: float = 0.2
    """Part of the impacts to train on, at least 2 contacts."""

    def cases(self, impacts: Impacts) -> tuple[Case, ...]:
        """Return the one case, the same as that of `avmsf.bench.evaluation.split`."""
        places = _Places.of(impacts)
        wanted = places.expect(max(2, round(self.fraction * len(impacts))))
        return (places.case("farthest", farthest_points(places.contacts, wanted)),)


@dataclass(frozen=True)
class Closest:
    """Training contacts in one region: the first contact and those nearest to it (paper, supplement)."""

    fraction: float = 0.2
    """Part of the impacts to train on, at least 2 contacts."""

    def cases(self, impacts: Impacts) -> tuple[Case, ...]:
        """Return the one case."""
        places = _Places.of(impacts)
        wanted = places.expect(max(2, round(self.fraction * len(impacts))))
        return (places.case("closest", closest_points(places.contacts, wanted)),)


@dataclass(frozen=True)
class LeaveOneOut:
    """Every contact is judged by once, after learning from all others."""

    def cases(self, impacts: Impacts) -> tuple[Case, ...]:
        """Return a case for each different contact, named by its first recording."""
        places = _Places.of(impacts)
        count = len(places.rows)
        places.expect(count - 1)
        return tuple(
            places.case("leave-one-out", (place for place in range(count) if place != left), fold=impacts.names[row[0]])
            for left, row in enumerate(places.rows)
        )


@dataclass(frozen=True)
class Shots:
    """Fewer and fewer training contacts, each choice within the one before, judged by the same contacts throughout."""

    counts: tuple[int, ...] = (16, 8, 4, 2, 1)
    """Numbers of training contacts; those that would leave no contact to judge by are left out."""

    def cases(self, impacts: Impacts) -> tuple[Case, ...]:
        """Return a case for each number; all are judged by the contacts that the largest leaves over."""
        places = _Places.of(impacts)
        counts = [count for count in self.counts if count < len(places.rows)] or [places.expect(min(self.counts))]
        order = farthest_points(places.contacts, max(counts)).tolist()
        test = places.case("", order).test
        cases = [places.case(f"{count} shots" if count > 1 else "1 shot", order[:count]) for count in counts]
        return tuple(Case(case.label, case.train, test) for case in cases)


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
class _Places:
    """The different contacts of an object, in the order of their first impacts."""

    contacts: Float64[Tensor, "places 3"]
    rows: tuple[tuple[int, ...], ...]
    """The impacts at each."""

    @classmethod
    def of(cls, impacts: Impacts) -> "_Places":
        found: dict[tuple[float, ...], list[int]] = {}
        for row, contact in enumerate(impacts.contacts.double().tolist()):
            found.setdefault(tuple(contact), []).append(row)
        contacts = torch.tensor(list(found), dtype=torch.float64).reshape(-1, 3)
        return cls(contacts, tuple(tuple(rows) for rows in found.values()))

    def expect(self, wanted: int) -> int:
        """Return `wanted`, or raise EvaluationError where so many training contacts leave none to judge by."""
        if not 1 <= wanted < len(self.rows):
            raise EvaluationError(
                f"{wanted} contacts to train on cannot be chosen from {len(self.rows)} different contacts: at least 1 "
                "is needed to train and 1 to test; record more contacts or take another protocol"
            )
        return wanted

    def case(self, label: str, chosen: Iterable[int] | Tensor, *, fold: str = "") -> Case:
        """Return the case that trains on the chosen contacts: first impacts first, then the repeated ones."""
        taken = [self.rows[int(place)] for place in chosen]
        train = [rows[0] for rows in taken] + sorted(row for rows in taken for row in rows[1:])
        heard = set(train)
        test = tuple(row for row in range(sum(map(len, self.rows))) if row not in heard)
        return Case(label, tuple(train), test, fold)
