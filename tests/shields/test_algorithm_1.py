"""The paper's hybrid: who drives, what is bounded, and what is refused."""

from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agent_names import make_agent, open_game
from ethbrake_marl.agents.e_v2x_bm import coupled
from ethbrake_marl.agents.pairwise import pairwise
from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.agents.scripts import Held
from ethbrake_marl.agents.team import Agent, Team, play_to_end
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.policies.bundle import load_shipped
from ethbrake_marl.shields.algorithm_1 import EpisodeShield
from tests.shields.attack import LINES

PPO = LearnedAgent(load_shipped("ppo"))


def hybrid(agent: Agent, name: str = "paper", n: int = 60, **options: Any) -> tuple[Any, Any, Team]:
    scenario, game = open_game(LINES[name]())
    return game, scenario.sample(n, 7), Team("hybrid", {2: agent}, EpisodeShield({2: agent}, **options))


@pytest.mark.parametrize(
    ("agent", "name", "count"),
    [
        (PPO, "paper", "first"), (Held("full_brake"), "obstacle", "total"), (Held("coast"), "build-up", "total"),
        (Held("coast"), "follower", "first"),
    ],
)  # fmt: skip
def test_the_harm_is_the_smaller_one_to_the_bit(agent: Agent, name: str, count: str) -> None:
    game, alert, team = hybrid(agent, name, harm_count=count)
    last = play_to_end(game, alert, team)
    memory = last.memories["shield"]
    assert (last.harm(count) == np.minimum(memory.policy_harm, memory.bound_harm)).all()
    assert (memory.chosen == (memory.policy_harm <= memory.bound_harm)).all()


def test_a_better_policy_drives_as_if_alone() -> None:
    game, alert, team = hybrid(PPO, harm_count="first")
    last, alone = play_to_end(game, alert, team), play_to_end(game, alert, team._replace(shield=None))
    chosen = last.memories["shield"].chosen
    assert chosen.mean() > 0.9
    np.testing.assert_allclose(last.harm("first")[chosen], alone.harm("first")[chosen], atol=1e-6)
    assert (last.harm("first") <= alone.harm("first") + 1e-6).all()


def test_h_star_is_that_of_e_v2x_bm() -> None:
    game, alert, team = hybrid(Held("coast"))
    memory = play_to_end(game, alert, team).memories["shield"]
    np.testing.assert_allclose(memory.bound_harm, coupled(alert, 2, "honest", game.settings.horizon_s).harm, atol=1e-6)
    game, alert, team = hybrid(Held("coast"), bound="pairwise")
    memory = play_to_end(game, alert, team).memories["shield"]
    np.testing.assert_array_equal(memory.bound_harm, pairwise(alert, 2).harm)
    wanted = np.where(memory.chosen, 0.0, -pairwise(alert, 2).deceleration_mps2)
    np.testing.assert_allclose(memory.applied[:, 0] * alert.braking_capacity_mps2[:, 1], wanted, atol=1e-12)


def test_what_is_proposed_from_outside_has_no_effect() -> None:
    game, alert, team = hybrid(make_agent("full_brake"), n=10)
    game = game._replace(shield=team.shield)
    state = game.reset(alert)
    one, other = (game.step(state, np.full((10, 1), u))[0] for u in (1.0, -0.3))
    np.testing.assert_array_equal(one.line, other.line)
    infos = game.shield.infos(game, one)
    assert infos["intervened"][:, 1].all() and not infos["intervened"][:, [0, 2]].any()
    assert (infos["proposed_action"][:, 1] == 1.0).all()
    silent = game.shield.infos(game, game.step(state, np.full((10, 1), np.nan))[0])
    assert (silent["proposed_action"][:, 1] == -1.0).all()  # what the policy proposes
    assert (silent["intervened"][:, 1] == ~silent["chosen_policy"]).all()


def test_a_proposal_within_the_rounding_of_float32_counts_as_applied() -> None:
    game, alert, team = hybrid(Held("coast"), n=10)
    game = game._replace(shield=team.shield)
    state = game.reset(alert)
    applied = game.step(state, None)[0].memories["shield"].applied
    again = game.step(state, applied.astype(np.float32))[0].memories["shield"]
    assert not again.intervened.any()


@pytest.mark.parametrize(
    ("drivers", "options", "text"),
    [
        ({2: PPO}, {"bound": "best"}, "bound = 'best'"),
        (None, {}, "needs the policy of exactly one learner, not of 0"),
        ({2: PPO, 3: PPO}, {}, "needs the policy of exactly one learner, not of 2"),
    ],
    ids=str,
)
def test_bad_settings(drivers: Any, options: Any, text: str) -> None:
    with pytest.raises(InvalidInput, match=f"^shield: .*{text}"):
        EpisodeShield(drivers, **options)


def test_the_policy_of_another_vehicle() -> None:
    scenario, game = open_game("paper-random")
    with pytest.raises(InvalidInput, match="has agents for vehicle_3; must have one for each learner, vehicle_2"):
        game._replace(shield=EpisodeShield({3: PPO})).reset(scenario.sample(1, 7))
