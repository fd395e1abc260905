"""The shield replaces and harms at most 1 % more than the first edition's; Algorithm 1 decides alike."""

import numpy as np
import pytest

from ethbrake_marl.agents.drive import Team, drive
from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.first_edition.agents.driving import drive as first_drive
from ethbrake_marl.first_edition.agents.learned import LearnedAgent as FirstAgent
from ethbrake_marl.first_edition.policies.shipped import load_shipped as first_shipped
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario as load_first
from ethbrake_marl.first_edition.shields.paper_hybrid import HybridAgent
from ethbrake_marl.policies.bundle import load_shipped
from ethbrake_marl.shields.algorithm_1 import EpisodeShield
from ethbrake_marl.worlds.game import game_of
from tests.second.shields import LINES, WAYS, both


@pytest.mark.slow
@pytest.mark.parametrize(("name", "count"), LINES)
@pytest.mark.parametrize("way", WAYS)
def test_the_step_shield_is_as_good(name: str, count: str, way: str) -> None:
    old, new = both(name, count, way, 1500, 1)
    assert new.harm <= 1.01 * old.harm
    assert new.replaced <= 1.01 * old.replaced
    assert new.bound <= 1.001 * old.bound


@pytest.mark.parametrize(("name", "count"), LINES[:2])
@pytest.mark.parametrize("bound", ["coupled", "pairwise"])
def test_algorithm_1_decides_alike(name: str, count: str, bound: str) -> None:
    old, (scenario, game) = load_first(name), game_of(name)
    hybrid = HybridAgent(FirstAgent(first_shipped("ppo")), old, bound=bound, harm_count=count)  # type: ignore[arg-type]
    expected = first_drive(old.sample(300, 7).worlds, hybrid, old, 1)
    agent = LearnedAgent(load_shipped("ppo"))
    team = Team("hybrid", {2: agent}, EpisodeShield({2: agent}, harm_count=count, bound=bound))
    last = drive(game, scenario.sample(300, 7), team)
    memory = last.memories["shield"]
    remembered = expected.memories[1]
    assert (memory.chosen != remembered["chosen_policy"]).sum() <= 2
    same = memory.chosen == remembered["chosen_policy"]
    harm = expected.ledger.world_harm(count)
    assert abs(last.harm(count).mean() / harm.mean() - 1.0) < 5e-4
    np.testing.assert_allclose(memory.policy_harm[same], remembered["policy_harm"][same], rtol=1e-4, atol=1e-3)
