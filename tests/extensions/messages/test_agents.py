"""Agents, too, see what their vehicles believe; and evaluations say when a channel hides something."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.state import State
from ethbrake_marl.evaluation.evaluate import hidden_from

OLD = eb.load_scenario("cooperation-2-paper").replace(
    v2x={"link_latency_s": 0.3, "persistence": "periodic", "senses": "none"}, early_impacts="keep"
)
FEW = OLD.replace(v2x={"tells": ["place", "latency", "mass"]})


class Seeing:
    """Keeps what it sees, and brakes."""

    name = "seeing"

    def __init__(self, knows: str) -> None:
        self.knows, self.states = knows, list[State]()

    def begin(self, alert: State, body: int) -> None:
        """Remember nothing."""

    def act(self, state: State, memory: None, body: int) -> Any:
        self.states.append(state)
        return -0.3 * state.car[:, 3, body], memory


def driven(scenario: eb.Scenario, agent: Any, n: int = 6) -> list[State]:
    loaded, game = eb.open_game(scenario)
    return [state for _, state in eb.play(game, loaded.sample(n, 7), eb.Team("one", {2: agent}))]


@pytest.mark.parametrize("scenario", [OLD, FEW], ids=["old", "few"])
@pytest.mark.parametrize("shielded", [False, True])
@pytest.mark.parametrize("kind", ["ours", "another library's"])
def test_a_policy__observes_as_in_its_environment(scenario: eb.Scenario, shielded: bool, kind: str) -> None:
    """Its actions are those for what the environment observes, which differs from the true state."""
    policy = eb.load_shipped("ppo")
    other = eb.policy_agent(lambda seen: policy(seen), scenario="paper-random")
    model = eb.LearnedAgent(policy) if kind == "ours" else other
    loaded, game = eb.open_game(scenario)
    team = eb.Team("one", {2: model})
    if shielded:
        team = eb.shield(team)
    states = [state for _, state in eb.play(game, loaded.sample(6, 7), team)]
    wrong = 0
    for before, after in pairwise(states):
        running = ~before.ended
        proposed = policy(game.observe(before, np.array([2]))[0])[:, 0]
        command = np.where(proposed < 0, before.car[:, 3, 2], before.car[:, 4, 2]) * proposed
        mine = after.memories["shield"].proposed[:, 0] if shielded else after.wanted[:, 2]
        np.testing.assert_allclose(mine[running], (proposed if shielded else command)[running], atol=1e-6)
        true = policy.observation.observe(before, np.array([2]), 0.1)[:, 0]
        wrong += int((np.abs(policy(true)[:, 0] - proposed) > 1e-3).sum())
    assert wrong > 10


def test_an_agent__sees_what_it_says_that_it_knows() -> None:
    for knows, true in (("messages", False), ("own sensors", False), ("true state", True), ("true model", True)):
        agent = Seeing(knows)
        states = driven(OLD, agent)
        same = [np.array_equal(one.line, other.line) for one, other in zip(agent.states, states, strict=False)]
        assert len(same) > 10 and all(same[1:]) == true, knows


def test_hidden__is_old_news_and_what_messages_lack() -> None:
    def share(**v2x: Any) -> float:
        loaded, game = eb.open_game(OLD.replace(v2x=v2x))
        return float(hidden_from(loaded.sample(40, 7), game).mean())

    assert share(preset="paper") == 0.0
    assert share(link_latency_s=0.3, senses="none") == 0.0  # Vehicle 2 waits as long for the alert
    assert share(link_latency_s=0.3, senses="none", persistence="periodic") == 1.0
    assert share(preset="paper", tells=["place", "speed", "acceleration", "braking_capacity", "latency", "mass"]) == 0.0
    assert share(preset="paper", tells=["place", "speed", "acceleration", "braking_capacity", "latency"]) == 1.0
    assert share(preset="paper", tells=["place", "acceleration", "braking_capacity", "latency", "mass"]) == 1.0
