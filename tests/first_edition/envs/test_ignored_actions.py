"""Whoever passes actions for vehicles that follow scripts is warned, once; nobody else is."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pettingzoo.utils.conversions import aec_to_parallel

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.envs.making import IgnoredAction

COAST = np.zeros(1, np.float32)


def together(env: Any) -> None:
    """One step of PettingZoo's usual loop."""
    env.step({agent: COAST for agent in env.agents})


def in_turn(env: Any) -> None:
    """One step of every agent."""
    for _ in env.possible_agents:
        env.step(COAST)


Ways = dict[str, tuple[Callable[..., Any], Callable[[Any], None]]]
WAYS: Ways = {
    "parallel": (eb.parallel_env, together),
    "shielded parallel": (lambda **settings: eb.shield(eb.parallel_env(**settings)), together),
    "in turn": (eb.env, in_turn),
    "shielded in turn": (lambda **settings: eb.shield(eb.env(**settings)), in_turn),
    "in turn and back": (lambda **settings: aec_to_parallel(eb.env(**settings)), together),
}
each_way = pytest.mark.parametrize("way", WAYS)


def told(way: str, steps: int = 3, **settings: Any) -> list[str]:
    """What a user reads, with Python's own filter, during some steps of two episodes."""
    make, step = WAYS[way]
    env = make(**settings)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default", IgnoredAction)
        for _ in range(2):
            env.reset()
            for _ in range(steps):
                step(env)
    return [str(each.message) for each in caught if each.category is IgnoredAction]


@each_way
def test_warning__comes_once_names_the_vehicles_and_what_to_do(way: str) -> None:
    (text,) = told(way)
    assert text == (
        "step: actions of vehicle_1, vehicle_3 are ignored, because scripts drive these vehicles; create the"
        " environment with agents='learners' if only vehicle_2 should be agents"
    )


@each_way
@pytest.mark.parametrize(
    "settings", [{"agents": "learners"}, {"learners": [0, 1, 2], "scenario": "cooperation-4-all"}], ids=str
)
def test_warning__does_not_come_where_every_agent_learns(way: str, settings: dict[str, Any]) -> None:
    assert told(way, **settings) == []


def test_warning__says_that_nobody_learns() -> None:
    (text,) = told("parallel", learners=[])
    assert text.endswith("these vehicles; no vehicle is a learner; name learners, for instance learners=['vehicle_2']")


@pytest.mark.parametrize("actions", [{}, {"vehicle_1": None, "vehicle_3": None}], ids=str)
def test_warning__does_not_come_for_actions_that_are_left_out(actions: dict[str, Any]) -> None:
    env, turns = eb.parallel_env(), eb.env()
    env.reset(seed=0), turns.reset(seed=0)
    env.step({"vehicle_2": COAST, **actions})
    for agent in turns.possible_agents:
        turns.step(COAST if agent == "vehicle_2" else None)


def test_warning__of_a_step_that_is_refused_comes_with_it_and_not_again() -> None:
    env = eb.parallel_env()
    env.reset(seed=0)
    with pytest.warns(IgnoredAction), pytest.raises(InvalidInput, match="the action of learner vehicle_2 is missing"):
        env.step({"vehicle_1": COAST})
    env.step(dict.fromkeys(env.agents, COAST))


def test_engine__refuses_actions_of_vehicles_that_do_not_learn() -> None:
    engine = eb.make_engine("paper-random", 2)
    for extra in (2, 7):
        with pytest.raises(InvalidInput, match=rf"step: vehicle index {extra} has an action .* indices \(1,\)"):
            engine.step({1: np.zeros(2), extra: np.zeros(2)})
