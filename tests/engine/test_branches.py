"""Branches: the same moment played on in several ways, against the engine itself and against a slow replay."""

from __future__ import annotations

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.engine import Moment
from ethbrake_marl.envs.interfaces import make_engine
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning import algorithms
from ethbrake_marl.learning.algorithms import Offsets, play_to_the_end

PAIR = ["vehicle_2", "vehicle_3"]


def act(seen):
    """A policy whose row k depends on row k alone: more braking where the gap is small."""
    return (seen[:, 8] - np.float32(0.9)).clip(-1.0, 1.0)


def no_offsets(n):
    return Offsets(np.zeros(n, np.int64), np.zeros(n), np.ones(n, np.int64))


def step_by_policy(engine):
    seen = engine.observe_all(np.array(engine.learners))
    n, L, F = seen.shape
    return engine.step(act(seen.reshape(n * L, F)).astype(np.float64).reshape(n, L))


@pytest.mark.parametrize("learners", [["vehicle_2"], PAIR])
def test_branch__without_an_offset_is_what_the_engine_does(learners):
    engine = make_engine("paper-random", 6, learners=learners, seed=3)
    moments, rewards = [], []
    for _ in range(90):
        moments.append(engine.moment())
        rewards.append(step_by_policy(engine).reward)
    last = len(learners) - 1
    whole = Moment.join(moments[:5])
    offsets = Offsets(np.full(30, last), np.zeros(30), np.ones(30, np.int64))
    before = engine.moment()
    gained, moved = play_to_the_end(engine.branch(whole), act, offsets, 1.0)
    vehicle = engine.learners[last]
    to_come = [sum(r[:, vehicle] for r in rewards[k:]) for k in range(5)]
    np.testing.assert_allclose(gained, np.concatenate(to_come), rtol=1e-12)
    assert (moved == 0.0).all() and gained.min() < 0.0
    assert all((a == b).all() for a, b in zip(before[:4], engine.moment()[:4], strict=True))  # untouched


def test_branch__discounts_from_its_own_moment_on():
    engine = make_engine("paper-random", 4, seed=3)
    whole = engine.moment()
    rewards = np.array([step_by_policy(engine).reward[:, 1] for _ in range(90)])
    gained, _ = play_to_the_end(engine.branch(whole), act, no_offsets(4), 0.9)
    np.testing.assert_allclose(gained, (0.9 ** np.arange(90)) @ rewards, rtol=1e-12)


def test_branch__moves_one_learner_for_some_steps_within_its_bounds():
    """Each row against a world of its own that is stepped by hand."""
    engine = make_engine("paper-random", 8, learners=PAIR, seed=5)
    for _ in range(3):
        step_by_policy(engine)
    moment = engine.moment()
    sizes = np.array([0.2, -0.2, 0.05, -0.3, 1.9, -1.9, 0.1, -0.1])
    offsets = Offsets(np.array([0, 1] * 4), sizes, np.array([1, 2, 4, 1, 2, 4, 1, 2]))
    gained, moved = play_to_the_end(engine.branch(moment), act, offsets, 1.0)
    for k in range(8):
        one = engine.branch(moment.take(np.array([k])))
        total, way, number = 0.0, 0.0, 0
        while not one.ended[0]:
            seen = one.observe_all(np.array(one.learners))[0]
            actions = act(seen).astype(np.float64)
            if number < offsets.steps[k]:
                was = actions[offsets.learner[k]]
                actions[offsets.learner[k]] = min(max(was + sizes[k], -1.0), 1.0)
                way += actions[offsets.learner[k]] - was
            total += one.step(actions[np.newaxis]).reward[0, one.learners[offsets.learner[k]]]
            number += 1
        assert (gained[k], moved[k]) == (pytest.approx(total, rel=1e-12), way)
    assert moved[0] == sizes[0] and (abs(moved) < abs(sizes) * offsets.steps - 0.1).any()


def test_branch__difference_is_the_gradient_of_the_harm():
    """Vehicle 1, at v = 20 m/s, meets an obstacle d = 1 m ahead within its first step: H = v^2 + 2 u d.

    Braking at the share a of 6 m/s2 is u = 6 a, so dH/da = 12 m2/s2; the return is minus the harm.
    """
    scenario = eb.load_scenario("cooperation-4-all").with_learners(["vehicle_1"])
    engine = make_engine(scenario, 1)
    alert = eb.make_worlds(
        [200.0, 200.0], [20.0, 0.0, 0.0], braking_capacity_mps2=6.0, driving_capacity_mps2=3.0, latency_s=0.0,
        mass_t=5.0, restitution=0.0, obstacle_gap_m=1.0,
    )  # fmt: skip
    engine.reset(worlds=alert)
    size = 1e-3
    both = Offsets(np.zeros(2, np.int64), np.array([size, -size]), np.ones(2, np.int64))
    half = np.float32(-0.5)
    new = engine.branch(engine.moment().take(np.zeros(2, np.int64)))
    gained, moved = play_to_the_end(new, lambda seen: np.full(len(seen), half), both, 1.0)
    assert gained.mean() == pytest.approx(-(400.0 - 6.0))
    assert (gained[0] - gained[1]) / (moved[0] - moved[1]) == pytest.approx(-12.0, rel=1e-6)


