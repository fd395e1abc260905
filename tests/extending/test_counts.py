"""A count of harm of a user's package: everything that minimises, bounds or shows harm has it at once."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.episode.counts import COUNTS, EXACT_IMPACTS
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.motion.layout import PUSHED, TOTAL

SHOVES = f"""
import ethbrake_marl as eb

PART = eb.Part([0, 1, 0, 5, 0, 0], column="shove_cost", words="shove cost", requires=["{EXACT_IMPACTS}"])
"""


@pytest.fixture(autouse=True)
def _shoves(install: Callable[..., None]) -> None:
    install("shoves", SHOVES, counts={"shoves": "shoves:PART"})


def cost(state: Any) -> np.ndarray:
    """The count by hand: total harm, and 5 m/s times the push."""
    return state.line[:, TOTAL].sum(axis=1) + 5.0 * state.line[:, PUSHED].sum(axis=1)


def test_count__stands_in_columns_summaries_and_measures() -> None:
    result = eb.evaluate(
        "paper-random", "full_brake,e_v2x_bm,ppo", episodes=60, harm_count="shoves", measures="worst5,maximin"
    )
    own = result["e_v2x_bm"]
    assert own["predicted_harm"].tolist() == own["shove_cost"].tolist()
    assert {"shove_cost_3", "worst5_shoves", "maximin_shoves"} < {*own}
    by_hand = (
        result["ppo"]["total_harm"]
        + 5.0 * eb.evaluate("paper-random", "ppo", episodes=60, measures="pushed_mps")["ppo"]["pushed_mps"]
    )
    assert result["ppo"]["shove_cost"] == pytest.approx(by_hand)
    table = eb.summarise(result)
    assert "Agents minimise shove cost" in str(table) and {"Shove cost", "Worst 5 %, shove cost"} < {
        *table.sheet().headings
    }
    assert [row.remarks for row in table] == [[], [], ["trained for first-impact harm"]]
    (row, *_) = table.to_json()
    assert row["shove_cost"] == pytest.approx(result["full_brake"]["shove_cost"].mean())
    assert row["worst5_shoves"] > row["shove_cost"] and row["parameters"]["agent_settings"] == {"harm_count": "shoves"}


def test_count__is_rewarded_and_stands_in_recipes() -> None:
    _, game = eb.open_game("paper-random", reward={"harm": 1.0, "harm_count": "shoves"})
    state, paid = game.reset(eb.load_scenario("paper-random").sample(20, 7)), np.zeros(20)
    while not state.ended.all():
        state, step = game.step(state, np.ones((20, 1)))
        paid += step.reward[:, 1]
    assert (
        state.line[:, PUSHED].any()
        and -paid == pytest.approx(cost(state))
        and cost(state) == pytest.approx(state.harm("shoves"))
    )
    recipe = eb.load_recipe("ppo").replace(reward={"harm": 0.05, "harm_count": "shoves"})
    assert recipe.model_dump(mode="json")["reward"]["harm_count"] == "shoves"
    assert eb.load_recipe(recipe.model_dump(mode="json")) == recipe


@pytest.mark.parametrize("mode", ["step", "episode"])
def test_count__is_bounded_by_shields(mode: str) -> None:
    team = eb.shield(eb.make_agent("ppo"), mode=mode, scenario="paper-random", harm_count="shoves")
    scenario, game = eb.open_game("paper-random")
    alert = scenario.sample(60, 7)
    last = eb.play_to_end(game, alert, team)
    alone = eb.play_to_end(game, alert, eb.Team("alone", {2: eb.make_agent("ppo")}))
    memory = last.memories["shield"]
    least = memory.price if mode == "step" else np.minimum(memory.policy_harm, memory.bound_harm)
    assert (last.harm("shoves") == least).all() and (alone.harm("shoves") > least + 1.0).any()
    result = eb.evaluate("paper-random", {"guarded": team}, episodes=2)
    assert result.remarks["guarded"] == ["trained for first-impact harm", "bounds shove cost"]


def test_count__is_a_setting_of_commands(capsys: pytest.CaptureFixture[str]) -> None:
    line = "evaluate --episodes 3 --agents e_v2x_bm --set harm_count=shoves --json"
    assert run_command(line.split()) == 0
    assert json.loads(capsys.readouterr().out)[0]["shove_cost"] >= 0.0
    assert run_command(["scenario", "list"]) == 0 and "shoves" in capsys.readouterr().out


def test_count__needs_what_it_requires() -> None:
    eb.register_count("half", [0.5, 0, 0, 0, 0, 0], column="half_harm", words="half harm")
    assert eb.load_scenario("paper-random").sample(1, 7).harm("half").tolist() == [0.0]
    for name, weights, column, requires, told in (
        ("shoves", [1, 0, 0, 0, 0, 0], "other_cost", (), "count 'shoves' is registered already"),
        ("new", [1, 0, 0, 0, 0, 0], "total_harm", (), "column = 'total_harm': is the column of another count"),
        ("New", [1, 0, 0, 0, 0, 0], "new_cost", (), "name = 'New': must have the form"),
        ("new", [1, 0], "new_cost", (), "must be 6 finite numbers, each 0 or more"),
        ("new", "heavy", "new_cost", (), "must be 6 finite numbers, each 0 or more"),
        ("new", [1, 0, 0, -1, 0, 0], "new_cost", (), "must be 6 finite numbers, each 0 or more"),
        ("new", [0, 1, 0, 1, 0, 0], "new_cost", (), "requires = (): must be ('exact impacts',)"),
        ("new", [0, 1, 0, 1, 0, 0], "new_cost", ("luck",), "requires = ('luck',): must be ('exact impacts',)"),
        ("new", [1, 0, 0, 0, 0, 0], "collided", (), "column = 'collided': must have the form"),
        ("new", [1, 0, 0, 0, 0, 0], "predicted_harm", (), "column = 'predicted_harm': must have the form"),
    ):
        with pytest.raises((InvalidInput, AlreadyExists)) as error:
            eb.register_count(name, weights, column=column, words="new cost", requires=requires)
        assert told in str(error.value) and name in str(error.value)
    with pytest.raises(InvalidInput, match=r"harm_count = 'shove': must be 'first', 'total', 'honest', .*'half'"):
        eb.make_agent("e_v2x_bm", scenario="paper-random", harm_count="shove")
    with pytest.raises(InvalidInput, match="must be registered first, for instance by --load"):
        eb.make_agent("e_v2x_bm", scenario="paper-random", harm_count="shove")
    given = np.array([0.5, 0, 0, 0, 0, 0])
    mine = eb.HarmCount("mine", given, "mine_harm", "my harm")  # type: ignore[arg-type]
    given[0] = mine.weight_array[0] = eb.HarmCount.of("honest").weight_array[3] = 0.0
    assert mine.weights[0] == mine.weight_array[0] == 0.5 and eb.HarmCount.of("honest").weight_array[3] == 10.0
    eb.register_count("texts", ["1", 0, 0, 0, 0, 0], column="texts_cost", words="cost of texts")  # type: ignore[list-item]
    assert COUNTS["texts"].weights == (1, 0, 0, 0, 0, 0)
    assert COUNTS["shoves"] == COUNTS["shoves"].of("shoves")
