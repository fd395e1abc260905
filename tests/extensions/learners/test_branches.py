"""Branches: one moment played on in several ways."""

from typing import Any

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.learners import branches
from ethbrake_marl.extensions.learners.branches import Offsets, play_to_the_end
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.engine.state import State
from ethbrake_marl.first_edition.envs.making import make_engine
from tests.first_edition.physics.random_worlds import line

PAIR = ["vehicle_2", "vehicle_3"]


def act(seen: np.ndarray) -> np.ndarray:
    """A policy whose row k depends on row k alone: more braking where the gap is small."""
    return (seen[:, 8] - np.float32(0.9)).clip(-1.0, 1.0)


def no_offsets(n: int, learner: int = 0) -> Offsets:
    return Offsets(np.full(n, learner), np.zeros(n), np.ones(n, np.int64))


def step_by_policy(engine: Engine) -> Any:
    seen = engine.observe_all(np.array(engine.learners))
    n, L, F = seen.shape
    return engine.step(act(seen.reshape(n * L, F)).astype(np.float64).reshape(n, L))


@pytest.mark.parametrize("learners", [["vehicle_2"], PAIR])
def test_branch__without_an_offset_is_what_the_engine_does(learners: list[str]) -> None:
    engine = make_engine("paper-random", 6, learners=learners, seed=3)
    last, moments, rewards = len(learners) - 1, [], []
    for _ in range(90):
        moments.append(engine.moment())
        rewards.append(step_by_policy(engine).reward[:, engine.learners[last]])
    before = engine.moment()
    gained, moved = play_to_the_end(engine.branch(State.join(moments[:5])), act, no_offsets(30, last), 1.0)
    np.testing.assert_allclose(gained, np.concatenate([np.sum(rewards[k:], axis=0) for k in range(5)]), rtol=1e-12)
    assert (moved == 0.0).all() and gained.min() < 0.0
    assert all((a == b).all() for a, b in zip(before[:4], engine.moment()[:4], strict=True))  # untouched
    discounted, _ = play_to_the_end(engine.branch(moments[2]), act, no_offsets(6, last), 0.9)
    np.testing.assert_allclose(discounted, (0.9 ** np.arange(88)) @ np.array(rewards[2:]), rtol=1e-12)


def test_branch__moves_one_learner_for_some_steps_within_its_bounds() -> None:
    """Each row against a world of its own that is stepped by hand."""
    engine = make_engine("paper-random", 8, learners=PAIR, seed=5)
    for _ in range(3):
        step_by_policy(engine)
    moment = engine.moment()
    sizes = np.array([0.2, -0.2, 0.05, -0.3, 1.9, -1.9, 0.1, -0.1])
    offsets = Offsets(np.array([0, 1] * 4), sizes, np.array([1, 2, 4, 1, 2, 4, 1, 2]))
    gained, moved = play_to_the_end(engine.branch(moment), act, offsets, 1.0)
    for k, learner in enumerate(offsets.learner):
        one = engine.branch(moment.take(np.array([k])))
        total, way, number = 0.0, 0.0, 0
        while not one.ended[0]:
            actions = act(one.observe_all(np.array(one.learners))[0]).astype(np.float64)
            if number < offsets.steps[k]:
                was = actions[learner]
                actions[learner] = min(max(was + sizes[k], -1.0), 1.0)
                way += actions[learner] - was
            total += one.step(actions[np.newaxis]).reward[0, one.learners[learner]]
            number += 1
        assert (gained[k], moved[k]) == (pytest.approx(total, rel=1e-12), way)
    assert moved[0] == sizes[0] and (abs(moved) < abs(sizes) * offsets.steps - 0.1).any()


def test_branch__difference_is_the_gradient_of_the_harm() -> None:
    """Vehicle 1, at v = 20 m/s, meets an obstacle d = 1 m ahead within its first step: H = v^2 + 2 u d.

    Braking at the share a of 6 m/s2 is u = 6 a, so dH/da = 12 m2/s2; the return is minus the harm.
    """
    engine = make_engine(eb.load_scenario("cooperation-4-all").with_learners(["vehicle_1"]), 1)
    capacity = {"braking_capacity_mps2": 6.0, "driving_capacity_mps2": 3.0}
    engine.reset(worlds=line([200.0, 200.0], [20.0, 0.0, 0.0], mass_t=5.0, obstacle_gap_m=1.0, **capacity))
    both = Offsets(np.zeros(2, np.int64), np.array([1e-3, -1e-3]), np.ones(2, np.int64))
    new = engine.branch(engine.moment().take(np.zeros(2, np.int64)))
    gained, moved = play_to_the_end(new, lambda seen: np.full(len(seen), np.float32(-0.5)), both, 1.0)
    assert gained.mean() == pytest.approx(-(400.0 - 6.0))
    assert (gained[0] - gained[1]) / (moved[0] - moved[1]) == pytest.approx(-12.0, rel=1e-6)