def test_branch__row_that_cannot_be_advanced_tells_nothing():
    engine = make_engine("paper-random", 3, seed=3)
    moment = engine.moment()
    moment.state[1, -1 - 5] = np.nan
    new = engine.branch(moment)
    new.roster.failed[1] = "a contact was missed"
    gained, _ = play_to_the_end(new, act, no_offsets(3), 1.0)
    assert np.isnan(gained[1]) and np.isfinite(gained[[0, 2]]).all()


def test_branch__refuses_what_it_cannot_play():
    shaped = make_engine("paper-random", 2, reward={"harm": 1.0, "shaping": 0.1})
    with pytest.raises(InvalidInput, match=r"branches: reward: shaping = 0.1: must be 0"):
        shaped.branch(shaped.moment())


@pytest.mark.parametrize("script", ["planner:8", "e_v2x_bm", "ppo@shipped"])
def test_branch__of_a_script_that_remembers_is_what_the_engine_does(script):
    roles = {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": script}
    scenario = eb.load_scenario("paper-random").replace(
        early_impacts="keep", roles=roles, latency_s=[0.1, 0.4, {"uniform": [0.2, 0.7]}]
    )
    engine = make_engine(scenario, 3, seed=3)
    _, start = engine.first_moments(3)
    assert all(np.array_equal(a, b) for a, b in zip(start[:4], engine.moment()[:4], strict=True))
    for _ in range(4):
        engine.step(np.full((3, 1), -0.4))
    rows = np.array([2, 0, 2])
    new = engine.branch(engine.moment().take(rows))
    while not engine.ended.all():
        engine.step(np.full((3, 1), -0.6))
    while not new.ended.all():
        new.step(np.full((3, 1), -0.6))
    assert new.ledger.total_harm.tolist() == engine.ledger.total_harm[rows].tolist()
    assert new.worlds.gaps_m.tolist() == engine.worlds.gaps_m[rows].tolist()


def ramp(seen, state):
    """Brakes harder with every step: what it does depends on its memory alone."""
    return -np.minimum(state, 10.0) / 10.0, state + 1.0


@pytest.mark.parametrize(
    "options", [{}, {"believed": True}, {"mode": "episode"}, {"mode": "robust", "uncertainty": "gaps_m=0.5"}], ids=str
)
def test_branch__under_a_shield_around_a_policy_with_a_memory_is_what_the_engine_does(options):
    policy = eb.policy_agent(ramp, initial_state=lambda n: np.zeros((n, 1)), name="ramp")
    env = eb.shield(eb.make_sb3_vec_env("paper-random", 5, seed=2), policy, **options)
    env.reset()
    engine = env.unwrapped.engine
    for _ in range(4):
        engine.step({})
    rows = np.array([4, 0, 0, 3])
    kept = engine.moment()
    harms = []
    for again in range(2):
        new = engine.branch(kept.take(rows))
        while not new.ended.all():
            new.step({})
        harms.append(new.ledger.total_harm.tolist())
        while again == 0 and not engine.ended.all():
            engine.step({})
    assert harms == [engine.ledger.total_harm[rows].tolist()] * 2
    assert engine.ledger.total_harm.any()


def test_branch__ends_where_nothing_can_change_any_more(monkeypatch):
    """A policy that presses on against a standing line: the same returns, and fewer steps than to the horizon."""
    engine = make_engine("paper-random", 30, seed=3)

    def press(seen):
        return np.where(seen[:, 0] > 0.3, np.float32(-1.0), np.float32(0.2))

    offsets = Offsets(np.zeros(30, np.int64), np.full(30, 0.1), np.full(30, 2))
    taken = []
    for stop in (True, False):
        if not stop:
            monkeypatch.setattr(algorithms, "_stands_for_good", lambda engine, before, rows: np.zeros(len(rows), bool))
        new = engine.branch(engine.moment())
        taken.append((play_to_the_end(new, press, offsets, 1.0), new.steps.copy()))
    (early, some), (whole, every) = taken
    assert (early[0] == whole[0]).all() and (early[1] == whole[1]).all()
    assert every.max() == 75 and some.max() < 75 and (some <= every).all()
