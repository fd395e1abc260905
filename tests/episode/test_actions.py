"""Actions become commands: linear on each side of coasting, up to one float32 step beyond -1 and 1."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.worlds.scenario import Scenario

PAIR = Scenario(
    name="pair", vehicles=2, gaps_m=50, speeds_mps=20, braking_capacity_mps2=[8, 6], driving_capacity_mps2=[4, 0],
    mass_t=1, latency_s=[0, 0.5], obstacle_gap_m=100, roles={"vehicle_1": "learner", "vehicle_2": "learner"},
)  # fmt: skip
BEYOND = float(np.nextafter(np.float32(1), np.float32(2)))


def stepped(*action: float) -> State:
    _, game = open_game(PAIR)
    return game.step(game.reset(game.draw(1, 0, 0)), np.array([action]))[0]


@pytest.mark.parametrize(
    ("action", "commands"),
    [
        ((-0.5, -0.25), [-4.0, -1.5]),
        ((0.5, 0.5), [2.0, 0.0]),  # vehicle 2 cannot drive
        ((1.0, 1.0), [4.0, 0.0]),
        ((-BEYOND, BEYOND), [-8.0, 0.0]),
        ((BEYOND, -BEYOND), [4.0, -6.0]),
    ],
)
def test_action__is_a_share_of_the_capacity_of_its_side(action: tuple[float, float], commands: list[float]) -> None:
    assert stepped(*action).commands_mps2.tolist() == [commands]


def test_action__further_beyond_is_refused() -> None:
    for body, action in (("vehicle_1", (1.0000003, 0.0)), ("vehicle_2", (0.0, 1.0000003))):
        with pytest.raises(InvalidInput, match=rf"action of {body} = 1\.0000003"):
            stepped(*action)


@pytest.mark.parametrize("actions", [np.zeros((1, 1)), np.array([["a", "b"]]), np.zeros((1, 2), bool)])
def test_actions__of_another_shape_or_kind_are_refused(actions: object) -> None:
    _, game = open_game(PAIR)
    with pytest.raises(InvalidInput, match=r"must be an array of numbers with the shape \(1, 2\)"):
        game.step(game.reset(game.draw(1, 0, 0)), actions)  # type: ignore[arg-type]