SCRIPTS = ("best_harm:8", "e_v2x_bm", "ppo")


def scripted(script: str) -> tuple[Engine, Any]:
    """An engine whose Vehicle 3 follows this script, and what is done in each step."""
    roles = {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": script}
    latency = [0.1, 0.4, {"uniform": [0.2, 0.7]}]
    scenario = eb.load_scenario("paper-random").replace(early_impacts="keep", roles=roles, latency_s=latency)
    return make_engine(scenario, 3, seed=3), np.full((3, 1), -0.5)


def shielded(options: dict[str, Any]) -> tuple[Engine, Any]:
    """One with a shield around a policy that brakes harder with every step: its memory alone tells it how hard."""
    policy = eb.policy_agent(
        lambda seen, state: (-np.minimum(state, 10.0) / 10.0, state + 1.0), initial_state=lambda n: np.zeros((n, 1))
    )
    env = eb.shield(eb.make_sb3_vec_env("paper-random", 5, seed=2), policy, **options)
    env.reset()
    return env.unwrapped.engine, {}


@pytest.mark.parametrize("script", SCRIPTS)
def test_first_moments__are_where_the_episodes_begin(script: str) -> None:
    engine, _ = scripted(script)
    _, start = engine.first_moments(3)
    assert all(np.array_equal(a, b) for a, b in zip(start[:4], engine.moment()[:4], strict=True))


@pytest.mark.parametrize(
    ("make", "given"),
    [*((scripted, script) for script in SCRIPTS), *((shielded, options) for options in ({}, {"mode": "episode"}))],
    ids=lambda each: getattr(each, "__name__", str(each)),
)
def test_branch__of_what_remembers_is_what_the_engine_does(make: Any, given: Any) -> None:
    engine, actions = make(given)
    for _ in range(4):
        engine.step(actions)
    rows, kept, found = np.array([2, 0, 2]), engine.moment(), []
    for again in range(2):  # before the engine goes on, and after it
        new = engine.branch(kept.take(rows))
        while not new.ended.all():
            new.step(actions)
        found.append((new.ledger.total_harm.tolist(), new.worlds.gaps_m.tolist()))
        while again == 0 and not engine.ended.all():
            engine.step(actions)
    harm = engine.ledger.total_harm
    assert harm.any() and found == [(harm[rows].tolist(), engine.worlds.gaps_m[rows].tolist())] * 2


def test_branch__ends_where_nothing_can_change_any_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """A policy that presses on against a standing line: the same returns, and fewer steps than to the horizon."""
    engine = make_engine("paper-random", 30, seed=3)
    offsets = Offsets(np.zeros(30, np.int64), np.full(30, 0.1), np.full(30, 2))

    def pressed() -> tuple[np.ndarray, np.ndarray]:
        new = engine.branch(engine.moment())
        found = play_to_the_end(
            new, lambda seen: np.where(seen[:, 0] > 0.3, np.float32(-1.0), np.float32(0.2)), offsets, 1.0
        )
        return np.array(found), new.steps.copy()

    early, some = pressed()
    monkeypatch.setattr(branches, "_stands_for_good", lambda engine, before, rows: np.zeros(len(rows), bool))
    whole, every = pressed()
    assert np.array_equal(early, whole)
    assert every.max() == 75 and some.max() < 75 and (some <= every).all()


def test_branch__tells_nothing_of_a_row_that_cannot_be_advanced() -> None:
    engine = make_engine("paper-random", 3, seed=3)
    moment = engine.moment()
    moment.motion[1, -1 - 5] = np.nan
    new = engine.branch(moment)
    new.roster.failed[1] = "a contact was missed"
    gained, _ = play_to_the_end(new, act, no_offsets(3), 1.0)
    assert np.isnan(gained).tolist() == [False, True, False]
