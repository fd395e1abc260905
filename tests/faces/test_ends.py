"""An end after a number of steps is the end of a shorter horizon, but motion has no price, and infos say ``cut``."""

from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.faces.registration import register_environments
from tests.contract.interfaces import BARE, CRASH, EPISODE, FIVE, PAPER, REST, actions

PAIR = eb.load_scenario("cooperation-3-pair").replace(v2x="paper")
EVERY = {
    "harm": 1.0, "harm_count": "total", "terminal": 3.0, "shaping": 0.5, "risk": 0.1, "last": 11.0,
}  # fmt: skip
NAMES = {"vector": "max_episode_steps"}  # of the argument; otherwise max_cycles


def last(before: eb.State, step: eb.Step, after: eb.State) -> Any:
    """Time, flags and harm of the step that ends an episode."""
    flags = step.truncated * 2.0 + step.terminated * 4.0 + step.safe_end * 8.0
    return after.ended * (1.0 + after.time_s + flags + after.harm("total"))


@pytest.fixture(autouse=True)
def _last() -> None:
    eb.register_term("last", last)


def first_s(scenario: eb.Scenario) -> float:
    """Time of the first decision, the same in every world."""
    (time_s,) = set(eb.open_game(scenario)[1].reset(scenario.sample(20, seed=7)).time_s)
    return float(time_s)


def told(env: Any, steps: int, learners: list[str]) -> list[Any]:
    """All that an environment of PettingZoo returns in several episodes."""
    values = []
    for k, action in enumerate(actions(3, steps, len(learners))):
        if not env.agents:
            values.append(env.reset(seed=7 if k == 0 else None))
        values.append(env.step(dict(zip(learners, action, strict=True)))[1:])
    return values


def taken(values: list[Any], name: str) -> list[Any]:
    """The info ``name`` of each return, taken out of the infos of all agents, which agree."""
    columns = [{info.pop(name) for info in value[-1].values()} for value in values]
    return [column for (column,) in columns]


def check_ends(scenario: eb.Scenario, steps: int) -> None:
    """Compare all terms of episodes of so many steps with those of a shorter horizon."""
    horizon_s = first_s(scenario) + steps * scenario.time_step_s
    learners = [f"vehicle_{body}" for body in scenario.learners]
    runs = [
        told(eb.parallel_env(each, reward=EVERY, max_cycles=most), 5 * steps, learners)
        for each, most in ((scenario, steps), (scenario.replace(horizon_s=horizon_s), None))
    ]
    ends = [len(value) == 4 and any(value[2].values()) for value in runs[0]]
    assert sum(ends) == 5
    assert taken(runs[0], "cut") == ends and not any(taken(runs[1], "cut"))
    costs = [np.array(taken(run, "world_honest_cost")) for run in runs]
    assert (costs[0] <= costs[1]).all() and not (costs[0] != costs[1])[~np.array(ends)].any()  # motion at the horizon
    assert str(runs[0]) == str(runs[1])


@pytest.mark.parametrize(
    ("scenario", "steps"), [(PAPER, 4), (PAIR, 12), (FIVE, 5)], ids=["paper", "two learners", "scripts"]
)
def test_most_steps__are_a_shorter_horizon_to_every_term(scenario: eb.Scenario, steps: int) -> None:
    check_ends(scenario, steps)


@pytest.mark.parametrize("name", [*BARE, "episode parallel"])
def test_most_steps__are_a_shorter_horizon_at_every_interface(name: str) -> None:
    make = partial(BARE["parallel"], wrap=EPISODE) if name == "episode parallel" else BARE[name]
    most = {NAMES.get(name.split()[-1], "max_cycles"): 4}
    runs = []
    for scenario, settings in ((PAPER, most), (PAPER.replace(horizon_s=0.5 + 4 * 0.1), {})):
        interface = make(scenario, 4, reward=EVERY, **settings)
        interface.reset(7)
        runs.append([interface.step(action).bits() for action in actions(3, 9, interface.n)])
    assert runs[0] == runs[1]


@pytest.mark.parametrize(("name", "most"), [("single", 10), ("single", 11), ("vector", 10), ("vector", 2**70)])
def test_most_steps__that_are_not_reached_change_nothing(name: str, most: int) -> None:
    runs = []
    for settings in ({NAMES.get(name, "max_cycles"): most}, dict[str, Any]()):
        interface = BARE[name](REST, 2, reward=EVERY, **settings)  # at rest in its 10th step
        interface.reset(7)
        runs.append([interface.step(np.full((interface.n, 1), -1.0, np.float32)).bits() for _ in range(21)])
    assert runs[0] == runs[1]


