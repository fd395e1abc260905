"""The paper's rows beside ours: arithmetic of the printed numbers, and bounds that exclude them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.evaluation.measures import PAPER_ROWS, PaperRow
from ethbrake_marl.studies.reproduction import (
    FULL_BRAKE,
    NAMES,
    NOBODY,
    READINGS,
    Beside,
    compare_rows,
    decrease_verdict,
    lineup,
    rows_table,
    selection_verdict,
)

AS_STATED, AT_200_MS = READINGS
RATE = "collision rate"


def printed(table: str, agent: str) -> PaperRow:
    return next(row for row in PAPER_ROWS if (row.table, row.agent) == (table, agent))


def beside(reading, worlds: int = 400) -> Beside:
    scenario = reading.scenario("paper-random")
    agents = lineup(scenario, FULL_BRAKE)
    evaluation = evaluate(scenario.sample(worlds, 7), agents, scenario=scenario, aftermath=False)
    return Beside(reading.name, evaluation, {"Non-E": (NAMES[FULL_BRAKE],), "Hybrid PPO": (NAMES[FULL_BRAKE],)})


def test_selection__the_printed_hybrid_avoids_more_than_its_parts() -> None:
    rows = [printed("hybrid test", agent) for agent in ("E-V2X-BM", "Standalone DRL", "Hybrid")]
    verdict = selection_verdict(*rows)
    assert verdict.outcome == "cannot agree"
    assert "737 + 1,263 = 2,000 collisions; printed: 2,005" in verdict.because
    possible = replace(rows[2], collisions=3_000)
    assert selection_verdict(*rows[:2], possible).outcome == "agrees"


def test_decrease__follows_from_the_printed_harms() -> None:
    baseline, row = printed("random test", "Non-E"), printed("random test", "Hybrid PPO")
    assert decrease_verdict(row, baseline).outcome == "agrees"
    assert decrease_verdict(replace(row, harm_decrease=0.85), baseline).outcome == "cannot agree"


def test_compare_rows__full_braking_agrees_at_200_ms_and_the_hybrid_is_excluded_as_stated() -> None:
    besides = [beside(AS_STATED, 1_000), beside(AT_200_MS, 1_000)]
    rows = [printed("random test", agent) for agent in ("Non-E", "Hybrid PPO")]
    found = {verdict.what: verdict for verdict in compare_rows(rows, besides)}
    stated, early = found["Non-E, average harm (as stated)"], found[f"Non-E, average harm ({AT_200_MS.name})"]
    assert (stated.outcome, early.outcome) == ("differs", "agrees")
    assert f"nearest: {NAMES[FULL_BRAKE]} ({AT_200_MS.name})" in stated.because
    assert found["Hybrid PPO, collision rate (as stated)"].outcome in ("cannot agree", "differs")
    impossible = replace(rows[1], collision_rate=0.3)
    (first, *_) = compare_rows([impossible], besides)
    assert first.outcome == "cannot agree"
    assert "in which no command avoids an impact: at least" in first.because


def test_rows_table__ends_with_what_nobody_undercuts() -> None:
    own = beside(AS_STATED)
    table = rows_table(own)
    assert table.rows[-1][0] == NOBODY
    assert own.numbers[NOBODY][RATE].value <= own.numbers[NAMES[FULL_BRAKE]][RATE].value
    assert all(len(row) == len(table.columns) for row in table.rows)


@pytest.mark.parametrize("row", PAPER_ROWS)
def test_printed_rows__rates_follow_from_counts(row: PaperRow) -> None:
    assert row.collisions / row.episodes == pytest.approx(row.collision_rate, abs=1e-4)
