"""What the engine refuses, and what actions, observations, rewards and objectives may not be."""

from collections.abc import Callable

import numpy as np
import pytest

from ethbrake_marl.agents.making import make_agent
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.envs.making import make_engine
from ethbrake_marl.envs.pettingzoo import parallel_env
from ethbrake_marl.errors import UnknownName
from ethbrake_marl.game.actions import checked_action
from ethbrake_marl.game.harm import empty_ledger, injury_probability
from ethbrake_marl.game.objectives import objectives_of, scored
from ethbrake_marl.game.observations import ObservationSpec, choose_observation, observe
from ethbrake_marl.game.rewards import reward_params
from ethbrake_marl.physics.advance import advance
from ethbrake_marl.scenario.catalogue import load_scenario
from tests.fixtures.policies import make_policy
from tests.physics.random_worlds import line
from tests.refused import refused

PAPER = load_scenario("paper-random")
WORLDS = PAPER.sample(2, 0).worlds
SCRIPTS = {i: make_agent("full_brake") for i in range(3)}


def one(value: object) -> np.ndarray:
    """The action of one vehicle."""
    return checked_action(value, (1,), "vehicle_2")


ACTIONS: dict[str, Callable[[], object]] = {
    "action of vehicle_2 = -1.0000003: must be from -1 (full braking) to 1 (full driving)": lambda: checked_action(
        [0.5, -1.0000003], (2,), "vehicle_2"
    ),
    "action of vehicle_2 = 1.0000001193: must be from -1 (full braking) to 1 (full driving)": lambda: checked_action(
        [0.5, 1.0000001193], (2,), "vehicle_2"
    ),
    "action of vehicle_2 = nan: must be from -1 (full braking) to 1 (full driving)": lambda: checked_action(
        [0.5, np.nan], (2,), "vehicle_2"
    ),
    "action of vehicle_2: has shape (2,); must have shape (1,)": lambda: one(np.zeros(2)),
    "action of vehicle_2: has shape (2, 3); must have shape (3, 2)": lambda: checked_action(
        np.zeros((2, 3)), (3, 2), "vehicle_2"
    ),
    "action of vehicle_2: '-1' is not a number; must be a number in [-1, 1]": lambda: one("-1"),
    "action of vehicle_2: None is not a number; must be a number in [-1, 1]": lambda: one(None),
    "action of vehicle_2: [1j] is not a number; must be a number in [-1, 1]": lambda: one([1j]),
}


@pytest.mark.parametrize("message", ACTIONS)
def test_action__is_refused(message: str) -> None:
    with refused(message):
        ACTIONS[message]()


OBSERVATIONS: dict[str, Callable[[], object]] = {
    "observation: front = 1.5: must be a whole number from 0 to 64": lambda: ObservationSpec(1.5, 0),
    "observation: front = True: must be a whole number from 0 to 64": lambda: ObservationSpec(True, 0),
    "observation: front = 65: must be a whole number from 0 to 64": lambda: ObservationSpec(65, 0),
    "observation: front = -1: must be a whole number from 0 to 64": lambda: ObservationSpec(front=-1),
    "observation: obstacle = 1: must be True or False": lambda: ObservationSpec(obstacle=1),
    "observe: vehicle = 4: must be an index from 0 to 2": lambda: observe(
        load_scenario("paper-random").sample(1, 7).worlds, 4, ObservationSpec()
    ),
    "observation: features of the groups contact and contact_far need the time between two decisions; pass": lambda: (
        observe(WORLDS, 1, choose_observation(["own", "contact"]))
    ),
    "observation: time_step_s = -1.0: must be a finite number of seconds above 0": lambda: ObservationSpec(
        contact=True, time_step_s=-1.0
    ),
    "policy: scenario: time_step_s = None: must be a number of seconds above 0,": lambda: make_policy(
        choose_observation(["own", "contact"]), {}
    ),
}


@pytest.mark.parametrize("message", OBSERVATIONS)
def test_observation__is_refused(message: str) -> None:
    with refused(message):
        OBSERVATIONS[message]()


REWARDS: dict[str, Callable[[], object]] = {
    "must be a name (harm, total-harm, paper), a mapping such as {'harm': 1.0}": lambda: reward_params(5),
    "reward: jerk = -1.0: must be greater than or equal to 0": lambda: reward_params({"jerk": -1.0}),
    "reward: harm = nan: must be a finite number": lambda: reward_params({"harm": np.nan}),
    "reward: harm_count = 'all': must be first or total": lambda: reward_params({"harm_count": "all"}),
    "reward: shaping_discount = 1.5: must be less than or equal to 1": lambda: reward_params({"shaping_discount": 1.5}),
    "reward: jerk = 'a': must be a number": lambda: reward_params({"jerk": "a"}),
    "reward: harm: must be given together with shaping, because its default weight is 1": lambda: reward_params(
        {"shaping": 1.0}
    ),
    "reward: objective: has no effect, because it changes only the term harm, whose weight is 0; leave it": lambda: (
        reward_params({"harm": 0.0, "objective": "own"})
    ),
}


@pytest.mark.parametrize("message", REWARDS)
def test_reward__is_refused(message: str) -> None:
    with refused(message):
        REWARDS[message]()


