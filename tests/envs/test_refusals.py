"""What environments refuse: how they are made, reset and stepped."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl import parallel_env
from ethbrake_marl.errors import UnknownName
from ethbrake_marl.scenario.catalogue import load_scenario
from tests.contract.interfaces import CRASH, FIVE, PAPER
from tests.refused import refused

PAIR = ["vehicle_2", "vehicle_3"]
FAR, NEAR = ({"initial_state": {"gaps_m": np.array([gap])}} for gap in (40.0, 4.0))


def started(env: Any, seed: int = 3) -> Any:
    """The environment, with an episode begun."""
    env.reset(seed=seed)
    return env


def rows(*options: dict[str, Any]) -> Any:
    """Two worlds of two learners, whose next reset has these options by row."""
    env = eb.make_sb3_vec_env(CRASH.replace(obstacle_gap_m=30), 2, learners=["vehicle_1", "vehicle_2"])
    env.set_options(list(options))
    return env


MADE: dict[str, Callable[[], object]] = {
    "learners = 5: must be a list of vehicle names, for instance ['vehicle_2']": lambda: parallel_env(FIVE, learners=5),
    "learners: 'vehicle_2': must be a list of vehicles": lambda: eb.EthBrakeEnv(learners="vehicle_2"),
    "scenario 'paper-random': mass_t = -1: must be finite and in (0, 1000] t (tonnes)": lambda: parallel_env(
        {**load_scenario("paper-random").declared(), "mass_t": -1.0}
    ),
    "must be a name (harm, total-harm, paper), a mapping such as {'harm': 1.0}": lambda: parallel_env(reward=5),
    "observation = 'x': must be a list of groups and features such as ['own', 'front_1'], an ObservationSpec": lambda: (
        parallel_env(observation="x")
    ),
    "observation: front = 'two': must be a whole number from 0 to 64": lambda: parallel_env(
        observation={"front": "two"}
    ),
    "observation: chosen = 3: must be a list of names of features": lambda: parallel_env(observation={"chosen": 3}),
    "agents = 'scripted': must be 'all' or 'learners'": lambda: parallel_env(agents="scripted"),
    "agents = 'learners': scenario 'paper-random' has no learner; pass": lambda: parallel_env(
        agents="learners", learners=[]
    ),
    "max_cycles = 0: must be a whole number, at least 1": lambda: parallel_env(max_cycles=0),
    "must be one of 'human', 'rgb_array', 'rgb_array_list', 'ansi', or None": lambda: parallel_env(render_mode="depth"),
    "render_mode = 'depth': must be one of 'rgb_array', 'ansi', or None": lambda: eb.EthBrakeVectorEnv(
        render_mode="depth"
    ),
    "render_mode = 'ansi': must be 'rgb_array' or None": lambda: eb.make_sb3_vec_env(PAPER, 3, render_mode="ansi"),
    "render: the environment needs a render_mode: human, rgb_array, rgb_array_list, ansi; pass": lambda: (
        parallel_env().render()
    ),
    "render: no episode has started; call reset first": lambda: parallel_env(render_mode="rgb_array").render(),
    "step_frames: fps = 0: must be a whole number, at least 1": lambda: started(
        eb.EthBrakeEnv(render_mode="rgb_array")
    ).viewer.step_frames(0),
    "state: no episode has started; call reset first": lambda: parallel_env().state(),
    "describe_world: no episode has started; call reset first": lambda: eb.EthBrakeEnv().describe_world(),
    "describe_worlds: no episode has started; call reset first": lambda: eb.make_sb3_vec_env(
        PAPER, 4
    ).describe_worlds(),
    "scenario 'five' has 0 learners (none); this environment needs exactly one learner: pass": lambda: (
        eb.EthBrakeVectorEnv(2, FIVE, learners=[])
    ),
    "scenario 'paper-random' has no learner; pass learners=['vehicle_2']": lambda: eb.make_sb3_vec_env(
        PAPER, 2, learners=[]
    ),
    "must be 'NextStep' or 'SameStep' or 'Disabled'": lambda: eb.EthBrakeVectorEnv(2, autoreset_mode="same"),
    "number of worlds = 0: must be a whole number, at least 1": lambda: eb.EthBrakeVectorEnv(0),
    "reset: seed = -1: must be None or a whole number, at least 0": lambda: eb.make_sb3_vec_env(PAPER, 1, seed=-1),
    "appended = 'x': must be 'number', 'state' or None": lambda: eb.make_sb3_vec_env(FIVE, 3, appended="x"),
    "step: no episode is running; call reset first": lambda: eb.make_sb3_vec_env(PAPER, 2).step_wait(),
    "set_attr: indices = 0: must not be passed, because all worlds are simulated by one object": lambda: (
        eb.make_sb3_vec_env(PAPER, 3).set_attr("label", 8, indices=0)
    ),
    "must be an environment made by gymnasium.make_vec('EthBrake-v1')": lambda: eb.ShieldedVectorEnv(parallel_env()),
    "observation: vehicle_2 and vehicle_3 of 'five' observe different features, but must observe the same": lambda: (
        eb.make_sb3_vec_env(FIVE, 3, learners=PAIR, observation={"vehicle_3": ["own"]})
    ),
    "observe_all: vehicle_2, vehicle_3 observe different features; call observe for each vehicle": lambda: (
        eb.make_engine(FIVE, 3, learners=PAIR, observation={"vehicle_3": ["own"]}).observe_all()
    ),
    "scenario 'paper-random': observation.vehicle_4: unknown vehicle": lambda: PAPER.replace(
        observation={"vehicle_2": ["own"], "vehicle_4": ["own"]}
    ),
    "scenario 'paper-random': observation.vehicle_2 = [own, own.speed]: own.speed is listed twice": lambda: (
        PAPER.replace(observation={"vehicle_2": ["own", "own.speed"]})
    ),
    "scenario 'paper-random': observation = {}: must be a list of groups": lambda: PAPER.replace(observation={}),
    "observe different features, but must observe the same features here; give one list of features": lambda: eb.train(
        "cooperation-ppo", FIVE.with_learners(PAIR).replace(observation={"vehicle_2": ["own"]}), "run", scheme="shared"
    ),
}


@pytest.mark.parametrize("message", MADE)
def test_environment__is_not_made_or_asked_so(message: str) -> None:
    with refused(message):
        MADE[message]()


STEPS: dict[str, Callable[[], object]] = {
    "step: the action of learner vehicle_2 is missing": lambda: started(parallel_env(FIVE, learners=PAIR)).step(
        {"vehicle_3": [0.0]}
    ),
    "action of vehicle_3 = nan: must be from -1 (full braking) to 1 (full driving)": lambda: started(
        parallel_env(FIVE, learners=PAIR)
    ).step({"vehicle_2": [0.0], "vehicle_3": [np.nan]}),
    "action of vehicle_3 = -1.01: must be from -1 (full braking) to 1 (full driving)": lambda: started(
        parallel_env(FIVE, learners=PAIR)
    ).step({"vehicle_2": [0.0], "vehicle_3": [-1.01]}),
    "step: actions = None: must be a mapping from agent to action, such as {'vehicle_2': [-1.0]}": lambda: started(
        parallel_env()
    ).step(None),
    "reset: options = 5: must be None or a mapping": lambda: parallel_env().reset(options=5),
    "reset: listed_world = 3: must be seed and number of a world in an evaluation list": lambda: eb.EthBrakeEnv().reset(
        options={"listed_world": 3}
    ),
    "reset: listed_world = {'seed': 7}: must be seed and number of a world in an evaluation": lambda: (
        eb.EthBrakeEnv().reset(options={"listed_world": {"seed": 7}})
    ),
    "reset: listed_world: number = -1: must be a whole number, at least 0": lambda: eb.EthBrakeEnv().reset(
        options={"listed_world": {"seed": 7, "number": -1}}
    ),
    "reset: listed_world: seed = 0.5: must be a whole number, at least 0": lambda: eb.EthBrakeEnv().reset(
        options={"listed_world": {"seed": 0.5, "number": 40}}
    ),
    "reset: options has both initial_state and listed_world; pass only one of them": lambda: eb.EthBrakeEnv().reset(
        options={"listed_world": {"seed": 7, "number": 40}, "initial_state": {"gaps_m": 7}}
    ),
    "scenario 'paper-random' has 2 learners (vehicle_2, vehicle_3); this environment needs exactly one": lambda: (
        eb.EthBrakeEnv(PAPER, learners=PAIR)
    ),
    "action of the learners: has shape (3, 2); must have shape (3, 1)": lambda: started(eb.EthBrakeVectorEnv(3)).step(
        np.zeros((3, 2), np.float32)
    ),
    "action of vehicle_2 = nan: must be from -1 (full braking) to 1 (full driving)": lambda: started(
        eb.EthBrakeVectorEnv(2)
    ).step(np.full((2, 1), np.nan)),
    "env_method: indices = [1]: must not be passed, because all worlds are simulated by one object": lambda: (
        eb.make_sb3_vec_env(PAPER, 3).env_method("seed", 4, indices=[1])
    ),
    "set_options: entry 1 of the list is {'initial_state': {'gaps_m': array([4.])}};": lambda: rows(
        FAR, NEAR, NEAR, NEAR
    ).reset(),
    "set_options: entry 1 of the list is {}; give initial_state in all entries or in": lambda: rows(
        FAR, {}, NEAR, NEAR
    ).reset(),
    "set_options: the list has 2 entries; must have 4, one for each learner of each world": lambda: rows(
        FAR, FAR
    ).reset(),
}


@pytest.mark.parametrize("message", STEPS)
def test_reset_or_step__is_refused(message: str) -> None:
    with refused(message):
        STEPS[message]()


NAMES: dict[str, Callable[[], object]] = {
    "unknown vehicle 'vehicle_9'; did you mean 'vehicle_5'?": lambda: parallel_env(FIVE, learners=["vehicle_9"]),
    "unknown scenario 'paper-randm'; did you mean 'paper-random'?": lambda: eb.EthBrakeEnv("paper-randm"),
    "unknown reward 'harmm'; did you mean 'harm'?": lambda: eb.EthBrakeEnv(reward="harmm"),
    "unknown observation 'fronts'; did you mean 'front'?": lambda: parallel_env(observation={"fronts": 2}),
    "unknown feature 'fornt_1'; did you mean 'front_1'?": lambda: parallel_env(observation=["own", "fornt_1"]),
    "unknown agent 'vehicle_22'; did you mean 'vehicle_2'?": lambda: started(parallel_env()).step(
        {"vehicle_22": [0.0]}
    ),
    "unknown agent 'vehicle_1'; did you mean 'vehicle_2'?": lambda: started(parallel_env(agents="learners")).step(
        {"vehicle_1": [0.0], "vehicle_2": [0.0]}
    ),
    "unknown vehicle 'vehicle_9'; did you mean 'vehicle_3'?": lambda: parallel_env(
        PAPER, observation={"vehicle_9": ["own"]}
    ),
    "vehicle_2: unknown feature 'front_1.gab'; did you mean 'front_1.gap'?": lambda: parallel_env(
        PAPER, observation={"vehicle_2": ["own", "front_1.gab"]}
    ),
}


@pytest.mark.parametrize("message", NAMES)
def test_name__is_unknown(message: str) -> None:
    with refused(message, UnknownName):
        NAMES[message]()


def test_step__needs_an_episode_that_runs() -> None:
    with refused("step: no episode is running; call reset first"):
        parallel_env(FIVE).step({})
    in_turn = started(eb.env(scenario=PAPER, agents="learners", max_cycles=1))
    for _ in in_turn.possible_agents:
        in_turn.step(np.zeros(1, np.float32))
    with refused("step: the episode of vehicle_2 has ended; pass the action None, or call reset"):
        in_turn.step(np.zeros(1, np.float32))


def test_worlds__that_go_on_from_a_snapshot_are_not_described() -> None:
    env = eb.EthBrakeVectorEnv(2, PAPER)
    start = {"gaps_m": [7, 8], "speeds_mps": [20, 18, 20], "mass_t": 2, "braking_capacity_mps2": 6}
    start |= {"driving_capacity_mps2": 1, "latency_s": 0, "speed_limit_mps": 40}
    env.reset(options={"initial_state": start})
    env.engine.restore(env.engine.snapshot())
    with refused(
        "describe_worlds: the initial states of these worlds are not known, because the environment was restored"
    ):
        env.describe_worlds()


def test_world__that_was_left_out_is_not_described() -> None:
    env = started(eb.EthBrakeVectorEnv(2, "realistic-mixed"))
    env.engine.roster.numbers[1] = 40  # as if world 40 had been left out
    with refused(
        "describe_worlds: the random draw of row 1 is unknown: the physics failed in world 40 of seed 3 before its"
    ):
        env.describe_worlds()


def test_action__is_compared_after_the_rounding_of_float32() -> None:
    beyond = np.nextafter(np.float32(1), np.float32(2))
    with refused("action of vehicle_2 = 1.000000238418579: must be from -1 (full braking) to 1 (full driving)"):
        started(eb.EthBrakeVectorEnv(2)).step(np.full((2, 1), np.nextafter(beyond, np.float32(2))))
