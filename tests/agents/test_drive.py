"""The loop: agents decide when learners do, commands are applied as they are, memories belong to the episodes."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agents.drive import Team, drive, play, propose, to_action, to_command
from ethbrake_marl.agents.scripts import Held
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import AgentFailed, InvalidInput
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv
from ethbrake_marl.motion.layout import BRAKING, DRIVING, Floats
from ethbrake_marl.names import open_game
from ethbrake_marl.shields.step import StepShield
from ethbrake_marl.worlds.game import game_of

PAPER, GAME = game_of("paper-random")


class Counting:
    """Commands minus the number of times that it has been asked, and remembers the time of each."""

    name, knows = "counting", "nothing"

    def begin(self, alert: State, body: int) -> tuple[Floats, Floats]:
        return np.zeros(alert.n), np.full((alert.n, 100), np.nan)

    def act(self, state: State, memory: Any, body: int) -> tuple[Floats, Any]:
        asked, times = memory
        times = times.copy()
        times[np.arange(state.n), asked.astype(int)] = state.time_s
        return -0.1 * (asked + 1.0), (asked + 1.0, times)


def test_agents__are_asked_at_every_decision_from_the_first_and_never_before():
    worlds = PAPER.sample(5, 7)
    states = [state for _, state in play(GAME, worlds, Team("counting", {2: Counting()}))]
    asked, times = states[-1].memories[2]
    assert (times[:, 0] == worlds.latency_s[:, 1]).all() and (times[:, 0] == states[0].time_s).all()
    assert (asked == len(states) - 1).all()
    for k, (before, state) in enumerate(pairwise(states), 1):
        assert (state.commands_mps2[~before.ended, 1] == -0.1 * k).all()


def test_an_episode__is_the_one_that_an_environment_plays_with_the_same_actions():
    env = EthBrakeParallelEnv("cooperation-3-pair")
    env.reset(seed=3)
    _, game = game_of("cooperation-3-pair")
    alert = game.draw(1, 3, 0)
    last = drive(game, alert, Team("both", {2: Held("full_brake"), 3: Held("coast")}))
    while env.agents:
        *_, infos = env.step({"vehicle_2": [-1.0], "vehicle_3": [0.0]})
    assert infos["vehicle_1"]["world_total_harm"] == last.harm("total")[0]
    assert infos["vehicle_1"]["time_s"] == last.time_s[0]


@pytest.mark.parametrize("scenario", ["paper-random", "paper-random-buildup", "paper-random-obstacle"])
def test_a_batch__is_the_same_as_its_worlds_alone(scenario: str):
    loaded, game = game_of(scenario)
    worlds, team = loaded.sample(6, 7), Team("counting", {2: Counting()})
    together = drive(game, worlds, team)
    for k in range(6):
        alone = drive(game, worlds.take([k]), team)
        assert alone.line.tobytes() == together.line[[k]].tobytes() and alone.steps == together.steps[k]


def test_the_worlds__are_not_changed_by_driving_them():
    worlds = PAPER.sample(4, 7)
    before = [array.copy() for array in worlds[:5]]
    drive(GAME, worlds, Team("full_brake", {2: Held("full_brake")}))
    assert all((a == b).all() for a, b in zip(before, worlds[:5], strict=True))


@pytest.mark.parametrize(
    ("drivers", "message"),
    [
        ({}, "drives nobody; must drive exactly vehicle_2"),
        ({1: Held("coast")}, "drives vehicle_1; must drive exactly vehicle_2"),
        ({2: Held("coast"), 3: Held("coast")}, "drives vehicle_2, vehicle_3; must drive exactly vehicle_2"),
    ],
)
def test_a_team__drives_exactly_the_learners(drivers: Any, message: str):
    with pytest.raises(InvalidInput, match=message):
        drive(GAME, PAPER.sample(2, 7), Team("mine", drivers))


class Gives:
    """Commands whatever it is given."""

    name, knows = "gives", "nothing"

    def __init__(self, commands: Any) -> None:
        self.commands = commands

    def begin(self, alert: State, body: int) -> None:
        return None

    def act(self, state: State, memory: Any, body: int) -> Any:
        return self.commands, memory


@pytest.mark.parametrize(
    "commands", [[0.0], [[0.0, 0.0]], np.array([np.nan, 0.0]), [np.inf, 0.0], ["a", "b"], [True, False], None]
)
def test_bad_commands__are_refused_with_the_vehicle(commands: Any):
    with pytest.raises(
        InvalidInput, match=r"agent .gives.*vehicle_2.*(its commands are|must be in|act fails|act returned)"
    ):
        drive(GAME, PAPER.sample(2, 7), Team("gives", {2: Gives(commands)}))


def test_commands_and_actions__are_each_others_inverse_and_clipped():
    state = PAPER.sample(200, 7)
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, 200)
    commands = to_command(state, 2, actions)
    capacity = np.where(actions < 0.0, state.car[:, BRAKING, 2], state.car[:, DRIVING, 2])
    assert (commands == actions * capacity).all()
    assert np.abs(to_action(state, 2, commands) - actions).max() < 1e-15
    assert (to_action(state, 2, np.sign(actions) * 100.0) == np.sign(actions)).all()


def test_actions__of_a_vehicle_that_cannot_drive_are_0():
    state = PAPER.sample(3, 7)
    state.car[:, DRIVING, 2] = 0.0
    assert (to_action(state, 2, np.array([1.0, 0.0, 2.0])) == 0.0).all()


def test_proposals__stand_in_the_order_of_the_drivers():
    _, game = game_of("cooperation-3-pair")
    state = game.start(3, 1, 0)
    drivers = {2: Held("full_brake"), 3: Held("coast")}
    memories = {body: agent.begin(state, body) for body, agent in drivers.items()}
    actions, after = propose(drivers, state, memories)
    assert (actions == [[-1.0, 0.0]] * 3).all() and set(after) == {2, 3}


class Spoils:
    """Changes what it sees, by mistake."""

    name, knows = "spoils", "nothing"

    def begin(self, alert: State, body: int) -> None:
        return None

    def act(self, state: State, memory: Any, body: int) -> Any:
        gaps = state.gaps_m
        gaps -= 2.0
        return np.zeros(state.n), memory


def test_an_agent__cannot_change_the_state_by_mistake_and_its_errors_name_it():
    with pytest.raises(
        AgentFailed, match="agent 'spoils', vehicle_2: act fails: ValueError: output array is read-only"
    ):
        drive(GAME, PAPER.sample(2, 7), Team("spoils", {2: Spoils()}))


def test_a_command_beyond_a_capacity__is_refused_with_world_and_time():
    with pytest.raises(AgentFailed, match=r"agent 'gives', world 1, vehicle_2 at 0.50 s: command -8 m/s2; must be in"):
        drive(GAME, PAPER.sample(2, 7), Team("gives", {2: Gives([0.0, -8.0])}))


@pytest.mark.parametrize("role", ["constant:20", "constant:-20"])
def test_a_constant__beyond_the_capacity_is_refused(role: str):
    with pytest.raises(InvalidInput, match=rf"agent '{role}': vehicle_2 can decelerate by at most 7 .* in world 5\Z"):
        drive(GAME, PAPER.sample(2, 7, first=5), Team(role, {2: Held(role)}))


def test_a_role__that_names_an_agent_is_played_by_it_in_every_face(monkeypatch: pytest.MonkeyPatch):
    from ethbrake_marl import names

    monkeypatch.setattr(names.AGENTS, "loaded", dict(names.AGENTS.loaded))
    names.register_agent("counting", lambda argument, settings: Counting())
    scenario = PAPER.replace(early_impacts="keep", roles={"vehicle_2": "learner", "vehicle_3": "counting"})
    _, game = open_game(scenario)
    assert set(game.scripts) == {3}
    env = EthBrakeParallelEnv(scenario)
    env.reset(seed=1)
    first = env.step({"vehicle_2": [-1.0]})[4]["vehicle_3"]["chosen_command_mps2"]
    assert first == -0.2  # asked at the alert, and at the first decision


def test_an_episode__that_has_ended_changes_no_more_while_others_go_on():
    worlds = PAPER.replace(gaps_m=[9.0, 9.0]).sample(20, 7)
    ended: dict[int, Any] = {}
    for _, state in play(GAME, worlds, Team("counting", {2: Counting()})):
        for k, last in ended.items():
            assert all((a[k] == b).all() for a, b in zip(state[:5], last, strict=True))
        ended |= {k: [array[k].copy() for array in state[:5]] for k in np.flatnonzero(state.ended) if k not in ended}
    assert len(ended) == 20


def test_a_shield_of_the_game__is_never_dropped():
    game = GAME._replace(shield=StepShield())
    with pytest.raises(InvalidInput, match="the game has a shield of its own; put it around the team instead"):
        drive(game, PAPER.sample(2, 7), Team("coast", {2: Held("coast")}))
