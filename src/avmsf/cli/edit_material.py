"""The old and the new material of an edit on the command line."""

from dataclasses import dataclass, replace

from avmsf.cli.options.edit import MaterialOptions
from avmsf.cli.printing import say
from avmsf.editing.material import LAWS, change_material, infer_material
from avmsf.fem.material import Material, material_named
from avmsf.field.sound_field import SoundField


@dataclass(frozen=True)
class MaterialChange(MaterialOptions):
    """Another material and size, by the laws of linear modal analysis: the shape stays."""

    def infer_material(self, field: SoundField) -> Material:
        """Return a field's material before the change; prints its source where it is not given.

        Raises `SimulationError` first for an unknown new material.
        """
        new = None if self.material is None else material_named(self.material)
        return old_material(field, new=new) if self.old is None else material_named(self.old)

    def target(self, old: Material) -> Material:
        """Return the new material of an object of `old`."""
        new = old if self.material is None else material_named(self.material)
        if self.constants:
            new = replace(new, name=f"{new.name} with {', '.join(self.constants)} changed", **self.constants)
        return new

    def apply(self, field: SoundField, *, old: Material) -> SoundField:
        """Return the field of an object of `old` in its new material."""
        return change_material(field, old, self.target(old), size=self.size, law=LAWS[self.law])


def old_material(field: SoundField, *, new: Material | None = None) -> Material:
    """Return a field's material, and print its source. Raises `EditError` where no material fits."""
    known = infer_material(field, option="--from", new=new)
    say(known.words)
    return known.material
