"""Who knows what, in every form that a result takes."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import Evaluation, evaluate, summarise, write_per_world
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.pages.report import Report
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.studies.experiment import results_csv

# Some of the few worlds of `cooperation-2-blocked` are those of a shipped table.
pytestmark = pytest.mark.filterwarnings("ignore::ethbrake_marl.errors.IncompleteTable")

SPECS = ("full_brake", "ppo@shipped/ppo", "ppo@shipped/ppo+episode", "e_v2x_bm:pairwise")
KNOWN = ("own sensors", "messages", "messages + true model", "true state")
BLOCKED = load_scenario("cooperation-2-blocked")


class Silent:
    name = "silent"

    def act(self, worlds, vehicle):
        return np.zeros(worlds.n)


def evaluation(v2x: object) -> Evaluation:
    scenario = BLOCKED.replace(v2x=v2x)
    agents = {**make_lineup(SPECS, scenario), "mine": Silent()}
    return evaluate(scenario.sample(12, 7), agents, scenario=scenario, seed=7)


@pytest.fixture(scope="module")
def hiding() -> Evaluation:
    return evaluation("blocked")


@pytest.fixture(scope="module")
def clear() -> Evaluation:
    return evaluation({"preset": "paper", "link_latency_s": 0.2, "senses": "both"})


def terminal(result: Evaluation) -> str:
    console = Console(width=160, file=io.StringIO(), color_system=None)
    console.print(summarise(result).terminal())
    return " ".join(console.file.getvalue().split())


def told(result: Evaluation) -> tuple[str, ...]:
    """Everything that is written about a result for people."""
    return terminal(result), summarise(result).markdown(), Report("Mine", summarise(result), result).html


def test_knowledge__is_a_column_of_every_table(clear: Evaluation) -> None:
    rows = summarise(clear)
    assert [row.to_json()["knows"] for row in rows] == [*KNOWN, "not stated"]
    for text in (rows.markdown(), Report("Mine", rows, clear).html, terminal(clear)):
        for spec, known in (*zip(SPECS, KNOWN, strict=True), ("mine", "not stated")):
            assert spec in text and known in text
    lines = rows.markdown().splitlines()
    assert lines[0].startswith("| Agent | Knows | ")
    assert lines[4].startswith("| ppo@shipped/ppo+episode | messages + true model | ")
    assert {line.count("|") for line in lines[:7]} == {lines[0].count("|")}
    flat = list(csv.DictReader(io.StringIO(results_csv(rows))))
    assert [row["knows"] for row in flat] == [*KNOWN, "not stated"]


def test_knowledge__a_hiding_channel_marks_who_sees_through_it(hiding: Evaluation) -> None:
    rows = summarise(hiding)
    share = hiding.hidden.mean()
    assert 0.0 < share < 1.0
    assert [row.to_json()["sees_through_channel"] for row in rows] == [False, False, True, True, False]
    assert {row.to_json()["hidden_share"] for row in rows} == {share}
    for text in told(hiding):
        assert "† messages + true model" in text and "† true state" in text
        assert "† messages |" not in text and "† own sensors" not in text
        assert f"In {100 * share:.1f} % of these worlds the channel hides something" in text
        assert "† ppo@shipped/ppo+episode, e_v2x_bm:pairwise: drives by the line as it is" in text
        assert "Not stated what it knows: mine." in text


@pytest.mark.parametrize("v2x", ["paper", {"preset": "paper", "link_latency_s": 0.2, "senses": "both"}])
def test_knowledge__where_nothing_is_hidden_nobody_is_marked(v2x: object) -> None:
    result = evaluation(v2x)
    assert not hidden_words(result)
    assert {row.to_json()["sees_through_channel"] for row in summarise(result)} == {False}
    assert not result.hidden.any()


def hidden_words(result: Evaluation) -> list[str]:
    page = Report("Mine", summarise(result), result).html.partition(">How to read the tables</h2>")[0]
    texts = (terminal(result), summarise(result).markdown(), page)
    return [word for text in texts for word in ("†", "hides", "Not stated") if word in text]


def test_knowledge__stands_in_every_line_of_the_worlds(tmp_path: Path, hiding: Evaluation) -> None:
    write_per_world(tmp_path / "out.csv", hiding)
    with (tmp_path / "out.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["knows"] for row in rows] == [each for each in (*KNOWN, "not stated") for _ in range(12)]
    assert [int(row["hidden"]) for row in rows] == 5 * hiding.hidden.astype(int).tolist()


def test_knowledge__a_word_that_is_none_is_refused_before_anybody_drives() -> None:
    agent = Silent()
    agent.knows = "all"
    scenario = load_scenario("paper-random")
    with pytest.raises(InvalidInput, match="agent 'silent': knows = 'all'"):
        evaluate(scenario.sample(2, 7), {"mine": agent}, scenario=scenario)
