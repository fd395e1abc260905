"""The loop: agents decide when learners do, commands are applied as they are, memories belong to the episodes."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agent_names import make_agent, open_game, register_agent
from ethbrake_marl.agents.scripts import Held
from ethbrake_marl.agents.team import Team, play, play_to_end, propose
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import AgentFailed
from ethbrake_marl.evaluation.evaluate import evaluate
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv
from ethbrake_marl.faces.shield import shield
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.shields.step import StepShield
from tests.refused import refused

PAPER, GAME = open_game("paper-random")
PAIR = open_game("cooperation-3-pair")


class Counting:
    """Commands minus a tenth of the number of times that it has been asked, and remembers the time of each."""

    name, knows = "counting", "own sensors"

    def begin(self, alert: State, body: int) -> tuple[Floats, Floats]:
        assert (alert.time_s == 0.0).all()
        return np.zeros(alert.n), np.full((alert.n, 100), np.nan)

    def act(self, state: State, memory: Any, body: int) -> tuple[Floats, Any]:
        asked, times = memory
        times = times.copy()
        times[np.arange(state.n), asked.astype(int)] = state.time_s
        return -0.1 * (asked + 1.0), (asked + 1.0, times)


def test_agents__are_asked_at_every_decision_from_the_first_and_never_before() -> None:
    worlds = PAPER.sample(5, 7)
    before_driving = [array.copy() for array in worlds[:5]]
    states = [state for _, state in play(GAME, worlds, Team("counting", {2: Counting()}))]
    asked, times = states[-1].memories[2]
    assert (times[:, 0] == worlds.latency_s[:, 1]).all() and (times[:, 0] == states[0].time_s).all()
    assert (asked == len(states) - 1).all()
    for k, (before, state) in enumerate(pairwise(states), 1):
        assert (state.commands_mps2[~before.ended, 1] == -0.1 * k).all()
        for row in np.flatnonzero(before.ended):
            assert all((a[row] == b[row]).all() for a, b in zip(before[:5], state[:5], strict=True))
    assert all((a == b).all() for a, b in zip(before_driving, worlds[:5], strict=True))
    last = play_to_end(GAME, worlds, Team("counting", {2: Counting()}))
    for k in range(5):
        alone = play_to_end(GAME, worlds.take([k]), Team("counting", {2: Counting()}))
        assert alone.line.tobytes() == last.line[[k]].tobytes() == states[-1].line[[k]].tobytes()


def test_an_episode__is_the_one_that_an_environment_plays_with_the_same_actions() -> None:
    env, (_, game) = EthBrakeParallelEnv("cooperation-3-pair"), PAIR
    env.reset(seed=3)
    last = play_to_end(game, game.draw(1, 3, 0), Team("both", {2: Held("full_brake"), 3: Held("coast")}))
    while env.agents:
        *_, infos = env.step({"vehicle_2": [-1.0], "vehicle_3": [0.0]})
    assert infos["vehicle_1"]["world_total_harm"] == last.harm("total")[0]
    assert infos["vehicle_1"]["time_s"] == last.time_s[0]


@pytest.mark.parametrize(
    ("drivers", "message"),
    [
        ({}, "drives nobody; must drive exactly vehicle_2"),
        ({2: Held("coast"), 3: Held("coast")}, "drives vehicle_2, vehicle_3; must drive exactly vehicle_2"),
    ],
)
def test_a_team__drives_exactly_the_learners(drivers: Any, message: str) -> None:
    with refused(f"team 'mine': {message}"):
        play_to_end(GAME, PAPER.sample(2, 7), Team("mine", drivers))


@pytest.mark.parametrize(
    ("drivers", "message"),
    [
        ({"vehicle_2": "coast"}, "team 't': vehicle_2 = 'coast': has no name and no begin and no act; must"),
        ({2: Held("full_brake")}, "team 't': 2: must be the name of a vehicle, such as vehicle_2"),
        ({"vehicle_0": Held("full_brake")}, "team 't': 'vehicle_0': must be the name of a vehicle"),
    ],
)
def test_a_team__is_made_of_agents(drivers: Any, message: str) -> None:
    with refused(message):
        Team.of(drivers, "t")
    team = Team.of({"vehicle_3": Held("coast"), "vehicle_2": Held("full_brake")}, "t")
    assert list(team.drivers) == [2, 3] and play_to_end(PAIR[1], PAIR[0].sample(2, 7), team).ended.all()


SCRIPTED = PAPER.replace(roles=dict.fromkeys(PAPER.vehicle_names, "full_brake"))


@pytest.mark.parametrize("name", ["ppo+step"])
def test_a_shield__without_a_learner_is_refused(name: str) -> None:
    scenario, game = open_game(SCRIPTED)
    for team in (make_agent(name, scenario=scenario), shield(Held("coast"), scenario=scenario)):
        with refused("the scenario has no learner that its shield could guard; leave out the shield"):
            play_to_end(game, scenario.sample(2, 7), team)
    assert play_to_end(game, scenario.sample(2, 7), team._replace(shield=None)).ended.all()
    with refused("mode 'episode' needs the policy of exactly one learner, not of 0"):
        make_agent("coast+episode", scenario=scenario)
    with refused("scenario 'paper-random' has no learner that the agents could drive"):
        evaluate(SCRIPTED, name, episodes=2)


def test_a_shield_of_the_game__is_never_dropped() -> None:
    game = GAME._replace(shield=StepShield())
    with refused("the game has a shield of its own; put it around the team instead"):
        play_to_end(game, PAPER.sample(2, 7), Team("coast", {2: Held("coast")}))


class Gives:
    """Commands whatever it is given."""

    name, knows = "gives", "own sensors"

    def __init__(self, commands: Any) -> None:
        self.commands = commands

    def begin(self, alert: State, body: int) -> None:
        return None

    def act(self, state: State, memory: Any, body: int) -> Any:
        return self.commands(state) if callable(self.commands) else (self.commands, memory)


BAD: dict[str, Any] = {
    "vehicle_2: its commands are [[1.0], [1.0, 2.0]]; must be numbers": [[1.0], [1.0, 2.0]],
    "vehicle_2: its commands are [0.0]; must be numbers of the shape (2,)": [0.0],
    "world 0, vehicle_2 at 0.50 s: command nan m/s2; must be in": [np.nan, 0.0],
    "world 1, vehicle_2 at 0.50 s: command -8 m/s2; must be in [-7,": [0.0, -8.0],
    "vehicle_2: act returned array(": lambda state: np.zeros(2),
    "vehicle_2: act fails: ValueError: output array is read-only": lambda state: np.add(
        state.gaps_m, 2.0, out=state.gaps_m
    ),
}


@pytest.mark.parametrize("message", BAD)
def test_what_an_agent_must_not_do__is_refused_with_its_name_and_vehicle(message: str) -> None:
    with refused(message) as caught:
        play_to_end(GAME, PAPER.sample(2, 7), Team("mine", {2: Gives(BAD[message])}))
    assert str(caught.value).startswith("agent 'gives', ")


FAULTS: dict[str, Any] = {  # what the message says after the vehicle: what the agent answers
    ": act returned 'nothing'": lambda state: "nothing",
    ": act fails: ZeroDivisionError": lambda state: 1 / 0,
    ": its commands are array(": lambda state: (np.zeros(1), None),
    ": its memory is array(": lambda state: (np.zeros(state.n), np.zeros(1)),
    " at 0.10 s: command 99 m/s2": lambda state: (np.where(np.arange(state.n) == 1, 99.0, 0.0), None),
}


@pytest.mark.parametrize("body", [3])
@pytest.mark.parametrize("fault", FAULTS)
def test_error__names_the_vehicle_and_the_world_whatever_the_others_do(fault: str, body: int) -> None:
    scenario, game = open_game("cooperation-4-all")
    scenario, game = open_game(scenario.replace(latency_s=0.1))
    drivers = {each: Gives(FAULTS[fault]) if each == body else Held("coast") for each in (1, 2, 3)}
    where = f"world 6, vehicle_{body}" if "command " in fault else f"vehicle_{body}"
    with refused(f"agent 'gives', {where}{fault}", AgentFailed):
        play_to_end(game, scenario.sample(3, 7, first=5), Team("mine", drivers))


class Breaks(Gives):
    """Fails at the alert."""

    def begin(self, alert: State, body: int) -> None:
        raise LookupError("mine")


@pytest.mark.parametrize("body", [3])
def test_error_at_the_alert__names_the_vehicle(body: int) -> None:
    scenario, game = open_game("cooperation-4-all")
    drivers = {each: Breaks(None) if each == body else Held("coast") for each in (1, 2, 3)}
    with refused(f"agent 'gives', vehicle_{body}: begin fails: LookupError: mine", AgentFailed):
        play_to_end(game, scenario.sample(3, 7), Team("mine", drivers))


def test_proposals__stand_in_the_order_of_the_drivers() -> None:
    state = PAIR[1].reset(PAIR[1].draw(3, 1, 0))
    drivers = {2: Held("full_brake"), 3: Held("coast")}
    actions, after = propose(drivers, state, {body: agent.begin(state, body) for body, agent in drivers.items()})
    assert (actions == [[-1.0, 0.0]] * 3).all() and set(after) == {2, 3}


def test_a_role__that_names_an_agent_is_played_by_it_in_every_face() -> None:
    register_agent("counting", lambda argument, settings: Counting())
    scenario = PAPER.replace(early_impacts="keep", roles={"vehicle_2": "learner", "vehicle_3": "counting"})
    assert set(open_game(scenario)[1].scripts) == {3}
    env = EthBrakeParallelEnv(scenario)
    env.reset(seed=1)
    first = env.step({"vehicle_2": [-1.0]})[4]["vehicle_3"]["chosen_command_mps2"]
    assert first == -0.2  # asked at the alert, and at the first decision
