from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.actions import action_to_command, checked_action, command_to_action
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import make_worlds


@pytest.mark.parametrize("value", [-1.0000003, 1.0000001193, 2.0, np.nan, np.inf])
def test_action__beyond_the_bounds_is_told_in_digits_that_show_it(value):
    with pytest.raises(InvalidInput) as caught:
        checked_action([0.5, value], (2,), "vehicle_2")
    assert str(caught.value) == f"action of vehicle_2: {value!r}; must be in [-1, 1]"


def test_action__at_the_bounds_is_taken():
    assert checked_action([-1, 1], (2,), "vehicle_2").tolist() == [-1.0, 1.0]


@pytest.mark.parametrize("beyond", [np.nextafter(np.float32(1), np.float32(2)), 1.0000000000000002])
def test_action__one_float32_step_beyond_the_bounds_is_at_them(beyond):
    assert checked_action([-beyond, beyond, 0.5], (3,), "vehicle_2").tolist() == [-1.0, 1.0, 0.5]


@pytest.mark.parametrize("shape", [(), (1,), (1, 1)])
def test_action__a_single_one_may_have_any_axes_of_length_1(shape):
    for needed in [(1,), (1, 1)]:
        assert checked_action(np.full(shape, 0.25), needed, "vehicle_2").tolist() == np.full(needed, 0.25).tolist()


@pytest.mark.parametrize(
    ("shape", "needed"), [((2,), (1,)), ((0,), (1,)), ((2, 3), (3, 2)), ((6,), (3, 2)), ((), (2,))]
)
def test_action__of_another_shape_is_refused(shape, needed):
    with pytest.raises(InvalidInput, match=r"action of vehicle_2: shape \("):
        checked_action(np.zeros(shape), needed, "vehicle_2")


def test_action__is_linear_on_each_side_of_coasting_and_back():
    given = {"latency_s": 0.0, "mass_t": 1.0, "restitution": 0.0}
    worlds = make_worlds(
        5.0, np.full((5, 2), 20.0), braking_capacity_mps2=[8.0, 6.0], driving_capacity_mps2=[2.0, 3.0], **given
    )
    vehicles, actions = worlds.vehicles, np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    for vehicle, commands in ((0, [-8.0, -4.0, 0.0, 1.0, 2.0]), (1, [-6.0, -3.0, 0.0, 1.5, 3.0])):
        assert action_to_command(actions, vehicles, vehicle).tolist() == commands
        assert command_to_action(np.array(commands), vehicles, vehicle).tolist() == actions.tolist()
    assert command_to_action(np.array([-99.0, -8.5, 0.0, 2.5, 99.0]), vehicles, 0).tolist() == [
        -1.0,
        -1.0,
        0.0,
        1.0,
        1.0,
    ]


def test_action__without_the_capacity_is_coasting():
    worlds = make_worlds(5.0, np.full((2, 2), 20.0), braking_capacity_mps2=6.0, driving_capacity_mps2=0.0,
                         latency_s=0.0, mass_t=1.0, restitution=0.0)  # fmt: skip
    assert command_to_action(np.array([2.0, -3.0]), worlds.vehicles, 0).tolist() == [0.0, -0.5]


@pytest.mark.parametrize("given", [10**400, "-1", b"-1", None, np.datetime64("1970-01-01"), [1j]])
def test_action__that_is_no_number_is_refused(given):
    with pytest.raises(InvalidInput, match="action of vehicle_2: "):
        checked_action(given, (1,), "vehicle_2")
