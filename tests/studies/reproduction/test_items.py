"""Every item of the paper, made of few worlds."""

from __future__ import annotations

from pathlib import Path

import pytest

from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.policies import load_shipped
from ethbrake_marl.studies import reproduction
from ethbrake_marl.studies.reproduction import GAPS, ITEMS, Item, Made, Reproduction, summarise_verdicts

PAPER = Path(__file__).resolve().parents[3] / "docs" / "paper.md"


OUTCOMES = {"agrees", "differs", "cannot agree", "undecided", "not run"}


@pytest.fixture(scope="module")
def made_of(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Made]:
    """Every item of ten worlds, made once."""
    settings = Reproduction("quick", tmp_path_factory.mktemp("reproduction"), 10)
    return {item.name: item.make(settings) for item in ITEMS}


@pytest.mark.parametrize("name", [item.name for item in ITEMS])
def test_item__has_verdicts_parameters_tables_and_data(made_of: dict[str, Made], name: str) -> None:
    made = made_of[name]
    assert made.verdicts and {verdict.outcome for verdict in made.verdicts} <= OUTCOMES
    assert all(verdict.because for verdict in made.verdicts)
    assert "\n" not in summarise_verdicts(made.verdicts).because
    stated = {parameter.name: parameter.origin.startswith("stated") for parameter in made.parameters}
    assert stated["masses"] and stated["braking capacities"]
    assert not stated["restitution e"] and not stated["time step"] and not stated["horizon"]
    assert made.tables and all(len(row) == len(table.columns) for table in made.tables for row in table.rows)
    assert made.data and all(text.count("\n") > 1 for text in made.data.values())
    if name not in ("hybrid-table", "random-table", "learning-high", "learning-low"):
        assert made.figures


@pytest.mark.parametrize("item", ITEMS, ids=[item.name for item in ITEMS])
def test_item__labels_are_those_of_the_paper(item: Item) -> None:
    page = PAPER.read_text("utf-8")
    assert all(f"`{label}`" in page for label in item.labels)


def test_items__speak_of_both_readings(made_of: dict[str, Made]) -> None:
    for name, made in made_of.items():
        text = " ".join(verdict.what for verdict in made.verdicts)
        if name != "gaps":  # whose register has it as one of its rows
            assert "as stated" in text and "0.2 s" in text, name


def test_trajectories__of_the_scenarios_have_no_impact_under_the_policies(made_of: dict[str, Made]) -> None:
    (table,) = made_of["trajectories"].tables
    assert {row[3] for row in table.rows if row[2] in ("PPO", "SAC")} == {0}


def test_choose_items__in_the_order_of_the_paper() -> None:
    assert [item.name for item in Reproduction.choose(["random-table", "harm-delays"])] == [
        "harm-delays",
        "random-table",
    ]
    assert len(Reproduction.choose([])) == len(ITEMS)
    with pytest.raises(UnknownName, match="did you mean 'harm-delays'"):
        Reproduction.choose(["harm-delay"])
    with pytest.raises(InvalidInput, match="given twice"):
        Reproduction.choose(["gaps", "gaps"])


def test_register__every_gap_says_what_the_paper_says_and_what_is_measured() -> None:
    names = [gap.name for gap in GAPS]
    assert len(set(names)) == len(names)
    for gap in GAPS:
        assert gap.paper and gap.ours
        assert bool(gap.alternatives) != gap.otherwise.startswith(("trained by --full: ", "not measured: ")), gap.name


def test_hybrid__is_driven_anew_once_its_policy_was_trained(
    settings: Reproduction, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = reproduction._drive_hybrid("paper-random", settings, reproduction.READINGS[0])
    assert reproduction._drive_hybrid("paper-random", settings, reproduction.READINGS[0]) is first
    monkeypatch.setattr(reproduction, "unconverged_policy", lambda _: (load_shipped("ppo"), "trained since"))
    assert reproduction._drive_hybrid("paper-random", settings, reproduction.READINGS[0]) is not first
