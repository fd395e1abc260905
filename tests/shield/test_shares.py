"""What each vehicle bears, as the interfaces tell it."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from ethbrake_marl.envs.interfaces import EthBrakeVectorEnv, parallel_env
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.shield import HybridShield, ShieldedEnv, ShieldedVectorEnv, shielded_aec
from ethbrake_marl.shield.sb3 import ShieldedVecEnv

SHARES = {"own_harm", "baseline_own_harm"}
TEAM, ONE = "cooperation-4-all", "paper-random"


@pytest.mark.parametrize("settings", [{"shares": True}, {"cap": "baseline"}, {"shares": True, "harm_count": "total"}])
@pytest.mark.parametrize("scenario", [TEAM, ONE])
def test_parallel__at_the_end_the_share_is_what_the_ledger_says(scenario, settings):
    env = HybridShield(parallel_env(scenario), mode="step", **settings)
    differed = 0
    for seed in range(4):
        _, infos = env.reset(seed=seed)
        before = {agent: infos[agent]["shield"] for agent in env.shielded}
        while env.agents:
            *_, infos = env.step({agent: [0.6] for agent in env.shielded})
            assert all(set(infos[agent]["shield"]) == set(before[agent]) >= SHARES for agent in env.shielded)
        borne = env.unwrapped.engine.ledger.vehicle_harm(settings.get("harm_count", "first"))[0]
        for agent in env.shielded:
            told = infos[agent]["shield"]
            i = int(agent[-1]) - 1
            assert told["own_harm"] == borne[i]
            assert told["baseline_own_harm"] == before[agent]["own_harm"] == before[agent]["baseline_own_harm"]
            assert told["own_harm"] <= told["baseline_own_harm"] or "cap" not in settings
            differed += told["own_harm"] != told["baseline_own_harm"]
    assert differed > 0


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_gymnasium__tells_of_every_row_the_episode_that_ended(mode):
    env = ShieldedVectorEnv(EthBrakeVectorEnv(7, ONE, autoreset_mode=mode), shares=True)
    _, infos = env.reset(seed=5)
    keys, ended = set(infos["shield"]), 0
    assert keys >= SHARES and infos["shield"]["own_harm"].shape == (7,)
    rng = np.random.default_rng(0)
    for _ in range(130):
        *_, terminated, truncated, infos = env.step(rng.uniform(-1.0, 1.0, (7, 1)))
        told = infos["shield"]
        assert set(told) == keys and (told["own_harm"] >= 0.0).all()
        for k in np.flatnonzero(terminated | truncated):
            one = infos["final_info"] if mode == "SameStep" else infos
            assert told["own_harm"][k] == one["first_impact_harm"][k]
            ended += 1
    assert ended > 7


def test_sb3__each_row_is_told_its_own_vehicles_share():
    env = ShieldedVecEnv(make_sb3_vec_env(TEAM, 3, seed=2), shares=True)
    env.reset()
    rng, ended = np.random.default_rng(1), 0
    for _ in range(100):
        _, _, done, infos = env.step(rng.uniform(-1.0, 1.0, (9, 1)).astype(np.float32))
        for row in np.flatnonzero(done):
            assert infos[row]["shield"]["own_harm"] == infos[row]["first_impact_harm"]
            ended += 1
    assert ended > 0


def test_aec_and_gymnasium_of_one_row__tell_it_too():
    env = shielded_aec(parallel_env(TEAM), mode="step", shares=True)
    env.reset(seed=5)
    told = {}
    for agent in env.agent_iter():
        *_, terminated, truncated, info = env.last()
        told[agent] = info["shield"]["own_harm"]
        env.step(None if terminated or truncated else np.array([0.3], np.float32))
    borne = env.unwrapped.engine.ledger.vehicle_harm("first")[0]
    assert [told[f"vehicle_{i + 1}"] for i in range(3)] == borne.tolist()
    single = ShieldedEnv(gymnasium.make("EthBrake-v0").unwrapped, shares=True, uncertainty="gaps_m=0.2")
    _, info = single.reset(seed=1)
    start = set(info["shield"])
    assert start >= SHARES and set(single.step([0.0])[4]["shield"]) == start


def test_shares__are_told_where_they_are_asked_for_alone():
    env = HybridShield(parallel_env(ONE), mode="step")
    _, infos = env.reset(seed=1)
    assert not SHARES & set(infos["vehicle_2"]["shield"])
    with pytest.raises(InvalidInput, match="shares = True: mode episode takes none"):
        HybridShield(parallel_env(ONE), mode="episode", shares=True)