def test_most_steps__from_each_world_s_own_first_decision() -> None:
    scenario = PAPER.replace(latency_s=[0, {"uniform": [0.1, 0.6]}, 0.7])
    env = eb.EthBrakeVectorEnv(5, scenario, reward=EVERY, max_episode_steps=4, autoreset_mode="SameStep")
    state, drawn = env.reset(seed=7)[1]["time_s"], scenario.sample(5, 7, purpose="training")
    driven = actions(3, 4, 5)
    for action in driven:
        _, rewards, _, truncated, infos = env.step(action)
    assert truncated.all() and len(set(state)) == 5
    for k in range(5):
        horizon_s = float(state[k] + 4 * 0.1)
        alone = eb.EthBrakeEnv(scenario.replace(horizon_s=horizon_s), reward=EVERY)
        alone.reset(options={"initial_state": {
            "gaps_m": drawn.gaps_m[k], "speeds_mps": drawn.speeds_mps[k], "latency_s": drawn.latency_s[k],
            "braking_capacity_mps2": drawn.braking_capacity_mps2[k], "mass_t": drawn.mass_t[k],
            "driving_capacity_mps2": drawn.driving_capacity_mps2[k], "restitution": drawn.restitution[k],
        }})  # fmt: skip
        for action in driven:
            _, reward, terminated, cut, info = alone.step(action[k])
        assert (reward, terminated, cut) == (rewards[k], False, True)
        final = {name: column[k] for name, column in infos["final_info"].items() if name in info}
        assert final["cut"] and not info["cut"] and final["world_honest_cost"] < info["world_honest_cost"]
        same = {"world_seed": 0, "world": 0, "cut": 0, "world_honest_cost": 0}  # motion is priced at the horizon alone
        assert {**final, **same} == {**info, **same}


def test_terminal__is_paid_by_hand_and_through_gymnasium() -> None:
    register_environments()
    env = gymnasium.make("EthBrake-v3", scenario="paper-random", reward={"harm": 0, "terminal": 1}, max_cycles=2)
    env.reset(seed=7)
    assert [env.step([0.0])[1:4] for _ in range(2)] == [(0.0, False, False), (1.0, False, True)]


def test_motion__has_a_price_at_the_horizon_alone() -> None:
    # Coasting at 20 m/s until 0.9 s, without contact; Vehicle 1, which follows a script, then has 14.6 m/s.
    price, reward = 20.0**2 - 14.6**2, {"harm": 1, "harm_count": "honest", "still_moving": 0, "shaping": 0.0}
    for horizon_s, most, expected in (
        (1.3, 4, (0.0, 0.0, True)),
        (0.9, None, (-price, -1.0, False)),
        (0.9, 4, (-price, -1.0, False)),  # a cut at the horizon is the horizon
        (0.9, 9, (-price, -1.0, False)),
    ):
        scenario = CRASH.replace(horizon_s=horizon_s)
        crash = eb.EthBrakeEnv(scenario, reward=reward, report=["still_moving"], max_cycles=most)
        crash.reset()
        steps = [crash.step([0.0]) for _ in range(4)]
        assert [step[1] for step in steps] == [0.0, 0.0, 0.0, pytest.approx(expected[0])], (horizon_s, most)
        assert [(step[4]["reward_still_moving"], step[4]["cut"]) for step in steps] == [(0.0, False)] * 3 + [
            expected[1:]
        ]
        assert steps[-1][2:4] == (False, True)


def test_cut__is_false_where_all_vehicles_have_come_to_rest() -> None:
    env = eb.EthBrakeEnv(REST, max_cycles=10)  # at rest in its 10th step
    env.reset()
    *_, last_step = [env.step([-1.0]) for _ in range(10)]
    assert last_step[2:4] == (True, False) and last_step[4]["cut"] is False


@pytest.mark.parametrize("horizon_is_end", [True, False])
def test_cut__is_a_truncation_by_every_door(horizon_is_end: bool) -> None:
    for scenario, most, flags in (
        (CRASH, 4, (False, True)),
        (CRASH, 8, (False, True)),  # the horizon itself
        (REST, 10, (True, False)),  # at rest in the step of the cut
    ):
        env = eb.make_sb3_vec_env(scenario, 2, horizon_is_end=horizon_is_end, max_cycles=most)
        env.reset()
        for _ in range(most):
            *_, done, infos = env.step([[-1.0]] * 2)
        is_horizon = scenario is CRASH and most == 8
        expected = flags[1] and not (is_horizon and horizon_is_end)
        assert done.all() and [info["TimeLimit.truncated"] for info in infos] == [expected] * 2
        for name, make in BARE.items():
            interface = make(scenario, 1, **{NAMES.get(name, "max_cycles"): most})
            interface.reset(7)
            turns = [interface.step(np.full((1, 1), -1.0, np.float32)) for _ in range(most)]
            assert (turns[-1].terminated[0], turns[-1].truncated[0]) == flags, (name, most)
