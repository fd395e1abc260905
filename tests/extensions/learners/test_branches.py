"""Branches: one state, played on in several ways."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import at_alert
from ethbrake_marl.extensions.learners import branches
from ethbrake_marl.extensions.learners.branches import Moment, Offsets, play_on, play_to_the_end, stands_for_good
from ethbrake_marl.motion.layout import FORCE
from tests.motion.lines import lines

TEAM = ["vehicle_2", "vehicle_3"]


def act(seen: np.ndarray) -> np.ndarray:
    """Brake harder where the gap ahead is small."""
    return (seen[:, 8] - np.float32(0.9)).clip(-1.0, 1.0)


def begun(n: int, learners: list[str], **settings: Any) -> tuple[eb.Game, State]:
    scenario, game = eb.open_game("paper-random", learners=learners, **settings)
    return game, game.begin(scenario.sample(n, 3))


def test_play_on__is_the_episode_and_its_discounted_reward() -> None:
    game, state = begun(6, TEAM, reward={"harm": 1.0, "jerk": 0.01})
    kept, rewards, now = state.take(np.arange(6)), [], state
    while not now.ended.all():
        seen = game.observe_alike(now, game.rules.learners)
        now, step = game.step(now, act(seen.reshape(12, -1)).astype(np.float64).reshape(6, 2))
        rewards.append(step.reward[:, 1:])
    gained, last = play_on(game, state, lambda at: at.ask(act), 0.9)
    np.testing.assert_allclose(gained, np.tensordot(0.9 ** np.arange(len(rewards)), np.array(rewards), 1), rtol=1e-12)
    assert gained.min() < 0.0 and np.array_equal(last.line, now.line)
    assert all(np.array_equal(*pair) for pair in zip(state[:5], kept[:5], strict=True))  # nobody has changed it


def test_offsets__move_one_learner_for_some_steps_within_its_bounds() -> None:
    game, state = begun(8, TEAM)
    sizes, steps = np.array([0.2, -0.2, 0.05, -0.3, 1.9, -1.9, 0.1, -0.1]), np.array([1, 2, 4, 1, 2, 4, 1, 2])
    gained, moved = play_to_the_end(game, state, act, Offsets(np.array([0, 1] * 4), sizes, steps), 1.0)
    for k in range(8):
        now, total, way, number = state.take([k]), 0.0, 0.0, 0
        while not now.ended[0]:
            actions = act(game.observe_alike(now, game.rules.learners)[0]).astype(np.float64)
            if number < steps[k]:
                was = actions[k % 2]
                actions[k % 2] = min(max(was + sizes[k], -1.0), 1.0)
                way += actions[k % 2] - was
            now, step = game.step(now, actions[np.newaxis])
            total += step.reward[0, 1 + k % 2]
            number += 1
        assert (gained[k], moved[k]) == (pytest.approx(total, rel=1e-12), way)
    assert moved[0] == sizes[0] and (abs(moved) < abs(sizes) * steps - 0.1).any()


def test_difference__is_the_gradient_of_the_harm() -> None:
    """Vehicle 1, at v = 20 m/s, meets an obstacle d = 1 m ahead within its first step: H = v^2 + 2 u d.

    Braking at the share a of 6 m/s2 is u = 6 a, so dH/da = 12 m2/s2; the return is minus the harm.
    """
    line, car = lines([200.0, 200.0], [[20.0, 0.0, 0.0]] * 2, mass_t=5.0, obstacle_gap_m=1.0,
                      braking_capacity_mps2=6.0, driving_capacity_mps2=3.0)  # fmt: skip
    _, game = eb.open_game("cooperation-4-all", learners=["vehicle_1"])
    state = game.begin(at_alert(line, car, np.zeros((2, 4, 4)), np.zeros((2, 4)), np.arange(2)))
    both = Offsets(np.zeros(2, np.int64), np.array([1e-3, -1e-3]), np.ones(2, np.int64))
    half = lambda seen: np.full(len(seen), np.float32(-0.5))  # noqa: E731
    gained, moved = play_to_the_end(game, state, half, both, 1.0)
    assert gained.mean() == pytest.approx(-(400.0 - 6.0))
    assert (gained[0] - gained[1]) / (moved[0] - moved[1]) == pytest.approx(-12.0, rel=1e-6)


def test_branch__ends_where_nothing_can_change_any_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """A policy that presses on against a standing line: the same returns, with fewer decisions."""
    game, state = begun(30, ["vehicle_2"])

    def pressed() -> tuple[np.ndarray, int]:
        asked = []

        def decide(now: Moment) -> np.ndarray:
            asked.append(len(now.rows))
            return np.where(now.seen[:, :, 0] > 0.3, -1.0, 0.2)

        return play_on(game, state, decide, 1.0)[0], sum(asked)

    early, few = pressed()
    monkeypatch.setattr(branches, "stands_for_good", lambda before, after: np.zeros(after.n, bool))
    whole, many = pressed()
    assert np.array_equal(early, whole) and few < 0.8 * many


def test_nothing_stands_for_good__while_somebody_waits_or_has_a_memory() -> None:
    game, state = begun(2, ["vehicle_2"])
    while not state.ended.all():
        before, (state, _) = state, game.step(state, -np.ones((2, 1)))
    after = state._replace(line=before.line.copy())
    before.line[:, :2] = after.line[:, :2] = 0.0
    assert stands_for_good(before, after).all()
    waiting = after.know.copy()
    waiting[0, 2, 1] = 7.9
    assert stands_for_good(before, after._replace(know=waiting)).tolist() == [False, True]
    pressing = after.line.copy()
    pressing[1, FORCE, 2] = 1e-3
    assert stands_for_good(before, after._replace(line=pressing)).tolist() == [True, False]
    assert not stands_for_good(before, after._replace(memories={3: None})).any()
