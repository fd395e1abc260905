"""Branches: one state, played on in several ways."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.counts import FIRST_IMPACTS
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.learners import vine
from ethbrake_marl.extensions.learners.vine import Moment, play_on, stands_for_good
from ethbrake_marl.motion.layout import FORCE

TEAM = ["vehicle_2", "vehicle_3"]
FIRST = FIRST_IMPACTS.weight_array


def act(seen: np.ndarray) -> np.ndarray:
    """Brake harder where the gap ahead is small."""
    return (seen[:, 8] - np.float32(0.9)).clip(-1.0, 1.0)


def begun(n: int, learners: list[str], **settings: Any) -> tuple[eb.Game, State]:
    scenario, game = eb.open_game("paper-random", learners=learners, **settings)
    return game, game.reset(scenario.sample(n, 3))


def test_play_on__is_the_episode_and_its_discounted_reward() -> None:
    game, state = begun(6, TEAM, reward={"harm": 1.0, "jerk": 0.01})
    kept, rewards, now = state.take(np.arange(6)), [], state
    while not now.ended.all():
        seen = game.observe_alike(now, game.settings.learners)
        now, step = game.step(now, act(seen.reshape(12, -1)).astype(np.float64).reshape(6, 2))
        rewards.append(step.reward[:, 1:])
    gained = play_on(game, state, lambda at: at.ask(act), 0.9)
    np.testing.assert_allclose(gained, np.tensordot(0.9 ** np.arange(len(rewards)), np.array(rewards), 1), rtol=1e-12)
    assert gained.min() < 0.0
    assert all(np.array_equal(*pair) for pair in zip(state[:5], kept[:5], strict=True))  # nobody has changed it


def test_branch__ends_where_nothing_can_change_any_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """A policy that presses on against a standing line: the same returns, with fewer decisions."""
    game, state = begun(30, ["vehicle_2"], reward="first-impact-harm")

    def pressed() -> tuple[np.ndarray, int]:
        asked = []

        def decide(now: Moment) -> np.ndarray:
            asked.append(len(now.rows))
            return np.where(now.seen[:, :, 0] > 0.3, -1.0, 0.2)

        return play_on(game, state, decide, 1.0), sum(asked)

    early, few = pressed()
    monkeypatch.setattr(vine, "stands_for_good", lambda before, after, count: np.zeros(after.n, bool))
    whole, many = pressed()
    assert np.array_equal(early, whole) and few < 0.8 * many


def test_branch__under_the_honest_count_goes_on_while_a_standing_line_is_pushed() -> None:
    """Vehicle 2 brakes for 2.5 s and then presses on, but Vehicle 1 holds it."""
    game, state = begun(30, ["vehicle_2"], reward="honest")

    def action(number: int, rows: int) -> np.ndarray:
        return np.full((rows, 1), -1.0 if number < 25 else 0.3)

    gained = play_on(game, state, lambda now: action(now.number, len(now.rows)), 1.0)
    rewards, number = np.zeros(30), 0
    while not state.ended.all():
        state, step = game.step(state, action(number, 30))
        rewards += step.reward[:, 1]
        number += 1
    assert gained[:, 0].tolist() == rewards.tolist() and (state.harm("honest") > state.harm("total") + 50.0).any()


def test_nothing_stands_for_good__while_somebody_waits_or_has_a_memory() -> None:
    game, state = begun(2, ["vehicle_2"])
    while not state.ended.all():
        before, (state, _) = state, game.step(state, -np.ones((2, 1)))
    after = state._replace(line=before.line.copy())
    before.line[:, :2] = after.line[:, :2] = 0.0
    assert stands_for_good(before, after, FIRST).all()
    waiting = after.know.copy()
    waiting[0, 2, 1] = 7.9
    assert stands_for_good(before, after._replace(know=waiting), FIRST).tolist() == [False, True]
    pressing = after.line.copy()
    pressing[1, FORCE, 2] = 1e-3
    assert stands_for_good(before, after._replace(line=pressing), FIRST).tolist() == [True, False]
    assert not stands_for_good(before, after._replace(memories={3: None}), FIRST).any()
