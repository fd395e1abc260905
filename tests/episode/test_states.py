"""A state is a value: copies, parts, donated memory and a second step from it lead to the same bits."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.episode.counts import HarmCount
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.hold import choose, descend, hold
from ethbrake_marl.episode.script_calls import guard_scripts
from ethbrake_marl.episode.state import END, State
from ethbrake_marl.errors import AgentFailed, InvalidInput
from ethbrake_marl.motion.layout import BRAKING, scratch_for

N = 7
REWARDS: dict[str, Any] = {
    "paper-random-obstacle": {"harm": 1.0, "harm_count": "total", "terminal": 1.0},
    "cooperation-3-pair": {"harm": 0.05, "shaping": 0.05, "jerk": 1e-4, "objective": "own"},
    "paper-random-buildup": "paper-reward",
}


@pytest.fixture(params=REWARDS)
def game(request: pytest.FixtureRequest) -> Game:
    return open_game(request.param, reward=REWARDS[request.param])[1]


def actions(game: Game, seed: int, n: int = N) -> np.ndarray:
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(-1.0, 1.0, (n, len(game.settings.learners)))
    return np.where(rng.random(drawn.shape) < 0.4, -1.0, drawn)


def middle(game: Game) -> State:
    state = game.reset(game.draw(N, 3, 0))
    for k in range(25):
        state, _ = game.step(state, actions(game, k))
    return state


def bits(state: State) -> bytes:
    memories = b"".join(np.ascontiguousarray(state.memories[name]).tobytes() for name in sorted(state.memories))
    return b"".join(np.ascontiguousarray(array).tobytes() for array in state[:5]) + memories


def after(game: Game, state: State, rows: Any = slice(None), *, donate: bool = False) -> tuple[bytes, bytes]:
    rewards = b""
    for k in range(3):
        state, step = game.step(state, np.ascontiguousarray(actions(game, 100 + k)[rows]), donate=donate)
        rewards += step.reward.tobytes()
    return bits(state), rewards


def test_step__leaves_the_state_before_it_as_it_was(game: Game) -> None:
    state = middle(game)
    before, first = bits(state), after(game, state)
    assert bits(state) == before and after(game, state) == first


def test_copy__goes_on_like_the_state(game: Game) -> None:
    state = middle(game)
    assert after(game, pickle.loads(pickle.dumps(state))) == after(game, state)


def test_donated_memory__leads_to_the_same_bits(game: Game) -> None:
    state = middle(game)
    assert after(game, copy.deepcopy(state), donate=True) == after(game, state)


def test_rows__go_on_alone_as_together(game: Game) -> None:
    state, rows = middle(game), np.array([5, 0, 3])
    together, alone = state, state.take(rows)
    for k in range(3):
        together, step = game.step(together, actions(game, k))
        alone, part = game.step(alone, actions(game, k)[rows])
        assert part.reward.tobytes() == step.reward[rows].tobytes()
    assert bits(alone) == bits(together.take(rows))


@pytest.mark.parametrize("game", ["cooperation-3-pair"], indirect=True)
@pytest.mark.parametrize("rows", [[1, 4], np.array([k in (2, 6) for k in range(N)]), slice(2, 5)])
def test_put__replaces_these_rows_and_no_others(game: Game, rows: Any) -> None:
    state = middle(game)
    before, new = bits(state), game.reset(game.draw(N, 3, 50)).take(rows)
    placed = state.put(rows, new)
    others = np.setdiff1d(np.arange(N), np.arange(N)[rows])
    assert bits(placed.take(rows)) == bits(new) and bits(placed.take(others)) == bits(state.take(others))
    assert bits(state) == before
    owned = copy.deepcopy(state)
    assert bits(owned.put(rows, new, donate=True)) == bits(placed) == bits(owned)


def test_step__of_three_vehicles_has_the_bits_of_the_text_for_any_number(
    game: Game, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = middle(game)
    with_constants = after(game, state)
    monkeypatch.setattr("ethbrake_marl.episode.step.scratch_for", lambda bodies: scratch_for(bodies + 1))
    assert after(game, state) == with_constants


def test_episode__that_has_ended_stays_and_pays_nothing(game: Game) -> None:
    state = middle(game)
    while not state.ended.all():
        state, _ = game.step(state, actions(game, 1))
    same, step = game.step(state, actions(game, 2))
    assert bits(same) == bits(state) and not step.reward.any() and not step.out.any()


@pytest.mark.parametrize("game", ["cooperation-3-pair"], indirect=True)
@pytest.mark.parametrize("bad", [np.nan, 1.001])
def test_bad_action__is_refused_and_changes_nothing(game: Game, bad: float) -> None:
    state = middle(game).take(slice(2, 5))
    state.clock[:, 4] = 0.0
    before, wrong = bits(state), actions(game, 1, 3)
    wrong[1, -1] = bad
    with pytest.raises(InvalidInput, match=rf"action of vehicle_{game.settings.learners[-1]} = .*: must be from -1"):
        game.step(state, wrong, donate=True)
    assert bits(state) == before


@pytest.mark.parametrize(
    ("name", "count", "states"),  # possible states of each world
    [("paper-random-obstacle", "honest", 5), ("cooperation-3-five", "honest", 1)],
)
def test_choose__is_the_first_trial_with_the_least_harm(name: str, count: str, states: int) -> None:
    scenario, game = open_game(name)
    state, rng, bodies = game.reset(scenario.sample(60, 3)), np.random.default_rng(1), [2, 3]
    for _ in range(5):
        state, _ = game.step(state, np.full((60, len(game.settings.learners)), -0.2))
    n, shares = (
        60 // states,
        rng.uniform(0.0, 1.0, (60, 10, 2))[:, [0, 1, 0, *range(2, 10)]],
    )  # the third repeats the first
    trials = -state.car[:, np.newaxis, BRAKING, bodies] * shares
    harm = hold(state, state.wanted, bodies, trials, state.clock[:, END], count)[0].reshape(n, states, -1).max(axis=1)
    for below in (np.full(n, np.inf), harm.min(axis=1), harm[:, 3], harm[:, 3] + 1e-9):
        best, least = choose(state, state.wanted, bodies, trials, state.clock[:, END], HarmCount.of(count), below)
        expected = np.where(harm < below[:, np.newaxis], harm, below[:, np.newaxis])
        assert least.tolist() == expected.min(axis=1).tolist()
        assert best.tolist() == np.where(harm.min(axis=1) < below, harm.argmin(axis=1), 0).tolist()
    assert len({*harm.argmin(axis=1).tolist()}) > 1


def test_descend__returns_the_commands_whose_harm_it_tells() -> None:
    scenario, game = open_game("cooperation-3-pair")
    state, shares, learners = scenario.sample(50, 3), np.linspace(0.0, 1.0, 5), game.settings.learners.tolist()
    wanted, least = descend(state, learners, shares, 2, 8.0, HarmCount.of("first"))
    found = hold(state, wanted, learners, wanted[:, np.newaxis, learners], 8.0, "first")[0, :, 0]
    assert found.tolist() == least.tolist()
    alone = descend(state, learners[1:], shares, 1, 8.0, HarmCount.of("first"))[1]
    assert (least <= alone).all() and (least < alone - 1.0).any()


class Counts:
    """A script that adds to its memory in place."""

    name = "counts"

    def begin(self, alert: State, body: int) -> Any:
        return np.zeros(alert.n)

    def act(self, state: State, memory: Any, body: int) -> Any:
        memory += 1.0
        return np.zeros(state.n), memory


class Eases(Counts):
    """A script that brakes with 3 m/s2."""

    def act(self, state: State, memory: Any, body: int) -> Any:
        return np.full(state.n, -3.0), memory


def test_script__commands_from_the_alert_on() -> None:
    _, game = open_game("paper-random")
    state = game._replace(scripts=guard_scripts({1: Eases()})).reset(game.draw(2, 7, 0))
    assert (state.wanted[:, 1] == -3.0).all()
    assert state.speeds_mps[:, 0] == pytest.approx(game.draw(2, 7, 0).speeds_mps[:, 0] - 3.0 * state.time_s)


def test_memory_of_a_script__cannot_be_changed_in_place_because_plays_share_it() -> None:
    _, game = open_game("paper-random")
    with pytest.raises(AgentFailed, match="vehicle_3: act fails: ValueError: output array is read-only"):
        game._replace(scripts=guard_scripts({3: Counts()})).reset(game.draw(2, 7, 0))
