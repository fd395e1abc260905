"""An engine that goes on from a snapshot cannot be told from one that was never stopped."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ethbrake_marl.engine import Engine
from ethbrake_marl.envs.interfaces import make_engine
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.rewards import RewardParams
from ethbrake_marl.scenario import Scenario, load_scenario

SCENARIO = load_scenario("paper-random")
SHAPED = {"harm": 0.05, "shaping": 0.1, "shaping_discount": 0.99, "terminal": 0.5}
WORLDS = 6


def _steps(engine: Engine, rng: np.random.Generator, steps: int) -> list[np.ndarray]:
    """Everything that ``steps`` random decisions show, new episodes included."""
    seen = []
    for _ in range(steps):
        step = engine.step(rng.uniform(-1.0, 1.0, (engine.n, len(engine.learners))))
        seen += [step.reward, step.ended, engine.wanted_mps2.copy()]
        engine.renew(np.flatnonzero(step.ended))
        seen.append(engine.observe_all(np.array(engine.learners)))
    return seen


def _with_script(script: str) -> Scenario:
    return SCENARIO.replace(
        roles={"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": script}, early_impacts="keep"
    )


@pytest.mark.parametrize(
    ("scenario", "reward"),
    [
        (SCENARIO, "harm"),
        (SCENARIO, SHAPED),
        (SCENARIO, "paper"),
        (SCENARIO.with_learners(["vehicle_2", "vehicle_3"]), SHAPED),
        (load_scenario("cooperation-4-congested"), SHAPED),
        (load_scenario("stress-wide"), "total-harm"),
        (_with_script("gentlest_front"), "harm"),
        (_with_script("e_v2x_bm:pairwise"), "harm"),
        (_with_script("planner:20"), "harm"),
    ],
)
@pytest.mark.parametrize("before", [0, 45])
def test_restore_engine__the_next_steps_are_the_same_to_the_bit(scenario: Scenario, reward: Any, before: int) -> None:
    given = RewardParams(**reward) if isinstance(reward, dict) else reward
    first = make_engine(scenario, WORLDS, reward=given, seed=3)
    rng = np.random.default_rng(0)
    _steps(first, rng, before)
    kept = {name: array.copy() for name, array in first.snapshot().items()}
    state = rng.bit_generator.state
    expected = _steps(first, rng, 50)

    second = make_engine(scenario, WORLDS, reward=given, seed=99)
    _steps(second, np.random.default_rng(5), 7)
    second.restore(kept)
    rng.bit_generator.state = state
    for k, (a, b) in enumerate(zip(expected, _steps(second, rng, 50), strict=True)):
        assert np.array_equal(a, b), k
    for name, value in vars(first).items():
        if isinstance(value, np.ndarray):
            assert np.array_equal(value, vars(second)[name]), name


def test_engine_snapshot__is_a_copy() -> None:
    engine = make_engine(SCENARIO, WORLDS, seed=3)
    kept = engine.snapshot()
    before = {name: array.copy() for name, array in kept.items()}
    _steps(engine, np.random.default_rng(0), 20)
    assert all(np.array_equal(kept[name], before[name]) for name in kept)


def test_restore_engine__refuses_another_size_before_it_changes_anything() -> None:
    kept = make_engine(SCENARIO, WORLDS, seed=3).snapshot()
    other = make_engine(SCENARIO, WORLDS + 1, seed=3)
    before = other.snapshot()
    with pytest.raises(InvalidInput, match=r"engine snapshot: state is \(6, \d+\); \(7, \d+\) is needed"):
        other.restore(kept)
    del kept["params"]
    with pytest.raises(InvalidInput, match="params is nothing"):
        make_engine(SCENARIO, WORLDS, seed=3).restore(kept)
    assert all(np.array_equal(before[name], array) for name, array in other.snapshot().items())


def test_vec_env_snapshot__returns_and_lengths_of_running_episodes_go_on() -> None:
    first = make_sb3_vec_env(SCENARIO, WORLDS, seed=3)
    first.reset()
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1.0, 1.0, (120, WORLDS, 1)).astype(np.float32)
    for action in actions[:30]:
        first.step(action)
    kept = first.snapshot()
    second = make_sb3_vec_env(SCENARIO, WORLDS, seed=8)
    second.restore(kept)
    ended = 0
    for action in actions[30:]:
        (a, r, d, infos), (a2, r2, d2, infos2) = first.step(action), second.step(action)
        assert np.array_equal(a, a2) and np.array_equal(r, r2) and np.array_equal(d, d2)
        for row in np.flatnonzero(d):
            ended += 1
            assert infos[row]["episode"] == infos2[row]["episode"]
            assert infos[row].keys() == infos2[row].keys()
    assert ended > 5
