"""What a world was drawn as, on every interface: the very numbers of its sample, for every world that has begun."""

from __future__ import annotations

import json
from typing import Any

import gymnasium
import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.envs.interfaces import describe_worlds
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.scenario.sampling import QUANTITY

MIXED = load_scenario("realistic-mixed")
BOTH = load_scenario(
    {"name": "both", "mixture": [{"scenario": "realistic-mixed"}, {"scenario": "realistic-truck"}]}
)  # types in one of the two


def expected(seed: int, world: int) -> dict[str, Any]:
    """World ``world`` as its sample says."""
    sample = BOTH.sample(1, seed, first=world, channel="training")
    assert sample.types is not None
    assert sample.scenarios is not None
    found: dict[str, Any] = {"scenario": sample.scenarios[0].item(), "world_seed": seed, "world": world}
    found |= {f"vehicle_{i + 1}_type": sample.types[0, i].item() for i in range(3)}
    return found | {name: column[0].item() for name, column in QUANTITY.columns(sample.worlds).items()}


def rows(columns: dict[str, Any]) -> list[dict[str, Any]]:
    n = len(columns["world"])
    return [{name: column[k].item() for name, column in columns.items()} for k in range(n)]


def test_one_world__after_reset_and_during_the_episode():
    for env in (eb.parallel_env(scenario=BOTH), eb.EthBrakeEnv(scenario=BOTH)):
        with pytest.raises(InvalidInput, match="call reset first"):
            env.describe_world()
        env.reset(seed=3)
        assert env.describe_world() == expected(3, 0)
        env.step({"vehicle_2": [-1.0]} if isinstance(env, eb.EthBrakeParallelEnv) else [-1.0])  # type: ignore[arg-type]
        assert env.describe_world() == expected(3, 0)
        env.reset()
        assert env.describe_world() == expected(3, 1)
        json.dumps(env.describe_world())


def test_wrapped__through_what_is_inside():
    made = gymnasium.make("EthBrake-v0", scenario=BOTH)
    made.reset(seed=3)
    assert made.unwrapped.describe_world() == expected(3, 0)  # type: ignore[attr-defined]
    turns = eb.raw_env(scenario=BOTH)
    turns.reset(seed=3)
    assert turns.unwrapped.describe_world() == expected(3, 0)
    shielded = eb.HybridShield(eb.parallel_env(scenario=BOTH), mode="step")
    shielded.reset(seed=3)
    assert shielded.describe_world() == expected(3, 0)


def test_batch__rows_that_were_renewed_too():
    env = eb.EthBrakeVectorEnv(num_envs=5, scenario=BOTH)
    _, infos = env.reset(seed=3)
    for step in range(90):
        if step % 15 == 0:
            assert rows(env.describe_worlds()) == [expected(3, world) for world in infos["world"].tolist()]
        infos = env.step(np.full((5, 1), -1.0))[4]
    assert infos["world"].max() > 5


def test_stable_baselines__one_row_per_world():
    env = eb.make_sb3_vec_env(BOTH, 4, seed=3, learners=["vehicle_2", "vehicle_3"])
    with pytest.raises(InvalidInput, match="call reset first"):
        env.describe_worlds()
    env.reset()
    assert rows(env.describe_worlds()) == [expected(3, world) for world in range(4)]
    assert env.env_method("describe_worlds")[0]["scenario"].tolist() == env.describe_worlds()["scenario"].tolist()


def test_given_worlds__are_told_until_others_take_their_places():
    start = {"gaps_m": [7, 8], "speeds_mps": [20, 18, 20], "mass_t": [1, 2, 3], "braking_capacity_mps2": 6}
    start |= {"driving_capacity_mps2": 1, "latency_s": [0, 0.5, 0.8], "speed_limit_mps": 40}
    env = eb.EthBrakeVectorEnv(num_envs=2, scenario=MIXED)
    env.reset(seed=3, options={"initial_state": start})
    told = env.describe_worlds()
    assert told["gap_2_m"].tolist() == [8.0, 8.0]
    assert told["mass_3_t"].tolist() == [3.0, 3.0]
    assert told["world"].tolist() == [-1, -1]
    env.engine.renew(np.array([1]))
    told = env.describe_worlds()
    assert told["gap_2_m"][0] == 8.0
    assert told["vehicle_2_type"][0] == ""
    assert told["vehicle_2_type"][1] == MIXED.sample(1, 3, channel="training").types[0, 1]  # type: ignore[index]


def test_after_a_snapshot__nobody_knows():
    env = eb.EthBrakeVectorEnv(num_envs=2, scenario=MIXED)
    env.reset(seed=3)
    env.engine.restore(env.engine.snapshot())
    with pytest.raises(InvalidInput, match="go on from a snapshot, which does not keep what they were drawn as"):
        env.describe_worlds()
    env.reset()
    assert env.describe_worlds()["world"].min() >= 2


def test_another_scenario_of_the_same_stream__is_found_out():
    env = eb.EthBrakeVectorEnv(num_envs=2, scenario=MIXED)
    env.reset(seed=3)
    env.engine.roster.numbers[1] = 40  # as if world 40 had been left out
    with pytest.raises(InvalidInput, match=r"world 40 of seed 3 could not be advanced .* another one stands in row 1"):
        describe_worlds(env.engine)