OBJECTIVES: dict[str, Callable[[], object]] = {
    "scenario 'paper-random': objective = onw: unknown objective 'onw'; did you mean 'own'?": lambda: PAPER.replace(
        objective="onw"
    ),
    "scenario 'paper-random': objective = own:1: objective 'own:1'": lambda: PAPER.replace(objective="own:1"),
    "objective 'social': social needs an angle from 0 to 90 degrees": lambda: PAPER.replace(objective="social"),
    "objective 'social:91': social needs an angle from 0 to 90 degrees": lambda: PAPER.replace(objective="social:91"),
    "objective 'social:nan': social needs an angle": lambda: PAPER.replace(objective="social:nan"),
    "objective 'social:4_5': social needs an angle": lambda: PAPER.replace(objective="social:4_5"),
    "'weighted:0,0,0': weighted needs one weight per vehicle, as in weighted:1,4,1; a weight is 0": lambda: (
        PAPER.replace(objective="weighted:0,0,0")
    ),
    "'weighted:1,-1,1': weighted needs one weight per vehicle, as in weighted:1,4,1; a weight is 0": lambda: (
        PAPER.replace(objective="weighted:1,-1,1")
    ),
    "'weighted': weighted needs one weight per vehicle, as in weighted:1,4,1; a weight is 0": lambda: PAPER.replace(
        objective="weighted"
    ),
    "scenario 'paper-random': objective = \"weighted:1,2\": objective 'weighted:1,2': has 2 weights; must": lambda: (
        PAPER.replace(objective="weighted:1,2")
    ),
    "2 entries; must have 3, one per vehicle; or give one objective for all vehicles,": lambda: PAPER.replace(
        objective=["own", "own"]
    ),
    "objective = 5: must be the name of an objective, for instance own or social:45, or a list with one name": lambda: (
        PAPER.replace(objective=5)
    ),
    "objective = [own, 5, own]: must be the name of an objective, for": lambda: PAPER.replace(
        objective=["own", 5, "own"]
    ),
    "reward: objective 'weighted:1,2': has 2 weights; must have 3, one per": lambda: parallel_env(
        PAPER, reward={"objective": "weighted:1,2"}
    ),
    "reward: objective = 'onw': unknown objective 'onw'; did you mean 'own'?": lambda: parallel_env(
        PAPER, reward={"objective": "onw"}
    ),
    "reward: objective = 5: must be the name of an objective, for instance": lambda: parallel_env(
        PAPER, reward={"objective": 5}
    ),
    "scored = 'own': must be a list of objectives, for instance ['own']": lambda: scored(
        empty_ledger(line([5.0], [9.0, 9.0])), "first", "own"
    ),
    "objective 'social:91': social needs an angle from 0 to 90 degrees, as in social:45": lambda: objectives_of(
        "social:91", 2
    ),
    "objective 'weighted:1,2,3': has 3 weights; must have 2, one per vehicle": lambda: objectives_of(
        "weighted:1,2,3", 2
    ),
}


@pytest.mark.parametrize("message", OBJECTIVES)
def test_objective__is_refused(message: str) -> None:
    with refused(message):
        OBJECTIVES[message]()


ENGINE: dict[str, Callable[[], object]] = {
    "engine: deciders = (3,): must be indices of vehicles, from 0 to": lambda: Engine(
        PAPER, 1, learners=(), scripts=SCRIPTS, deciders=(3,)
    ),
    "engine snapshot: the array state has the shape (6, 20); must have the shape (7, 20)": lambda: make_engine(
        PAPER, 7
    ).restore(make_engine(PAPER, 6).snapshot()),
    "renew: rows = [1, 9]: must be different row numbers from 0 to 5": lambda: make_engine(PAPER, 6).renew([1, 9]),
    "observe: vehicle = 'vehicle_2': must be a vehicle index": lambda: make_engine(PAPER, 6).observe("vehicle_2"),
    "since: the argument before must be an earlier ledger (record of harm) of the same episodes; call since": lambda: (
        make_engine(PAPER, 6).ledger.since(make_engine(PAPER, 1).ledger)
    ),
}


@pytest.mark.parametrize("message", ENGINE)
def test_engine__refuses(message: str) -> None:
    with refused(message):
        ENGINE[message]()


NAMES: dict[str, Callable[[], object]] = {
    "unknown reward 'papr'; did you mean 'paper'?": lambda: reward_params("papr"),
    "unknown setting of a reward 'hram'; did you mean 'harm'?": lambda: reward_params({"hram": 1.0}),
    "unknown side 'Front'; did you mean 'front'?": lambda: injury_probability(5.0, "Front"),
    "unknown objective 'ownn'; did you mean 'own'?": lambda: objectives_of("ownn", 2),
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


def test_branch__has_an_end_and_no_shaping() -> None:
    shaped = make_engine(PAPER, 2, reward={"harm": 1.0, "shaping": 0.1})
    with refused("branch: the reward has shaping = 0.1; branch needs shaping = 0"):
        shaped.branch(shaped.moment())


def test_snapshot__of_another_engine_is_refused() -> None:
    kept = make_engine(PAPER, 6).snapshot()
    with refused("engine snapshot: the array params has the shape (6, 25); must have the shape (6, 37)"):
        make_engine(load_scenario("cooperation-2-blocked"), 6).restore(kept)
    del kept["params"]
    with refused("engine snapshot: the array params is missing; must have the shape (6, 25)"):
        make_engine(PAPER, 6).restore(kept)
