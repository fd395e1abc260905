"""``ethbrake reproduce``: what it prints, writes, keeps and refuses."""

import json
from pathlib import Path

import pytest

from ethbrake_marl.errors import AlreadyExists
from ethbrake_marl.extensions.reproduction import items
from ethbrake_marl.extensions.reproduction.made import Item, Made, Settings
from ethbrake_marl.extensions.reproduction.verdicts import Verdict
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from tests.fixtures.commands import Command, Refuse, told_json
from tests.refused import refused

NAMES = [
    "learning-high", "learning-low", "harm-distance", "harm-delays", "trajectories", "accelerations",
    "hybrid-illustration", "hybrid-table", "random-table", "gaps",
]  # fmt: skip


def test_list__has_every_item_in_the_order_of_the_paper(ethbrake: Command) -> None:
    rows = told_json(ethbrake("reproduce", "--list", "--json"))
    assert [row["Item"] for row in rows] == NAMES
    assert [row["Label in the paper"] for row in rows[-3:]] == ["Table:hybrid", "Table:Random", ""]
    assert [row["Item"] for row in told_json(ethbrake("reproduce", "gaps", "harm-delays", "--list", "--json"))] == [
        "harm-delays", "gaps",
    ]  # fmt: skip


def test_cost__counts_the_trainings_that_are_missing(ethbrake: Command, empty_folder: Path) -> None:
    quick = ethbrake("reproduce", "hybrid-table", "learning-low", "--cost").err
    assert "to do: 2 items, at most about 16 s of one core; trainings before them about 0.1 min" in quick
    assert "trainings before them about 18.4 min" in ethbrake("reproduce", "--full", "--cost").err
    assert "trainings" not in ethbrake("reproduce", "gaps", "--cost").err
    assert not list(empty_folder.iterdir())


def test_reproduce__writes_page_figures_and_tables(ethbrake: Command, empty_folder: Path) -> None:
    done = ethbrake("reproduce", "accelerations", "harm-delays", "--episodes", "3", "--output", "out", "--json")
    results = told_json(done)
    assert [each["name"] for each in results] == ["harm-delays", "accelerations"]
    assert results[1]["verdict"]["outcome"] == "differs" and len(results[1]["comparisons"]) == 8
    assert results[1]["tables"]["Commands of Vehicle 2"][0]["First command"] == pytest.approx(6.4, abs=1.0)
    page = Path("out/README.md").read_text("utf-8")
    assert "Made by `ethbrake reproduce harm-delays accelerations --quick --episodes 3` on 20" in page
    assert page.index("## Harm at three delays") < page.index("## Acceleration profiles")
    assert "](accelerations/accelerations.svg)" in page and "**differs**: of 8 comparisons 3 differ, 5 agree" in page
    for name in ("accelerations.svg", "accelerations.pdf", "commands-of-vehicle-2.csv", "commands-of-vehicle-2.tex"):
        assert Path("out/accelerations", name).stat().st_size > 200
    assert done.err.endswith("page: out/README.md\n")


def planted(name: str, because: str = "b", outcome: str = "agrees") -> Item:
    """An item that needs no time."""
    sheet = Sheet("A table, 1 m/s", ("Who", Column("Harm")), [("PPO | H*", Estimate(1.5, (1.25, 1.75)))], "Of 24.")
    made = Made([Verdict("w", outcome, because)], [sheet], notes=["A note."])  # type: ignore[arg-type]
    return Item(name, ("Fig:x",), "A title", "What it is.", lambda settings: made, 1.0)


def test_page__by_hand(tmp_path: Path) -> None:
    items.reproduce(Settings(tmp_path / "out", episodes=24), [planted("gaps")], "a machine")
    text = (tmp_path / "out/README.md").read_text("utf-8")
    _, rest = text.split("| Item | Verdict | Because |\n| --- | --- | --- |\n")
    assert rest == (
        "| gaps | agrees | w: b |\n\n## A title\n\nWhat it is. In the paper's source: `Fig:x`.\n\n**agrees**: w: b\n\n"
        "A note.\n\n### A table, 1 m/s\n\n| Who | Harm |\n| --- | ---: |\n| PPO \\| H\\* | 1.50 [1.25, 1.75] |\n\n"
        "Of 24.\n\n### Comparisons\n\n| Comparison | Verdict | Because |\n| --- | --- | --- |\n| w | agrees | b |\n"
    )
    assert (
        tmp_path / "out/gaps/a-table-1-m-s.csv"
    ).read_text() == "Who,Harm,Harm_low,Harm_high\nPPO | H*,1.5,1.25,1.75\n"


def test_folder__same_settings_replace_others_need_force_and_trainings_stay(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    (folder / "trainings").mkdir(parents=True)
    (folder / "trainings" / "kept").touch()
    for because in ("b", "c"):
        items.reproduce(Settings(folder, episodes=24), [planted("gaps", because)], "m")
        assert f"w: {because}" in (folder / items.PAGE).read_text()
    other = Settings(folder, episodes=30)
    with refused("a reproduction with other settings (episodes 24, now 30)"):
        items.reproduce(other, [planted("gaps")], "m")
    items.reproduce(other, [planted("gaps", "d")], "m", force=True)
    assert "w: d" in (folder / items.PAGE).read_text() and (folder / "trainings" / "kept").exists()
    assert json.loads((folder / items.RECORD).read_text())["episodes"] == 30


def test_folder__of_somebody_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("text")
    for force in (False, True):
        with refused("does not contain a reproduction", AlreadyExists):
            items.reproduce(Settings(tmp_path), [planted("gaps")], "m", force=force)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_interrupted__training_makes_no_item(tmp_path: Path, monkeypatch, ethbrake: Command) -> None:
    monkeypatch.setattr(items, "train", lambda *given: False)
    assert items.reproduce(Settings(tmp_path / "out"), [planted("gaps")], "m") is None
    assert not (tmp_path / "out" / items.PAGE).exists()
    done = ethbrake("reproduce", "gaps", "--output", str(tmp_path / "again"))
    assert done.status == 130 and "interrupted; finished trainings remain; repeat the command" in done.err


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("gasp", "unknown item 'gasp'; did you mean 'gaps'?"),
        ("gaps gaps", "item 'gaps' is given twice"),
        ("--quick --full", "--quick and --full cannot be combined"),
        ("--episodes 1", "--episodes"),
    ],
)
def test_refusals(refuse: Refuse, line: str, message: str) -> None:
    refuse(f"reproduce {line}", message)
