"""Numbers, names and subsets of the objects of ObjectFolder Real and RealImpact."""

import re
from collections.abc import Collection
from difflib import get_close_matches

from avmsf._utils.text import in_order
from avmsf.errors import DatasetError

REALIMPACT_NAMES = (
    "3_CeramicKoiBowl", "4_CeramicBowlFish", "6_Bowl", "9_BowlCeramic", "10_bowl", "17_IronSkillet", "19_Pan",
    "22_Cup", "23_PurpleScoop", "27_WoodPlate", "28_WoodPlateSquare", "31_WoodSlab", "32_WoodChalice",
    "33_WoodWineGlass", "34_WoodMug", "35_MeasuringCup", "36_SmallMeasuringCup", "37_PiePan", "43_IronMortar",
    "48_PlasticBowl", "49_PlasticBowl", "50_PlasticBowl", "51_ShellPlate", "59_stand", "60_SkullCup",
    "61_PlanterCeramic", "62_Pot_Hexagonal", "63_SmallPlanterCeramic", "64_CeramicMug", "65_PitcherCeramic",
    "67_IronPlate", "68_WoodBoard", "73_PlasticBin", "74_FlowerPotLargeCeramic", "75_FlowerpotSmallCeramic",
    "78_CeramicCup", "79_LargeSwanCeramic", "80_SmallSwanCeramic", "81_WoodPad", "83_WoodVase",
    "86_MetalHoledSpoon", "89_MetalSpatula", "90_MetalLadle", "91_MetalSpoon", "92_MetalSpatula",
    "93_GreenGoblet", "94_GlassGoblet", "96_Bowl", "97_PlasticScoop", "100_Frisbee",
)  # fmt: skip
"""All objects of RealImpact, as its archives and folders are called."""
ABLATION = ("1", "11", "28", "38", "41", "44", "52", "57", "66", "75")
"""Objects of ObjectFolder Real in the paper's ablations, and in its few-shot, sampling and input-view studies
(supplement, implementation details)."""
NON_SYMMETRIC = (
    "1", "14", "17", "24", "39", "40", "41", "44", "45", "52", "54", "55", "57", "66", "79", "91",
)  # fmt: skip
"""Objects of the case study without symmetry and of contact localization (the same place)."""
_FIRST_WORDS = ("ceramic", "iron", "wood", "glass")
_LAST_WORDS = ("ceramic", "iron", "wood")


def number_of(identifier: str) -> int | None:
    """Return the number that a folder's name begins with, 100 of `100_Frisbee` and of `100`; None if there is none."""
    found = re.match(r"(0|[1-9]\d*)(?:_|$)", identifier)
    return int(found[1]) if found else None


def shared_objects() -> tuple[int, ...]:
    """Return the numbers that are in both ObjectFolder Real and RealImpact.

    Both datasets have the same numbers, and many of their objects are the same physical ones. To train on one dataset
    and test on the other, leave these out of one of them. They are all of RealImpact's objects.
    """
    return tuple(sorted(number for number in map(number_of, REALIMPACT_NAMES) if number is not None))


def shared_remarks(names: Collection[str], other: str) -> list[str]:
    """Return a remark where objects of these names may be in the `other` dataset as well."""
    shared = [name for name in names if number_of(name) in shared_objects()]
    if not shared:
        return []
    return [
        f"{len(shared)} objects have numbers of {other} and may be the same objects: {', '.join(shared)}; do not "
        "train on one dataset and test on the other with them"
    ]


def in_words(name: str) -> str:
    """Return a folder's name as words: `wood plate square` of `28_WoodPlateSquare`."""
    return " ".join(_words(name)) or name


def material_in(name: str) -> str | None:
    """Return the material that a folder's name gives without ambiguity, or None.

    It is the name's first word, or its last; "glass" as the last word may be a drinking glass and gives none. Metal may
    be iron or steel, and plastic may be polycarbonate: for these None is returned.
    """
    words = _words(name)
    if not words:
        return None
    if words[0] in _FIRST_WORDS:
        return words[0]
    return words[-1] if words[-1] in _LAST_WORDS else None


def expect_known(identifier: str, known: Collection[str], dataset: str) -> None:
    """Raise `DatasetError` for an object that is not known, with those that may have been meant."""
    if identifier in known:
        return
    number = number_of(identifier)
    near = [name for name in known if number is not None and number_of(name) == number]
    near += [name for name in get_close_matches(identifier, known, n=3, cutoff=0.5) if name not in near]
    if not near and number is not None:
        near = sorted(known, key=lambda name: abs((number_of(name) or 0) - number))[:4]
    meant = f"did you mean {' or '.join(near)}?" if near else f"such as {', '.join(in_order(known)[:8])};"
    wanted, advice = f"one of the {len(known)} of {dataset}", f"{meant} `avmsf check` lists all"
    raise DatasetError.expected(wanted, identifier, name="object", advice=advice)


def _words(name: str) -> list[str]:
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)]
