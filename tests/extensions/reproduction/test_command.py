"""``ethbrake reproduce``: what it prints, writes, keeps and refuses."""

from pathlib import Path

import pytest

from ethbrake_marl.errors import AlreadyExists
from ethbrake_marl.extensions.reproduction import items
from ethbrake_marl.extensions.reproduction.made import Item, Made, Settings
from ethbrake_marl.extensions.reproduction.verdicts import Verdict
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from tests.fixtures.commands import Command, Refuse, told_json
from tests.refused import refused


def test_list__has_the_items_in_the_order_of_the_paper(ethbrake: Command) -> None:
    rows = told_json(ethbrake("reproduce", "gaps", "random-table", "learning-low", "--list", "--json"))
    assert [row["Item"] for row in rows] == ["learning-low", "random-table", "gaps"]
    assert [row["Label in the paper"] for row in rows] == ["fig:ppo_sac_low_latency", "Table:Random", ""]


def test_cost__counts_the_trainings_that_are_missing(ethbrake: Command, empty_folder: Path) -> None:
    quick = ethbrake("reproduce", "hybrid-table", "learning-low", "--cost").err
    assert "to do: 2 items, at most about 16 s of one core; trainings before them about 0.1 min" in quick
    assert "trainings before them about 18.4 min" in ethbrake("reproduce", "--full", "--cost").err
    assert "trainings" not in ethbrake("reproduce", "gaps", "--cost").err
    assert not list(empty_folder.iterdir())


def test_reproduce__writes_page_figures_and_tables(ethbrake: Command, empty_folder: Path) -> None:
    done = ethbrake("reproduce", "accelerations", "--episodes", "3", "--output", "out", "--json")
    (result,) = told_json(done)
    assert result["name"] == "accelerations" and result["verdict"]["outcome"] == "differs"
    assert len(result["comparisons"]) == 8 and len(result["tables"]["Commands of Vehicle 2"]) == 16
    page = Path("out/README.md").read_text("utf-8")
    assert "Made by `ethbrake reproduce accelerations --quick --episodes 3` on 20" in page
    assert "](accelerations/accelerations.svg)" in page and "**differs**: of 8 comparisons 3 differ, 5 agree" in page
    for name in ("accelerations.svg", "accelerations.pdf", "commands-of-vehicle-2.csv", "commands-of-vehicle-2.tex"):
        assert Path("out/accelerations", name).stat().st_size > 200
    assert done.err.endswith("page: out/README.md\n")


def planted(because: str) -> Item:
    """An item that needs no time."""
    sheet = Sheet("A table, 1 m/s", ("Who", Column("Harm")), [("PPO | H*", Estimate(1.5, (1.25, 1.75)))], "Of 24.")
    made = Made([Verdict("w", "agrees", because)], [sheet], notes=["A note."])
    return Item("gaps", ("Fig:x",), "A title", "What it is.", lambda settings: made, 1.0)


def test_page__by_hand_and_results_are_replaced_by_force_alone(tmp_path: Path) -> None:
    settings = Settings(tmp_path / "out", episodes=24)
    items.reproduce(settings, [planted("b")], "a machine")
    text = (tmp_path / "out/README.md").read_text("utf-8")
    _, rest = text.split("| Item | Verdict | Because |\n| --- | --- | --- |\n")
    assert rest == (
        "| gaps | agrees | w: b |\n\n## A title\n\nWhat it is. In the paper's source: `Fig:x`.\n\n**agrees**: w: b\n\n"
        "A note.\n\n### A table, 1 m/s\n\n| Who | Harm |\n| --- | ---: |\n| PPO \\| H\\* | 1.50 [1.25, 1.75] |\n\n"
        "Of 24.\n\n### Comparisons\n\n| Comparison | Verdict | Because |\n| --- | --- | --- |\n| w | agrees | b |\n"
    )
    table = tmp_path / "out/gaps/a-table-1-m-s.csv"
    assert table.read_text() == "Who,Harm,Harm_low,Harm_high\nPPO | H*,1.5,1.25,1.75\n"
    with refused("README.md: already exists", AlreadyExists):
        items.reproduce(settings, [planted("c")], "m")
    items.reproduce(settings, [planted("d")], "m", force=True)
    assert "w: d" in (settings.folder / items.PAGE).read_text()


def test_interrupted__training_makes_no_item(tmp_path: Path, monkeypatch, ethbrake: Command) -> None:
    monkeypatch.setattr(items, "train", lambda *given: False)
    done = ethbrake("reproduce", "gaps", "--output", str(tmp_path / "again"))
    assert done.status == 130 and "interrupted; finished trainings remain; repeat the command" in done.err
    assert not (tmp_path / "again" / items.PAGE).exists()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("gasp", "unknown item 'gasp'; did you mean 'gaps'?"),
        ("--quick --full", "--quick and --full cannot be combined"),
        ("--episodes 1", "--episodes"),
    ],
)
def test_refusals(refuse: Refuse, line: str, message: str) -> None:
    refuse(f"reproduce {line}", message)
