"""Names and materials: what names tell beyond doubt, and the published list brought to the folders' numbers."""

import json
from pathlib import Path

import pytest

from avmsf.datasets.names import facts_of, read_names
from avmsf.datasets.numbering import REALIMPACT_NAMES, folder_number, in_order, material_in, shared_objects
from avmsf.datasets.subsets import ABLATION, NON_SYMMETRIC
from avmsf.errors import DatasetError
from factories.raising import raises

# Numbers that no folder of ObjectFolder Real has; of 98 and 99 one is missing as well.
FOLDERS = set(range(1, 104)) - {72, 82, 98}


def test_the_list_without_gaps_meets_the_folders_one_by_one() -> None:
    numbers = [folder_number(published, FOLDERS) for published in range(1, 101)]
    assert sorted(number for number in numbers if number is not None) == sorted(FOLDERS)
    # The shifts grow by one where a number is unused.
    assert [numbers[published - 1] for published in (71, 72, 80, 81, 95, 96, 97, 100)] == [
        71, 73, 81, 83, 97, 99, 100, 103,
    ]  # fmt: skip
    assert folder_number(101, FOLDERS) is None


def test_the_ninety_sixth_stays_open_where_both_or_neither_are_there() -> None:
    assert folder_number(96, {98}) == 98
    assert folder_number(96, {98, 99}) is None
    assert folder_number(96, set()) is None


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
def test_materials_are_told_where_the_name_leaves_no_doubt(name: str, material: str | None) -> None:
    assert material_in(name) == material


def test_without_a_list_the_name_is_realimpact_s_and_inferred() -> None:
    assert facts_of("28", {}).name == "wood plate square"
    assert (facts_of("28", {}).material, facts_of("28", {}).inferred) == ("wood", True)
    assert (facts_of("1", {}).name, facts_of("1", {}).material, facts_of("1", {}).inferred) == ("1", None, False)


@pytest.mark.parametrize("suffix", [".csv", ".json"])
def test_a_published_list_is_mapped(tmp_path: Path, suffix: str) -> None:
    rows = [("7", "Big_Tray", "Ceramic"), ("84", "Small_Tray", "Steel"), ("96", "Lid", "")]
    path = tmp_path / f"objects{suffix}"
    if suffix == ".csv":
        path.write_bytes("\r\n".join(["Index, Name, Material", *(", ".join(row) for row in rows), ""]).encode())
    else:
        path.write_text(json.dumps([dict(zip(("id", "name", "material"), row, strict=True)) for row in rows]))
    facts = read_names(path, FOLDERS)
    assert {number: (each.name, each.material, each.inferred) for number, each in facts.items()} == {
        7: ("Big Tray", "ceramic", True),
        86: ("Small Tray", "steel", True),
        99: ("Lid", None, True),
    }


def test_numbers_beyond_the_list_are_the_folders_own(tmp_path: Path) -> None:
    (tmp_path / "own.csv").write_text("id,name,material\n86,Tray,steel\n103,Tool,plastic\n")
    facts = read_names(tmp_path / "own.csv", FOLDERS)
    assert (facts[86].identifier, facts[86].inferred, facts[103].name) == ("86", False, "Tool")


@pytest.mark.parametrize(
    ("name", "text", "row", "value", "cause"),
    [
        ("a.csv", "number,name\n1,Tray\n", 2, ("number", "name"), type(None)),
        ("a.csv", "id,name\nfour,Tray\n", 2, ("four", "Tray"), type(None)),
        ("a.csv", "id,name\n4,Tray\n4,Cup\n", 3, 4, type(None)),
        ("a.csv", "id,name\n", None, 0, type(None)),
        ("a.json", '{"1": "Tray"}', None, None, ValueError),
        ("a.json", '[{"id": 1, "name": "Tray"}, {"id": 0, "name": "Cup"}]', 1, ("0", "Cup"), type(None)),
        ("a.json", "[", None, None, json.JSONDecodeError),
        ("b.csv", None, None, None, FileNotFoundError),
    ],
)
def test_lists_of_another_form_are_refused(
    tmp_path: Path, name: str, text: str | None, row: int | None, value: object, cause: type[Exception]
) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with raises(DatasetError, file=name, row=row, value=value) as caught:
        read_names(tmp_path / name, FOLDERS)
    assert type(caught.value.__cause__) is cause


def test_the_paper_s_subsets_are_folders_that_exist() -> None:
    assert (len(set(ABLATION)), len(set(NON_SYMMETRIC))) == (10, 16)
    assert {int(name) for name in (*ABLATION, *NON_SYMMETRIC)} <= FOLDERS
    assert set(shared_objects()) <= FOLDERS


def test_numbers_order_names() -> None:
    assert in_order(["10", "b", "9", "a", "100_x"]) == ("9", "10", "100_x", "a", "b")
    assert in_order(REALIMPACT_NAMES) == REALIMPACT_NAMES
