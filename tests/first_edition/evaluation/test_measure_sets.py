"""Sets of measures: what an evaluation says without any installed one, and what a set of one's own adds to it."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl import registry
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.first_edition.evaluation.chunks import Lineup, summarise_tally, tally_list
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.measure_sets import (
    MEASURE_SETS,
    Measure,
    MeasureSet,
    Silent,
    register_measure_set,
)
from ethbrake_marl.first_edition.evaluation.per_world import write_per_world
from ethbrake_marl.first_edition.evaluation.summary import summarise
from ethbrake_marl.first_edition.evaluation.summary_row import SummaryRow

PAPER = eb.load_scenario("paper-random")
AGENTS = ["full_brake", "coast"]


@pytest.fixture
def core_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """No package gives a set of measures."""
    given = registry.points
    monkeypatch.setattr(registry, "points", lambda group: {} if group == MEASURE_SETS.group else given(group))
    MEASURE_SETS.loaded.clear()


@pytest.fixture
def driven(core_alone: None) -> Evaluation:
    return eb.evaluate(agents=AGENTS, scenario=PAPER, episodes=20)


def rows_of(folder: Path, evaluation: Evaluation) -> list[dict[str, str]]:
    write_per_world(folder / "worlds.csv", evaluation)
    return list(csv.DictReader(io.StringIO((folder / "worlds.csv").read_text())))


class Hardest(MeasureSet):
    """Harm as a share of the hardest first impact in the same world; silent where nobody collides."""

    measures = (
        Measure("share_of_hardest", lambda o, most: o.first_impact_harm / most, "Of the hardest", about="A share."),
        Measure("hardest_decrease", "share_of_hardest", against="decrease"),
    )
    counted = (Measure("is_hard", lambda o, most: o.first_impact_harm > 1.0),)
    baseline, whole, narrow, notebook = "coast", "is_hard", ("share_of_hardest",), ("share_of_hardest",)
    per_world: Mapping[str, Any] = {"hardest": lambda o, most: most}
    because_key, not_in_long_lists = "no_hardest_because", "the hardest is not asked there"

    def __init__(self) -> None:
        self.asked = 0

    def prepare(self, evaluation: Evaluation) -> Any:
        self.asked += 1
        most = sum(outcome.first_impact_harm for outcome in evaluation.outcomes.values())
        return most if (most > 0.0).all() else Silent("nobody collides in some world")

    def row(self, tally: Any, worlds: int, context: Any) -> dict[str, Any]:
        return {"hard_share": tally.share("is_hard", worlds)}

    def warnings(self, rows: Any) -> list[str]:
        return ["this is a test"]

    def notes(self, rows: list[SummaryRow]) -> list[str]:
        return [f"{rows[0].agent}: {rows[0].more['hardest']['hard_share']}."]


def test_set__adds_to_table_json_conditions_and_files(driven: Evaluation, tmp_path: Path) -> None:
    hardest = Hardest()
    register_measure_set("hardest", hardest)
    colliding = driven.take(driven.outcome("full_brake").collided)
    table, lines = summarise(colliding), rows_of(tmp_path, colliding)
    assert hardest.asked == 1  # once for everybody who asks
    harm = [colliding.outcome(agent).first_impact_harm for agent in AGENTS]
    assert table[0]["share_of_hardest"].value == pytest.approx((harm[0] / sum(harm)).mean())
    assert table[0]["hardest_decrease"].value > 0.0 == table[1]["hardest_decrease"].value  # compared with coast
    assert float(lines[0]["hardest"]) == sum(harm)[0]
    row = table[0].to_json()
    assert row["hard_share"] == 1.0 and row["parameters"]["no_hardest_because"] is None
    for text in (str(table), table.markdown()):
        assert "full_brake: 1.0." in text and "WARNING: this is a test." in text
    assert table.meanings()["Of the hardest"] == "A share."


def test_set__is_silent_with_its_reason(driven: Evaluation, tmp_path: Path) -> None:
    register_measure_set("hardest", Hardest())
    apart = eb.evaluate(agents=["full_brake"], scenario=PAPER.replace(gaps_m=300.0), episodes=3)
    (row,) = summarise(apart)
    assert row["share_of_hardest"] is None and row.to_json()["hard_share"] is None
    assert row.parameters["no_hardest_because"] == "nobody collides in some world"
    assert {line["hardest"] for line in rows_of(tmp_path, apart)} == {""}
    lineup = Lineup.of(["coast"], PAPER)
    (long,) = summarise_tally(lineup, tally_list(lineup, 20, 7), 7)
    assert long.parameters["no_hardest_because"] == "the hardest is not asked there"


def test_set__that_is_none_or_has_a_name_twice_is_refused(core_alone: None) -> None:
    with pytest.raises(InvalidInput, match="must be a MeasureSet"):
        register_measure_set("none", "none")  # type: ignore[arg-type]

    class Twice(MeasureSet):
        measures = (Measure("total_harm", lambda o, _: o.total_harm),)

    with pytest.raises(AlreadyExists, match="another set already has measures with the names total_harm"):
        register_measure_set("twice", Twice())
