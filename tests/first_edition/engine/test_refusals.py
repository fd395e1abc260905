"""What the engine refuses, and what actions, observations, rewards and objectives may not be."""

from collections.abc import Callable

import numpy as np
import pytest

from ethbrake_marl.errors import UnknownName
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.envs.making import make_engine
from ethbrake_marl.first_edition.envs.pettingzoo import parallel_env
from ethbrake_marl.first_edition.game.actions import checked_action
from ethbrake_marl.first_edition.game.harm import empty_ledger, injury_probability
from ethbrake_marl.first_edition.game.objectives import objectives_of, scored
from ethbrake_marl.first_edition.game.observations import ObservationSpec, choose_observation, observe
from ethbrake_marl.first_edition.game.rewards import reward_params
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from tests.first_edition.physics.random_worlds import line
from tests.refused import refused

PAPER = load_scenario("paper-random")
WORLDS = PAPER.sample(2, 0).worlds
SCRIPTS = {i: make_agent("full_brake") for i in range(3)}


def one(value: object) -> np.ndarray:
    """The action of one vehicle."""
    return checked_action(value, (1,), "vehicle_2")


ACTIONS: dict[str, Callable[[], object]] = {
    "action of vehicle_2 = -1.0000003: must": lambda: checked_action([0.5, -1.0000003], (2,), "vehicle_2"),
    "action of vehicle_2: has shape (2,);": lambda: one(np.zeros(2)),
    "action of vehicle_2: '-1' is not a": lambda: one("-1"),
}


@pytest.mark.parametrize("message", ACTIONS)
def test_action__is_refused(message: str) -> None:
    with refused(message):
        ACTIONS[message]()


OBSERVATIONS: dict[str, Callable[[], object]] = {
    "observation: front = 1.5: must be a": lambda: ObservationSpec(1.5, 0),
    "observation: obstacle = 1: must be True": lambda: ObservationSpec(obstacle=1),
    "observe: vehicle = 4: must be an index": lambda: observe(
        load_scenario("paper-random").sample(1, 7).worlds, 4, ObservationSpec()
    ),
    "observation: features of the groups": lambda: observe(WORLDS, 1, choose_observation(["own", "contact"])),
}


@pytest.mark.parametrize("message", OBSERVATIONS)
def test_observation__is_refused(message: str) -> None:
    with refused(message):
        OBSERVATIONS[message]()


REWARDS: dict[str, Callable[[], object]] = {
    "must be a name (harm, total-harm,": lambda: reward_params(5),
    "reward: jerk = -1.0: must be greater": lambda: reward_params({"jerk": -1.0}),
    "reward: objective: has no effect,": lambda: reward_params({"harm": 0.0, "objective": "own"}),
}


@pytest.mark.parametrize("message", REWARDS)
def test_reward__is_refused(message: str) -> None:
    with refused(message):
        REWARDS[message]()


OBJECTIVES: dict[str, Callable[[], object]] = {
    "scenario 'paper-random': objective =": lambda: PAPER.replace(objective="onw"),
    "reward: objective 'weighted:1,2': has 2": lambda: parallel_env(PAPER, reward={"objective": "weighted:1,2"}),
    "scored = 'own': must be a list of": lambda: scored(empty_ledger(line([5.0], [9.0, 9.0])), "first", "own"),
    "objective 'social:91': social needs an": lambda: objectives_of("social:91", 2),
    "objective 'weighted:1,2,3': has 3": lambda: objectives_of("weighted:1,2,3", 2),
}


@pytest.mark.parametrize("message", OBJECTIVES)
def test_objective__is_refused(message: str) -> None:
    with refused(message):
        OBJECTIVES[message]()


ENGINE: dict[str, Callable[[], object]] = {
    "engine: deciders = (3,): must be": lambda: Engine(PAPER, 1, learners=(), scripts=SCRIPTS, deciders=(3,)),
    "engine snapshot: the array state has": lambda: make_engine(PAPER, 7).restore(make_engine(PAPER, 6).snapshot()),
    "renew: rows = [1, 9]: must be different": lambda: make_engine(PAPER, 6).renew([1, 9]),
    "observe: vehicle = 'vehicle_2': must be": lambda: make_engine(PAPER, 6).observe("vehicle_2"),
    "since: the argument before must be an": lambda: make_engine(PAPER, 6).ledger.since(make_engine(PAPER, 1).ledger),
}


@pytest.mark.parametrize("message", ENGINE)
def test_engine__refuses(message: str) -> None:
    with refused(message):
        ENGINE[message]()


NAMES: dict[str, Callable[[], object]] = {
    "unknown side 'Front'; did you mean": lambda: injury_probability(5.0, "Front"),
    "unknown objective 'ownn'; did you mean": lambda: objectives_of("ownn", 2),
}


@pytest.mark.parametrize("message", NAMES)
def test_name__is_unknown(message: str) -> None:
    with refused(message, UnknownName):
        NAMES[message]()


def test_episode__starts_at_the_alert_without_an_impact() -> None:
    late, _ = advance(WORLDS, -WORLDS.vehicles.braking_capacity_mps2, until_s=[0.0, 0.3])
    with refused("reset: world 1 is at 0.3 s; episodes start at the alert, t = 0, without any impact"):
        make_engine(PAPER, 2).reset(worlds=late)
    hit = WORLDS.take([0, 1])
    hit.pair_hit[0, 1] = True
    with refused("reset: world 0 is after an impact; episodes start at the alert, t = 0, without any impact"):
        make_engine(PAPER, 2).reset(worlds=hit)


def test_snapshot__of_another_engine_is_refused() -> None:
    kept = make_engine(PAPER, 6).snapshot()
    with refused("engine snapshot: the array params has the shape (6, 25); must have the shape (6, 37)"):
        make_engine(load_scenario("cooperation-2-blocked"), 6).restore(kept)
    del kept["params"]
    with refused("engine snapshot: the array params is missing; must have the shape (6, 25)"):
        make_engine(PAPER, 6).restore(kept)
