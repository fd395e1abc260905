"""What environments refuse: how they are made, reset and stepped."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl import parallel_env
from ethbrake_marl.errors import UnknownName
from tests.first_edition.contract.interfaces import CRASH, FIVE, PAPER
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
    "learners = 5: must be a list of vehicle": lambda: parallel_env(FIVE, learners=5),
    "observation = 'x': must be a list of": lambda: parallel_env(observation="x"),
    "observation: chosen = 3: must be a list": lambda: parallel_env(observation={"chosen": 3}),
    "agents = 'scripted': must be 'all' or": lambda: parallel_env(agents="scripted"),
    "agents = 'learners': scenario": lambda: parallel_env(agents="learners", learners=[]),
    "max_cycles = 0: must be a whole number,": lambda: parallel_env(max_cycles=0),
    "must be one of 'human', 'rgb_array',": lambda: parallel_env(render_mode="depth"),
    "render_mode = 'ansi': must be": lambda: eb.make_sb3_vec_env(PAPER, 3, render_mode="ansi"),
    "render: the environment needs a": lambda: parallel_env().render(),
    "render: no episode has started; call": lambda: parallel_env(render_mode="rgb_array").render(),
    "state: no episode has started; call": lambda: parallel_env().state(),
    "scenario 'five' has 0 learners (none);": lambda: eb.EthBrakeVectorEnv(2, FIVE, learners=[]),
    "scenario 'paper-random' has no learner;": lambda: eb.make_sb3_vec_env(PAPER, 2, learners=[]),
    "must be 'NextStep' or 'SameStep' or": lambda: eb.EthBrakeVectorEnv(2, autoreset_mode="same"),
    "reset: seed = -1: must be None or a": lambda: eb.make_sb3_vec_env(PAPER, 1, seed=-1),
    "appended = 'x': must be 'number',": lambda: eb.make_sb3_vec_env(FIVE, 3, appended="x"),
    "step: no episode is running; call reset": lambda: eb.make_sb3_vec_env(PAPER, 2).step_wait(),
    "set_attr: indices = 0: must not be": lambda: eb.make_sb3_vec_env(PAPER, 3).set_attr("label", 8, indices=0),
    "observation: vehicle_2 and vehicle_3 of": lambda: eb.make_sb3_vec_env(
        FIVE, 3, learners=PAIR, observation={"vehicle_3": ["own"]}
    ),
    "observe_all: vehicle_2, vehicle_3": lambda: eb.make_engine(
        FIVE, 3, learners=PAIR, observation={"vehicle_3": ["own"]}
    ).observe_all(),
}


@pytest.mark.parametrize("message", MADE)
def test_environment__is_not_made_or_asked_so(message: str) -> None:
    with refused(message):
        MADE[message]()


STEPS: dict[str, Callable[[], object]] = {
    "step: the action of learner vehicle_2": lambda: started(parallel_env(FIVE, learners=PAIR)).step(
        {"vehicle_3": [0.0]}
    ),
    "step: actions = None: must be a mapping": lambda: started(parallel_env()).step(None),
    "reset: options = 5: must be None or a": lambda: parallel_env().reset(options=5),
    "reset: listed_world = 3: must be seed": lambda: eb.EthBrakeEnv().reset(options={"listed_world": 3}),
    "reset: options has both initial_state": lambda: eb.EthBrakeEnv().reset(
        options={"listed_world": {"seed": 7, "number": 40}, "initial_state": {"gaps_m": 7}}
    ),
    "set_options: entry 1 of the list is": lambda: rows(FAR, NEAR, NEAR, NEAR).reset(),
    "set_options: the list has 2 entries;": lambda: rows(FAR, FAR).reset(),
}


@pytest.mark.parametrize("message", STEPS)
def test_reset_or_step__is_refused(message: str) -> None:
    with refused(message):
        STEPS[message]()


NAMES: dict[str, Callable[[], object]] = {
    "unknown observation 'fronts'; did you": lambda: parallel_env(observation={"fronts": 2}),
    "unknown agent 'vehicle_22'; did you": lambda: started(parallel_env()).step({"vehicle_22": [0.0]}),
    "unknown vehicle 'vehicle_9'; did you": lambda: parallel_env(PAPER, observation={"vehicle_9": ["own"]}),
    "vehicle_2: unknown feature": lambda: parallel_env(PAPER, observation={"vehicle_2": ["own", "front_1.gab"]}),
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
