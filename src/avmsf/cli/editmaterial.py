"""Which material an edit starts from and which it leads to, as the command line has it."""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import tyro

from avmsf.cli.printing import say
from avmsf.field.soundfield import SoundField
from avmsf.simulate.material import Material, material_named
from avmsf.tasks.madeof import made_of
from avmsf.tasks.recast import LAWS, recast


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
        """Return what a field is of before the change, with words on how that is known where it is not given.

        Raises `EditError` first of all where what it comes to be of is unknown.
        """
        if self.material is not None:
            material_named(self.material)
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
    """Return what a field is made of, with words on how that is known. Raises `EditError` where no material fits."""
    known = made_of(field, option="--from")
    say(known.words)
    return known.material
