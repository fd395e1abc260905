"""A world whose physics fails raises, with its number and time; whatever only asks what would happen says infinite."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.hold import hold
from ethbrake_marl.episode.play import price
from ethbrake_marl.episode.state import NUMBER, State
from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.motion.layout import GAP, SPEED

N, PLANTED = 5, 3


def planted(state: State, row: int = PLANTED) -> State:
    """Worlds, in one of which vehicles 2 and 3 overlap by 1 m when vehicle 2 meets vehicle 1."""
    line = state.line.copy()
    line[row, GAP, 1:3], line[row, SPEED, 1:] = (0.5, -1.0), (10.0, 20.0, 16.0)
    return state._replace(line=line)


@pytest.fixture
def game() -> Game:
    return open_game("paper-random")[1]


def test_step__names_world_and_time_and_changes_nothing(game: Game) -> None:
    state, _ = game.step(game.reset(game.draw(N, 5, 10)), np.zeros((N, 1)))
    state = planted(state)
    before = copy.deepcopy(state)
    with pytest.raises(
        PhysicsError, match=r"^world 13: a check of the physics failed between 0.6 s and 0.7 s"
    ) as raised:
        game.step(state, np.zeros((N, 1)))
    assert [*raised.value.worlds] == [13]
    assert all(one.tobytes() == other.tobytes() for one, other in zip(state[:5], before[:5], strict=True))
    others = [k for k in range(N) if k != PLANTED]
    game.step(state.take(others), np.zeros((N - 1, 1)))


def test_world_of_the_caller__is_named_by_its_row(game: Game) -> None:
    state = planted(game.reset(game.draw(N, 5, 10)))
    state.clock[:, NUMBER] = -1.0
    with pytest.raises(PhysicsError, match=r"^world 3: a check of the physics failed between 0.5 s"):
        game.step(state, np.zeros((N, 1)))


def test_first_decision__cannot_be_reached(game: Game) -> None:
    with pytest.raises(PhysicsError, match=r"^world 13: .* between 0 s and 0.5 s"):
        game.reset(planted(game.draw(N, 5, 10)))


def test_price__is_infinite_there_and_nowhere_else(game: Game) -> None:
    state = planted(game.reset(game.draw(N, 5, 10)))
    priced = price(game, state, np.zeros((N, 1, 1)), "first")
    held = hold(state, state.wanted, [2], np.zeros((N, 1, 1)), 8.0, "first")
    for harm in (priced, held[0, :, 0], held[1, :, 0]):
        assert np.flatnonzero(np.isinf(harm)).tolist() == [PLANTED]
