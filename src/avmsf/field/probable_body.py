"""The body that a fit found most probable behind the object's surface, and whether any material could be so stiff."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from avmsf._utils.text import like
from avmsf.fem.material import MATERIALS, NOMINAL, STIFFEST, Material, factor_range
from avmsf.fem.supports import FREE
from avmsf.field.gains.elastic import FREQUENCY_ERRORS

_MARGIN = 1.3
"""Factor by which a body's stiffness over density may be off a material's: of a thickness that is 14 % off."""


@dataclass(frozen=True)
class ProbableBody:
    """The most probable body of a fit."""

    name: str
    """In words, with the thickness of its wall if it has one."""
    wall_thickness: float | None
    """Meters; None for a body without an even wall."""
    wall_interval: tuple[float, float] | None
    """That holds the thickness with a probability of 90 %, meters; None where it was not searched for."""
    stiffness_ratio: float
    """Young's modulus over density that the measured frequencies need, over that of aluminum."""
    support: str
    """How it was held."""
    unit: str
    """The unit that the frequencies say the surface is in; empty for the present one, or where none was inferred."""

    @classmethod
    def of(cls, report: Mapping[str, Any]) -> "ProbableBody | None":
        """Return it from a fit's report; None where no body is credible. Raises RecordError for a damaged report."""
        credibility = like(report.get("credibility") or {}, {}, "origin.report.credibility")
        if not credibility.get("credible"):
            return None
        name = "origin.report.bodies.0"
        best = like(next(iter(like(report.get("bodies"), [], "origin.report.bodies")), None), {}, name)
        factor, wall = like(best["frequency_factor"], 1.0, name), best["wall_thickness"]
        searched, interval = like(report.get("thickness") or {}, {}, "origin.report.thickness"), None
        if wall is not None:
            wall = like(wall, 0.0, name)
            if searched:
                low, high = (like(searched[each], 0.0, "origin.report.thickness") for each in ("low", "high"))
                interval = low, high
        support, unit = (like(best.get(key, other), "", name) for key, other in (("support", FREE), ("unit", "")))
        return cls(like(best["body"], "", name), wall, interval, factor**2, support, unit)

    def __str__(self) -> str:
        """Return all of it in words."""
        interval = ""
        if self.wall_interval is not None:
            low, high = (1000 * each for each in self.wall_interval)
            interval = f", 90 % interval of the wall {low:.2g} to {high:.2g} mm"
        # The name of a held body says where it is held.
        free = f", {FREE}" if self.support == FREE else ""
        return f"{self.name}{interval}{free}, {self.specific_stiffness}"

    @property
    def materials(self) -> tuple[Material, ...]:
        """Those of the table that may be so stiff for their weight.

        The frequencies of a wall go with its thickness, so that an interval of the thickness is one of the ratio.
        """
        low, high = self._ratio / _MARGIN, self._ratio * _MARGIN
        if self.wall_thickness is not None and self.wall_interval is not None:
            low *= (self.wall_thickness / self.wall_interval[1]) ** 2
            high *= (self.wall_thickness / self.wall_interval[0]) ** 2
        return tuple(each for each in MATERIALS.values() if low <= each.young / each.density <= high)

    @property
    def specific_stiffness(self) -> str:
        """Young's modulus over density in words, with the materials that have it."""
        *most, last = [each.name for each in self.materials] or ["no material of the table"]
        return f"E/rho {self._ratio / 1e6:.2g} MJ/kg: as {', '.join(most)}{' or ' if most else ''}{last}"

    @property
    def _ratio(self) -> float:
        return self.stiffness_ratio * NOMINAL.young / NOMINAL.density

    @property
    def warning(self) -> str:
        """Say that the surface's unit is another one, or the body stiffer than any material of the table; else empty.

        With the margin of `factor_range`, beyond which no factor has a prior.
        """
        if self.unit:
            return (
                f"The unit of the mesh is probably {self.unit}, by the frequencies of the modes: write "
                f'unit = "{self.unit}" in capture.toml (and views_unit, for photographs), or state the present unit '
                "there as surface_unit."
            )
        # No larger factor is allowed: one that is within a step of the grid would have been larger.
        if math.sqrt(self.stiffness_ratio) * (1.0 + FREQUENCY_ERRORS[0]) <= factor_range()[1]:
            return ""
        over = self._ratio / (STIFFEST.young / STIFFEST.density)
        wrong, measure = "body", "check the unit of the mesh"
        if self.wall_thickness is not None:
            wrong = f"wall of {1000 * self.wall_thickness:.2g} mm"
            measure = "measure the wall and give --set body.wall=METERS"
        return (
            f"The fit needs {over:.2g} times the stiffness-to-density ratio of {STIFFEST.name}, the stiffest material "
            f"of the table, so the {wrong} is probably wrong, as where directions of impacts on edges are missing: "
            f"give nx,ny,nz for impacts on edges and handles, or {measure}."
        )

    def record(self) -> dict[str, Any]:
        """Return it as plain values, with the warning."""
        return asdict(self) | {"warning": self.warning or None}
