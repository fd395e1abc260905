from typing import Any

import numpy as np
import pytest

from ethbrake_marl.actions import action_to_command, checked_action, command_to_action
from ethbrake_marl.physics import make_worlds

BEYOND = np.nextafter(np.float32(1), np.float32(2))  # one float32 step beyond 1 is 1


@pytest.mark.parametrize(
    ("given", "needed", "told"),
    [
        ([-1, 1], (2,), [-1.0, 1.0]),
        ([-BEYOND, BEYOND, 0.5], (3,), [-1.0, 1.0, 0.5]),
        ([1.0000000000000002, 0.5], (2,), [1.0, 0.5]),
        *((np.full(shape, 0.25), (1,), [0.25]) for shape in ((), (1,), (1, 1))),  # of any axes of length 1
        *((np.full(shape, 0.25), (1, 1), [[0.25]]) for shape in ((), (1,), (1, 1))),
    ],
)
def test_action__at_the_bounds_and_a_single_one_of_any_axes_is_taken(given: Any, needed: Any, told: Any) -> None:
    assert checked_action(given, needed, "vehicle_2").tolist() == told


@pytest.mark.parametrize(("vehicle", "commands"), [(0, [-8.0, -4.0, 0.0, 1.0, 2.0]), (1, [-6.0, -3.0, 0.0, 0.0, 0.0])])
def test_action__is_linear_on_each_side_of_coasting_and_back(vehicle: int, commands: list[float]) -> None:
    capacities = {"braking_capacity_mps2": [8.0, 6.0], "driving_capacity_mps2": [2.0, 0.0]}
    vehicles = make_worlds(
        5.0, np.full((5, 2), 20.0), **capacities, latency_s=0.0, mass_t=1.0, restitution=0.0
    ).vehicles
    actions = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    assert action_to_command(actions, vehicles, vehicle).tolist() == commands
    back = actions if vehicle == 0 else [-1.0, -0.5, 0.0, 0.0, 0.0]  # without the capacity: coasting
    assert command_to_action(np.array(commands), vehicles, vehicle).tolist() == list(back)
    beyond = command_to_action(np.array([-99.0, -8.5, 0.0, 2.5, 99.0]), vehicles, vehicle).tolist()
    assert beyond == [-1.0, -1.0, 0.0, *([1.0, 1.0] if vehicle == 0 else [0.0, 0.0])]
