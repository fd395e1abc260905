"""NGSIM in the two forms in which it is handed out, in feet."""

from pathlib import Path

import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.recorded.scenario import scenario_from_data
from tests.extensions.recorded.made import rows_of
from tests.fixtures.recordings import NGSIM, write_files

# Three cars 60 ft apart, 15 ft long, at 40 ft/s: gaps of 45 ft.
ROWS = ["13.716,13.716,12.192,12.192,12.192"]
CARS = [("1,308", 300.0, "0"), ("1,309", 240.0, "1,308"), ("1,310", 180.0, "1,309")]  # vehicle, Local_Y, Preceding


def portal(who: str, y: float, ahead: str, street: str = "us-101") -> list[str]:
    """Cells of a row as the portal shows them, thousands with separators in text columns."""
    cells = [
        who.replace(",", ""),
        "11",
        "1,117",
        "1118846979700",
        "20.5",
        f"{y}",
        "6451213.3",
        "1873343.4",
        "15.0",
        "6.1",
    ]
    return [*cells, "2", "40.00", "0.00", "2", *[""] * 6, ahead, "0", "60.00", "9,999.99", street]


def form_of_portal(street: str = "us-101") -> list[str]:
    """A file as the portal exports it: quotes around cells with a comma."""
    rows = (portal(*car, street) for car in CARS)
    return [NGSIM, *(",".join(f'"{cell}"' if "," in cell else cell for cell in row) for row in rows)]


def form_of_api() -> list[str]:
    """A file as the portal's API sends it: lower-case names, all cells in quotes."""
    names = NGSIM.lower().split(",")
    return [",".join(f'"{cell}"' for cell in row) for row in [names, *(portal(*car) for car in CARS)]]


FORMS = {"portal.csv": form_of_portal(), "api.csv": form_of_api()}


@pytest.mark.parametrize("name", FORMS)
def test_form__gives_three_cars_60_feet_apart(name: str, tmp_path: Path) -> None:
    made = scenario_from_data("mine", write_files(tmp_path, {name: FORMS[name]}), "ngsim")
    assert rows_of(made) == ROWS and f"{name}: 1308-1309-1310" in made.csv
    assert "CC BY-SA" in made.text and "same licence" in made.text


def test_rows_of_streets__are_said_to_be_all(tmp_path: Path) -> None:
    street = "peachtree"
    right = "contains no rows of data except those from lankershim and peachtree"
    with pytest.raises(InvalidInput, match=right):
        scenario_from_data("mine", write_files(tmp_path, {"a.csv": form_of_portal(street)}), "ngsim")
    some = form_of_portal("i-80") + form_of_portal(street)[1:]
    assert rows_of(scenario_from_data("mine", write_files(tmp_path, {"a.csv": some}), "ngsim")) == ROWS


@pytest.mark.parametrize(
    ("name", "old", "new", "right"),
    [
        (
            "portal.csv",
            '"1,309"',
            '"1,3o9"',
            "portal.csv, line 4, column Preceding: must be a finite number, but is '1,3o9'",
        ),
        ("api.csv", '"15.0"', '"15 ft"', "api.csv, line 2, column v_length: must be a finite number, but is '15 ft'"),
        ("api.csv", '"40.00"', '"40.00', "api.csv: cannot be read .*Row #1: Expected 25 columns, got 24"),
    ],
)
def test_fault__is_named_with_its_line(name: str, old: str, new: str, right: str, tmp_path: Path) -> None:
    changed = "\n".join(FORMS[name]).replace(old, new, 1 if name != "portal.csv" else 2).splitlines()
    with pytest.raises(InvalidInput, match=right):
        scenario_from_data("mine", write_files(tmp_path, {name: changed}), "ngsim")
