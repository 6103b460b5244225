"""Names, materials and subsets: what names tell beyond doubt."""

import pytest

from avmsf.datasets.numbering import (
    ABLATION,
    NON_SYMMETRIC,
    REALIMPACT_NAMES,
    in_order,
    material_in,
    number_of,
    shared_objects,
)

# Numbers that no folder of ObjectFolder Real has; of 98 and 99 one is missing as well.
FOLDERS = set(range(1, 104)) - {72, 82, 98}


@pytest.mark.parametrize(
    ("name", "material"),
    [
        ("3_CeramicKoiBowl", "ceramic"),
        ("61_PlanterCeramic", "ceramic"),
        ("33_WoodWineGlass", "wood"),
        ("94_GlassGoblet", "glass"),
        ("0_WineGlass", None),
        ("93_GreenGoblet", None),
        ("91_MetalSpoon", None),
        ("97_PlasticScoop", None),
        ("62_Pot_Hexagonal", None),
        ("10_bowl", None),
    ],
)
def test_a_material_is_inferred_where_the_name_leaves_no_doubt(name: str, material: str | None) -> None:
    assert material_in(name) == material


def test_the_paper_s_subsets_are_folders_that_exist() -> None:
    assert (len(set(ABLATION)), len(set(NON_SYMMETRIC))) == (10, 16)
    assert {int(name) for name in (*ABLATION, *NON_SYMMETRIC)} <= FOLDERS
    assert set(shared_objects()) <= FOLDERS


def test_numbers_order_names() -> None:
    assert in_order(["10", "b", "9", "a", "100_x"]) == ("9", "10", "100_x", "a", "b")
    assert in_order(REALIMPACT_NAMES) == REALIMPACT_NAMES
    assert len(shared_objects()) == len({number_of(name) for name in REALIMPACT_NAMES}) == 50
