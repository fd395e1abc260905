"""A count of harm of a user's package, in searches, tables of best known harm, and reports."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import teams_of
from ethbrake_marl.episode.counts import COUNTS, HarmCount
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.comparison import Comparison
from ethbrake_marl.extensions.search import tables
from ethbrake_marl.extensions.search.best_harm import best_harm
from ethbrake_marl.extensions.search.pricing import problem_of
from ethbrake_marl.extensions.search.tables import BestHarmTable, best_stored
from tests.extending.test_counts import SHOVES

SCENARIO, GAME = eb.open_game("paper-random")


@pytest.fixture(autouse=True)
def _shoves(install: Callable[..., None]) -> None:
    install("shoves", SHOVES, counts={"shoves": "shoves:PART"})


def test_count__is_searched_and_its_table_is_for_its_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alert, file = SCENARIO.sample(5, 7), tmp_path / "shoves.npz"
    best_harm(GAME, alert, harm_counts=["shoves"], budget=60, threads=1).save(file)
    table, problem = BestHarmTable.load(file), problem_of(GAME, alert, harm_count="shoves")
    harm, profiles = table.stored(problem, COUNTS["shoves"])
    assert harm.tolist() == problem.value(problem.follow(profiles)).tolist() == table.harm["shoves"].tolist()
    agents = {name: eb.play_to_end(GAME, alert, team) for name, team in teams_of(
        "best_harm:60,e_v2x_bm", SCENARIO, harm_count="shoves").items()}  # fmt: skip
    costs = {name: last.harm("shoves") for name, last in agents.items()}
    assert (costs["best_harm:60"] <= costs["e_v2x_bm"] + 1e-9).all() and (costs["e_v2x_bm"] > 0.0).any()
    heavier = HarmCount(
        "shoves", 2.0 * COUNTS["shoves"].weight_array, "shove_cost", "shove cost", COUNTS["shoves"].requires
    )
    assert np.isinf(table.stored(problem, heavier)[0]).all()
    assert np.isinf(best_stored(problem, COUNTS["shoves"])[0]).all()
    monkeypatch.setattr(tables, "_load_shipped", lambda: (table,))
    assert best_stored(problem, COUNTS["shoves"])[0].tolist() == harm.tolist()
    result = eb.evaluate(alert, "full_brake", scenario="paper-random", harm_count="shoves", measures="limits")
    regret = result["full_brake"]["shove_cost"] - harm
    assert result["full_brake"]["regret_shoves"].tolist() == regret.tolist()
    assert "Regret, shove cost" in eb.summarise(result).sheet().headings


def test_count__without_a_table_has_no_regret_and_no_proof() -> None:
    result = eb.evaluate("paper-random", "full_brake", episodes=3, harm_count="shoves", measures="limits")
    assert "regret_honest" in result["full_brake"] and "regret_shoves" not in result["full_brake"]
    from ethbrake_marl.extensions.proofs.lower_bound import lower_bound

    with pytest.raises(InvalidInput, match="harm_count = 'shoves': a bound is proven only for first, total, honest"):
        lower_bound(SCENARIO.sample(2, 7), harm_count="shoves")


def test_count__stands_in_reports(tmp_path: Path) -> None:
    from ethbrake_marl.extensions.report.report import write_evaluation

    teams = teams_of("full_brake,e_v2x_bm", SCENARIO, harm_count="shoves")
    compared = Comparison.of(SCENARIO, teams, harm_count="shoves", episodes=20, seed=7, measures="limits")
    write_evaluation(tmp_path / "report.html", compared, "command")
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "e_v2x_bm costs" in page and "Agents minimise shove cost" in page and "Mean shove cost" not in page
    assert page.index("Shove cost") < page.index("First-impact harm")
