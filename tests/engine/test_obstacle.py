"""The engine and its infos where an obstacle stands ahead of Vehicle 1."""

from __future__ import annotations

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.defaults import HARM_COUNTS
from ethbrake_marl.envs.interfaces import make_engine
from ethbrake_marl.physics import Worlds, advance
from ethbrake_marl.scenario import load_scenario

ALL = load_scenario("cooperation-4-all")
NEAR = ALL.replace(obstacle_gap_m={"uniform": [10, 45]})  # within the way of full braking in many worlds


def test_engine__steps_as_advance_does_and_its_ledger_counts_the_obstacle():
    engine = make_engine(NEAR.replace(v2x="congested"), 60, seed=5, reward="total-harm")
    worlds, ledger = engine.worlds, engine.ledger
    rng, rewards = np.random.default_rng(2), np.zeros(60)
    for _ in range(70):
        running = ~engine.ended
        step = engine.step(rng.uniform(-1.0, -0.8, (60, 3)))
        until = np.where(running, engine.worlds.time_s, worlds.time_s)
        worlds, impacts = advance(worlds, engine.wanted_mps2, until_s=until)
        ledger, rewards = ledger.add(impacts), rewards + step.reward[:, 0]
    assert engine.worlds.obstacle_gap_m.tobytes() == worlds.obstacle_gap_m.tobytes()
    assert engine.worlds.obstacle_hit.tobytes() == worlds.obstacle_hit.tobytes()
    for harm_count in HARM_COUNTS:
        assert engine.ledger.obstacle_harm(harm_count).tobytes() == ledger.obstacle_harm(harm_count).tobytes()
        shares = engine.ledger.vehicle_harm(harm_count)
        np.testing.assert_allclose(shares.sum(axis=1), engine.ledger.world_harm(harm_count), rtol=1e-12)
    assert (engine.ledger.obstacle_count > 0).sum() > 20 and (engine.ledger.obstacle_count == 0).any()
    np.testing.assert_allclose(rewards, -engine.ledger.world_harm("total"), rtol=1e-12)
    untouched = (engine.ledger.count.sum(axis=1) == 0) & (engine.ledger.obstacle_count > 0)
    assert engine.ledger.collided[untouched].all()


def test_infos__tell_the_same_shares_as_the_ledger():
    env = eb.parallel_env(NEAR)
    env.reset(seed=11)
    while env.agents:
        infos = env.step({name: np.array([-0.1], np.float32) for name in env.agents})[4]
    ledger = env.engine.ledger
    assert ledger.obstacle_count[0] > 0
    for count, key in (("first", "first_impact_harm"), ("total", "total_harm")):
        assert [infos[f"vehicle_{i + 1}"][key] for i in range(3)] == ledger.vehicle_harm(count)[0].tolist()
        assert infos["vehicle_3"][f"world_{key}"] == ledger.world_harm(count)[0]
    gap = np.float32(env.engine.worlds.obstacle_gap_m[0] / 10.0)
    assert env.state()[-2:].tolist() == [gap, 1.0]
    assert env.state_space.contains(env.state()) and len(env.state()) == 28


def test_engine__worlds_that_are_given_may_have_an_obstacle_or_none_whatever_the_scenario_says():
    plain = load_scenario("cooperation-3-pair")
    given = Worlds.concatenate([NEAR.sample(2, 1).worlds, plain.sample(2, 1).worlds])
    for scenario in (plain, ALL.with_learners([1, 2])):
        engine = make_engine(scenario, 4, seed=1)
        engine.reset(worlds=given)
        for _ in range(30):
            engine.step(np.zeros((4, 2)))
        assert np.isfinite(engine.worlds.obstacle_gap_m).tolist() == [True, True, False, False]
        engine.renew(np.array([0, 3]))
        expected = [scenario.obstacle_gap_m is not None, True, False, scenario.obstacle_gap_m is not None]
        assert np.isfinite(engine.worlds.obstacle_gap_m).tolist() == expected
