"""The same shape in another material or size: what linear modal analysis says without a new solve.

Where Poisson's ratio stays, stiffness goes as Young's modulus E and mass as the density r, so that the shapes of the
modes stay. With the size times s, undamped angular frequencies become w' = w sqrt(E' / E) (r' / r)^(-1/2) / s, and
mass-normalized shapes phi' = phi (r' / r)^(-1/2) s^(-3/2). With Rayleigh damping d = (alpha + beta w^2) / 2 a mode
sounds at sqrt(w^2 - d^2) / 2 pi. What an impact moves at a place is the product of two shapes, over the damped angular
frequency where that is a displacement.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf._utils.text import counted
from avmsf.editing.modal_edit import EDITS, Slider, adjust_modes, edited, muted
from avmsf.errors import EditError
from avmsf.fem.material import MATERIALS, Material, material_named
from avmsf.field.quality import ProbableBody
from avmsf.field.sound_field import Origin, SoundField
from avmsf.modal.modes import ModalBank


@dataclass(frozen=True)
class GainLaw:
    """How gains follow frequencies and the body's mass: a' = a ((r' / r)^(-1) s^(-3))^mass (f / f')^frequency."""

    name: str
    mass: float
    """Power of the mass, which all modes share: 1, or 0 where only their ratios count."""
    frequency: float
    """Power of the frequencies."""


LAWS = {
    law.name: law
    for law in (
        GainLaw("displacement", mass=1.0, frequency=1.0),
        GainLaw("velocity", mass=1.0, frequency=0.0),
        GainLaw("acceleration", mass=1.0, frequency=-1.0),
        GainLaw("ratio-only", mass=0.0, frequency=1.0),
    )
}
"""By name: gains that are displacements, velocities, as a laser vibrometer's are, or accelerations, which what a
microphone close by hears goes with; and the paper's law, a' = a f / f', which leaves mass and size out."""


def change_material(
    field: SoundField,
    old: Material | str,
    new: Material | str,
    *,
    size: float = 1.0,
    law: GainLaw | str = "displacement",
) -> SoundField:
    """Return the field of an object of the same shape, `size` times as large, in a new material.

    Materials and the law are given as such, or by their names in `avmsf.fem.material.MATERIALS` and `LAWS`.
    The dampings of the field are multiplied by the ratio of what the two materials' Rayleigh laws say, so that
    each mode's deviation from the law (by supports and radiation) stays in proportion; the same material changes
    nothing, and a third material in between gives the same result, unless it overdamps a mode.
    Where neither material damps, dampings stay. Ratios of gains between places stay, the residual too. A place on the
    new object is `size` times the old one's.

    `origin.capture` becomes the old name with the new material, such as "mug, glass".
    What was done is the last entry of `origin.report["edits"]`, with its remarks: modes that have moved to half the
    sample rate or above, which are silent and come back with an edit that lowers them; modes that the new material
    damps beyond the critical damping, which have no tone: they are mute from then on, and keep the frequency and the
    damping that they had; and another Poisson's ratio, which changes shapes and takes a new solve.

    Raises `EditError` for a size that is not positive, a name of no law, and where one of the materials has no damping
    and the other has, and `SimulationError` for a name of no material.
    """
    old, new = (material_named(each) if isinstance(each, str) else each for each in (old, new))
    _check(old, new, size)
    if isinstance(law, str):
        if law not in LAWS:
            raise EditError.unknown(law, LAWS, name="law")
        law = LAWS[law]
    before, mute = field.bank, muted(field)
    omega = torch.hypot(2.0 * math.pi * before.frequency, before.damping)
    moved = omega * (math.sqrt(new.young / old.young) * math.sqrt(old.density / new.density) / size)
    # Where the old material does not damp, neither does the new one.
    ratio = rayleigh_damping(moved, new) / rayleigh_damping(omega, old) if _damps(old) else torch.ones_like(omega)
    damping = before.damping * ratio
    dead = (damping >= moved) & torch.isfinite(damping) & ~mute
    # Without a tone a mode has no frequency that a bank could hold, and what is mute no place where it would be heard.
    left = dead | mute
    angular = torch.where(damping >= moved, moved, torch.sqrt((moved.square() - damping.square()).clamp_min(0.0)))
    bank = ModalBank(
        torch.where(left, before.frequency, angular / (2.0 * math.pi)), torch.where(left, before.damping, damping)
    )
    lost = before.frequency[dead & field.is_mode].tolist()
    mass = (new.density / old.density) * size**3
    scale = (before.frequency / bank.frequency) ** law.frequency / mass**law.mass
    entry: dict[str, Any] = {
        "edit": "change_material",
        "from": asdict(old),
        "to": asdict(new),
        "size": float(size),
        "law": law.name,
        "overdamped_hertz": lost,
        "remarks": _remarks(old, new, lost, int(field.is_mode.sum())),
    }
    changed = edited(field, bank, torch.where(left, 0.0, scale), entry=entry, length=size)
    return replace(changed, origin=replace(changed.origin, capture=_name(field.origin, old, new)))


def _name(origin: Origin, old: Material, new: Material) -> str:
    """Return the object's name with its new material in place of the one of an earlier edit."""
    if new.name == old.name:
        return origin.capture
    earlier = [edit["to"]["name"] for edit in origin.report.get(EDITS, []) if edit["edit"] == "change_material"]
    base = origin.capture.removesuffix(f", {earlier[-1]}") if earlier else origin.capture
    return f"{base}, {new.name}" if base else new.name


def rayleigh_damping(omega: Float64[Tensor, " modes"], material: Material) -> Float64[Tensor, " modes"]:
    """Return a material's own dampings, 1/s, at undamped angular frequencies: (alpha + beta w^2) / 2."""
    return 0.5 * (material.alpha + material.beta * omega.square())


def _damps(material: Material) -> bool:
    return material.alpha > 0 or material.beta > 0


def _remarks(old: Material, new: Material, lost: Sequence[float], modes: int) -> list[str]:
    """Return messages on neglected changes, and on the modes, in Hz, of all that are overdamped."""
    remarks = []
    if new.poisson != old.poisson:
        stiffer = math.sqrt((1.0 - old.poisson**2) / (1.0 - new.poisson**2)) - 1.0
        remarks.append(
            f"Poisson's ratio changes from {old.poisson:g} to {new.poisson:g}, which this law neglects: bending "
            f"frequencies of a thin wall would change by about {100 * stiffer:+.1f} %, and the mode shapes slightly"
        )
    if lost:
        remarks.append(
            f"{len(lost)} of {counted(modes, 'mode')} overdamped by alpha {new.alpha:g} 1/s and beta "
            f"{new.beta:g} s, and silent: " + ", ".join(f"{each:.4g} Hz" for each in lost)
        )
    return remarks


def _check(old: Material, new: Material, size: float) -> None:
    if not 0.0 < size < math.inf:
        raise EditError.expected("the ratio of new to old lengths, above 0, such as 1.5", size, name="size")
    for name, material, other in (("new", new, old), ("old", old, new)):
        if _damps(other) and not _damps(material):
            wanted = f"alpha (1/s) or beta (s) of {material.name} above 0, as for {other.name}"
            raise EditError.expected(wanted, (material.alpha, material.beta), name=name)


MAX_MISMATCH = 1.5
"""By which factor, up or down, the middle one of a field's dampings may miss a law that is said to fit."""


def guess_materials(
    bank: ModalBank,
    weight: Float64[Tensor, " modes"] | None = None,
    *,
    materials: Iterable[Material] = tuple(MATERIALS.values()),
) -> list[tuple[Material, float]]:
    """Return each material that damps at all, and the factor by which it misses the dampings, the best one first.

    By each mode's damping over that of the material's Rayleigh law at its frequency. Modes of half the weight (equal
    without one) miss the law by this factor, up or down, or by more; 1 is a perfect fit: a few modes that lose their
    energy elsewhere are no matter. Dampings alone tell some materials badly apart, as ceramic and iron, so that the
    second guess matters too.
    """
    omega = torch.hypot(2.0 * math.pi * bank.frequency, bank.damping)
    guesses = []
    for material in materials:
        if _damps(material):
            misses, order = (bank.damping / rayleigh_damping(omega, material)).log().abs().sort()
            below = (torch.ones_like(misses) if weight is None else weight[order]).cumsum(0)
            middle = int(torch.searchsorted(below, 0.5 * below[-1]))
            guesses.append((material, math.exp(float(misses[middle]))))
    return sorted(guesses, key=lambda guess: guess[1])


_AMBIGUOUS_RATIO = 1.2
"""Ratio of the errors up to which the second-best material is as likely."""
_MAX_POINTS = 256
"""Points of the object that energies are taken over, about."""


def infer_material(field: SoundField, *, option: str, new: Material | None = None) -> tuple[Material, str]:
    """Return a field's material, and a message on how it is known.

    That of the field's last material edit or of its guess, or the one nearest to its dampings: among those that may be
    as stiff as the field's body, if it has one, by the modes weighted by energy. `option` is the option for the
    material, named in messages, which also say where what is assumed is `new`. Raises `EditError` where no material
    fits.
    """
    report = field.origin.report
    bank, last = _before_adjustments(field.bank, report.get(EDITS, []))
    if last is not None and last["edit"] == "change_material":
        known = Material(**last["to"])
        return known, f"old material: {known.name}, from the last material edit"
    if "guess" in report and last is None:
        guessed = Material(**report["material"])
        return guessed, f"old material: {guessed.name}, for which the field was guessed"
    # A guided edit has left the body's material.
    body = ProbableBody.of(report) if last is None else None
    stiff = "" if body is None else f", and the most probable body has {body.specific_stiffness}"
    guesses = guess_materials(bank, _weight(field), materials=MATERIALS.values() if body is None else body.materials)
    if not guesses or guesses[0][1] > MAX_MISMATCH:
        near = [f": the nearest, {each.name}, differs by a factor of {ratio:.3g}" for each, ratio in guesses[:1]]
        wanted = f"the present material, as none has the dampings of the modes{''.join(near)}{stiff}"
        found = guesses[0][0].name if guesses else None
        raise EditError.expected(wanted, found, got="none", name=option, advice=f"give {option}")
    best, best_ratio = guesses[0]
    words = (
        f"old material: {best.name} assumed, whose dampings differ by a median factor of {best_ratio:.3g} "
        f"from those of the modes{stiff}"
    )
    for second, ratio in guesses[1:2]:
        if ratio < _AMBIGUOUS_RATIO * best_ratio:
            words += f"; {second.name} fits equally well ({ratio:.3g}) and would give another level"
    if best == new:
        words += "; it is the new material too, which changes nothing"
    return best, f"{words}; give {option} if known"


def _weight(field: SoundField) -> Float64[Tensor, " modes"]:
    """Return the modes' energies over the object; next to nothing for supporting poles."""
    points = field.gain_field.points
    energy = field.known(points[:: max(1, len(points) // _MAX_POINTS)]).energy(field.bank.damping)
    return torch.where(field.is_mode, energy.double(), 0.0).clamp_min(torch.finfo(torch.float64).tiny)


def _before_adjustments(
    bank: ModalBank, edits: Sequence[Mapping[str, Any]]
) -> tuple[ModalBank, Mapping[str, Any] | None]:
    """Return the modes before the last adjustments of pitch and decay, and the edit before these, if there is one."""
    for entry in reversed(edits):
        if entry["edit"] != "adjust_modes":
            return bank, entry
        pitch, decay = (torch.tensor(entry[name], dtype=torch.float64) for name in ("pitch", "decay"))
        bank = ModalBank(bank.frequency / pitch, bank.damping * decay)
    return bank, None


def edit(
    field: SoundField,
    *,
    material: Material | str | None = None,
    old_material: Material | str | None = None,
    size: float = 1.0,
    law: GainLaw | str = "displacement",
    pitch: Slider = 1.0,
    decay: Slider = 1.0,
    brightness_db: float = 0.0,
    gains_db: Slider = 0.0,
) -> SoundField:
    """Return the field of another material, size, pitch, decay or brightness; the shape stays.

    `material` and `size` follow the laws of linear modal analysis, see `change_material`; the others come after them,
    see `adjust_modes`. Optimization towards recordings or a text is `avmsf.editing.edit_towards`.

    Args:
        field: The field to edit; it stays as it is.
        material: The new material, by name or with constants of its own.
        old_material: The material before; by default the one nearest to the modes' dampings.
        size: New lengths over old ones.
        law: What the recordings are in proportion to: a `GainLaw`, or the name of one, which is displacement,
            velocity, acceleration or ratio-only.
        pitch: Factor on frequencies, one or one for each mode.
        decay: Factor on decay times, likewise.
        brightness_db: Change of level per octave, dB.
        gains_db: Change of level, dB, one or one for each mode.

    Returns:
        A new field.

    Raises:
        EditError: Where nothing is to change, and as `change_material` and `adjust_modes`.
        SimulationError: For an unknown material.
    """
    adjusted = {"pitch": pitch, "decay": decay, "brightness_db": brightness_db, "gains_db": gains_db}
    neutral = {"pitch": 1.0, "decay": 1.0, "brightness_db": 0.0, "gains_db": 0.0}
    modes = [name for name, value in adjusted.items() if not isinstance(value, float | int) or value != neutral[name]]
    if material is None and size == 1.0 and not modes:
        raise EditError("expected an edit, got none: give material, size, pitch, decay, brightness_db or gains_db")
    if material is not None or size != 1.0:
        new = material_named(material) if isinstance(material, str) else material
        old = infer_material(field, option="old_material", new=new)[0] if old_material is None else old_material
        field = change_material(field, old, old if new is None else new, size=size, law=law)
    if modes:
        field = adjust_modes(field, pitch=pitch, decay=decay, brightness_db=brightness_db, gains_db=gains_db)
    return field
