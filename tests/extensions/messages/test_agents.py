"""Agents, too, see what their vehicles believe; and evaluations say when a channel hides something."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode import layer
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.evaluate import hidden_from
from ethbrake_marl.worlds.open_game import game_of

OLD = eb.load_scenario("cooperation-2-paper").replace(
    v2x={"link_latency_s": 0.3, "persistence": "periodic", "senses": "none"}, early_impacts="keep"
)
FEW = OLD.replace(v2x={"tells": ["place", "latency", "mass"]})


class Seeing:
    """Keeps what it sees, and brakes."""

    name = "seeing"

    def __init__(self, knows: str, share: float = 0.3) -> None:
        self.knows, self.share, self.states = knows, share, list[State]()

    def begin(self, alert: State, body: int) -> None:
        """Remember nothing."""

    def act(self, state: State, memory: None, body: int) -> Any:
        self.states.append(state)
        return -self.share * state.car[:, 3, body], memory


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


KNOWLEDGE = {  # what an agent says that it knows -> whether it sees the true state
    None: False,  # it has no attribute `knows`
    "not stated": False,
    "own sensors": False,
    "messages": False,
    "estimated model": False,
    "true state": True,
    "true model": True,
}


def saw_the_truth(agent: Seeing, states: list[State]) -> list[bool]:
    return [np.array_equal(one.line, other.line) for one, other in zip(agent.states, states, strict=False)]


def test_knowledge__has_no_value_that_is_not_tested() -> None:
    assert {*KNOWLEDGE} == {None, "not stated", *layer.KNOWLEDGE}


@pytest.mark.parametrize(("knows", "true"), KNOWLEDGE.items(), ids=str)
def test_an_agent__sees_the_true_state_only_if_it_claims_more(knows: str | None, true: bool) -> None:
    agent = Seeing(knows or "not stated")
    if knows is None:
        del agent.knows  # as an object that is made without `Team.of`
    same = saw_the_truth(agent, driven(OLD, agent))
    assert len(same) > 10 and all(same[1:]) == true


@pytest.mark.parametrize(("knows", "true"), KNOWLEDGE.items(), ids=str)
def test_a_script_of_a_role__sees_the_true_state_only_if_it_claims_more(knows: str | None, true: bool) -> None:
    script = Seeing(knows or "not stated")
    if knows is None:
        del script.knows
    scenario, game = game_of(OLD, {3: script})
    state, states = game.reset(scenario.sample(6, 7)), list[State]()
    states.append(state)  # at the alert
    for _ in range(12):
        states.append(state)
        state, _ = game.step(state, np.full((6, 1), -0.3))
    script.states = script.states[::2]  # a script is asked twice
    same = saw_the_truth(script, states)
    assert len(same) == 13 and all(same[1:]) == true


def speeds_seen(knows: str) -> list[float]:
    """Speeds that an agent of Vehicle 2 sees at its second decision in ``messages-noisy``, after full braking."""
    scenario, game = eb.open_game("messages-noisy")
    agent = Seeing(knows, share=1.0)
    list(eb.play(game, scenario.sample(1, 7), eb.Team("one", {2: agent})))
    return agent.states[1].speeds_mps[0].round(3).tolist()


class Nothing(layer.Layer):
    """Lets everything through."""


BY_HAND = {
    "a rule": ("plan", "forecasts"), "a controller": ("idm", "field"), "a platoon": ("synchronised", "field"),
    "a policy": ("ppo", "messages"), "a function": (lambda seen: -seen[:, 0].clip(0, 1), "messages"),
}  # fmt: skip


@pytest.mark.parametrize("what", BY_HAND)
@pytest.mark.parametrize("name", ["messages-noisy", "paper-random"])
def test_agent_called_by_hand__is_refused_the_true_state_of_a_game_with_layers(what: str, name: str) -> None:
    policy, extension = BY_HAND[what]
    pytest.importorskip(f"ethbrake_marl.extensions.{extension}")
    scenario, game = eb.open_game(name)
    game = game if game.layers else game.with_layers([Nothing()])
    agent = eb.policy_agent(policy, scenario=name) if callable(policy) else eb.make_agent(policy, scenario=scenario)
    alert = scenario.sample(3, 7)
    state = game.step(game.reset(alert), np.full((3, 1), -0.5))[0]
    memory = agent.begin(alert, 2)
    with pytest.raises(InvalidInput, match=r"is the true state, .*game\.agents\(\{2: agent\}\)\[2\]\.act"):
        agent.act(state, memory, 2)
    assert game.agents({2: agent})[2].act(state, memory, 2)[0].shape == (3,)


def test_a_silent_agent__sees_noisy_messages() -> None:
    assert speeds_seen("true state") == [16.849, 20.787, 21.023]
    assert speeds_seen("not stated") == speeds_seen("own sensors") == [19.801, 20.787, 20.502]


@pytest.mark.parametrize(
    ("knows", "words", "through"),
    [
        ("not stated", "not stated, filtered", False), ("own sensors", "own sensors", False),
        ("messages", "messages", False), ("estimated model", "estimated model", False),
        ("true state", "† true state", True), ("true model", "† true model", True),
    ],
)  # fmt: skip
def test_a_row__says_who_is_filtered_and_who_sees_through(knows: str, words: str, through: bool) -> None:
    (row,) = eb.summarise(eb.evaluate("messages-noisy", {"mine": Seeing(knows)}, episodes=3))
    assert (row.about, row.sees_through) == (words, through)


def test_a_row__of_a_silent_agent_that_no_layer_filters_says_so() -> None:
    silent = Seeing("not stated")
    del silent.knows
    for scenario, words in (("paper-random", "not stated"), ("messages-noisy", "not stated, filtered")):
        (row,) = eb.summarise(eb.evaluate(scenario, {"mine": silent}, episodes=3))
        assert row.about == words


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
