"""Recipe ``quick``, what ``ethbrake run`` does: from random weights to near the best known, whatever the seed."""

from __future__ import annotations

from inspect import signature
from pathlib import Path

import pytest

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.cli.train import run_command
from ethbrake_marl.evaluation import evaluate, summarise
from ethbrake_marl.learning.runs import train
from ethbrake_marl.learning.training import load_recipe
from ethbrake_marl.scenario import load_scenario

GOAL = 1.10  # harm of the policy, in the least harm known


def test_quick__is_what_run_does_and_observes_what_ppo_does() -> None:
    assert signature(run_command).parameters["recipe"].default == "quick"
    quick = load_recipe("quick")
    assert quick.algorithm == "counterfactual" and quick.start is None
    assert quick.observation == load_recipe("ppo").observation is None


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_quick__ends_near_the_best_known_for_every_seed(seed: int, tmp_path: Path) -> None:
    result = train("quick", "paper-random", tmp_path / "run", seed=seed, on_progress=None)
    assert result.alarms == ()
    scenario = load_scenario("paper-random")
    agents = {"last": LearnedAgent(result.last_policy), "kept": LearnedAgent(result.policy)}
    for row in summarise(evaluate(scenario.sample(10_000, seed=7), agents, scenario=scenario, aftermath=False)):
        assert row["best_known_first_impact_harm"] is not None
        assert row.first_impact_harm.value <= GOAL * row["best_known_first_impact_harm"].value
