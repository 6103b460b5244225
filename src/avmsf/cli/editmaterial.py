"""Which material an edit starts from and which it leads to, as the command line has it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import tyro

from avmsf.cli.printing import figure, say
from avmsf.errors import EditError
from avmsf.field.soundfield import SoundField
from avmsf.simulate.material import Material, material_named
from avmsf.tasks.edits import EDITS
from avmsf.tasks.materialguess import guess_materials
from avmsf.tasks.recast import LAWS, recast

_CLOSE = 1.2
"""How much farther off the second-best material may be and still be as likely."""
_KEEPING = ("recast", "retune")
"""Edits that leave no doubt what a field is made of."""


@dataclass(frozen=True)
class MaterialChange:
    """Another material and size, by the laws of linear modal analysis: the shape stays."""

    material: str | None = None
    """New material: ceramic, glass, wood, plastic, iron, polycarbonate or steel."""
    old: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """Material that the object is of; told by how fast its modes die away where it is not given."""
    size: float = 1.0
    """The new object's lengths over the old one's."""
    young: float | None = None
    """Young's modulus of the new material, Pa, in place of the table's, as the others below; without --material, in
    place of the old one's."""
    density: float | None = None
    """Density of the new material, kg/m3."""
    poisson: float | None = None
    """Poisson's ratio of the new material, of which no more is said than what it would change."""
    alpha: float | None = None
    """Rayleigh damping in proportion to mass of the new material, 1/s."""
    beta: float | None = None
    """Rayleigh damping in proportion to stiffness of the new material, s."""
    law: Literal["displacement", "velocity", "acceleration", "ratio-only"] = "displacement"
    """What the recordings go with, which decides how loud each mode becomes; ratio-only is the paper's law, which
    leaves mass and size out."""

    @property
    def constants(self) -> dict[str, float]:
        """The constants that are given."""
        given = {name: getattr(self, name) for name in ("young", "density", "poisson", "alpha", "beta")}
        return {name: value for name, value in given.items() if value is not None}

    @property
    def asked(self) -> bool:
        """Whether anything changes."""
        return self.material is not None or self.size != 1.0 or bool(self.constants)

    def made_of(self, field: SoundField) -> Material:
        """Return what a field is of before the change, with words on how that is known where it is not given."""
        return old_material(field) if self.old is None else material_named(self.old)

    def target(self, old: Material) -> Material:
        """Return what an object of `old` comes to be of."""
        new = old if self.material is None else material_named(self.material)
        if self.constants:
            new = replace(new, name=f"{new.name} with {', '.join(self.constants)} changed", **self.constants)
        return new

    def apply(self, field: SoundField, *, old: Material) -> SoundField:
        """Return the recast field of an object that is of `old`."""
        return recast(field, old, self.target(old), size=self.size, law=LAWS[self.law])


def old_material(field: SoundField) -> Material:
    """Return what a field is made of: what it was recast to, or the material whose damping fits its modes best.

    Raises `EditError` where none fits.
    """
    known = _recast_to(field.origin.report.get(EDITS, []))
    if known is not None:
        say(f"the object is of {known.name}, which it was recast to before")
        return known
    best, second, *_ = guess_materials(field.bank)
    if not best.fits:
        raise EditError(
            f"--from is not given, and no material's damping is that of the field's modes: {best.material.name} comes "
            f"nearest, which half of them miss by a factor of {figure(best.off)} or more: say what the object is of, "
            "as --from ceramic"
        )
    close = second.off < _CLOSE * best.off
    alike = f", and {second.material.name} fits as well ({figure(second.off)}), with which the loudness would differ"
    say(
        f"the object is taken to be of {best.material.name}: half of its modes have that material's damping within a "
        f"factor of {figure(best.off)}{alike if close else ''}; say --from where you know"
    )
    return best.material


def _recast_to(edits: Sequence[object]) -> Material | None:
    """Return the material of the last recast, None where there is none or what followed may have changed it."""
    for entry in reversed(edits):
        kind = entry.get("edit") if isinstance(entry, dict) else None
        if kind not in _KEEPING:
            return None
        if kind == "recast":
            assert isinstance(entry, dict)
            return Material(**entry["to"])
    return None
