"""What every interface promises, stricter than the libraries' own checkers."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.envs.interfaces import UnknownResetOption
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.scenario import Scenario
from tests.contract.interfaces import (
    BATCHED,
    FIVE,
    INTERFACES,
    PAPER,
    SCENARIOS,
    Interface,
    Turn,
    actions,
    all_digests,
    initial_state,
    rows_of,
)

each_interface = pytest.mark.parametrize("name", INTERFACES)
each_batch = pytest.mark.parametrize("name", BATCHED)
each_scenario = pytest.mark.parametrize("scenario", SCENARIOS.values(), ids=SCENARIOS)

# Two vehicles far apart: the learner, from 5.7 m/s with 6 m/s2 after 0.5 s, rests at 1.45 s, in its 10th step.
TWO = Scenario(
    name="two",
    vehicles=2,
    gaps_m=50,
    speeds_mps=5.7,
    braking_capacity_mps2=6,
    driving_capacity_mps2=6,
    mass_t=1,
    latency_s=[0, 0.5],
)


def make(name: str, scenario: Scenario = PAPER, **settings: Any) -> Interface:
    return INTERFACES[name](scenario, rows_of(name), **settings)


def play(interface: Interface, seed: int | None, steps: int = 160) -> Iterator[Turn]:
    interface.reset(seed)
    for action in actions(3, steps, interface.n):
        yield interface.step(action)


@each_interface
@each_scenario
def test_seed__repeats_whole_episodes_bit_for_bit(name: str, scenario: Scenario) -> None:
    assert np.array_equal(make(name, scenario).reset(11), make(name, scenario).reset(11))
    first, again = (list(play(make(name, scenario), 11)) for _ in range(2))
    assert [turn.bits() for turn in first] == [turn.bits() for turn in again]
    assert sum(turn.ended.sum() for turn in first) >= 2 * rows_of(name) - 1


@each_interface
def test_seed__starts_its_stream_again_whatever_happened_before(name: str) -> None:
    interface = make(name)
    first = [turn.bits() for turn in play(interface, 4)]
    list(play(interface, 99, steps=7))
    assert [turn.bits() for turn in play(interface, 4)] == first


@each_interface
def test_seed__different_seeds_differ(name: str) -> None:
    interface = make(name)
    assert not np.array_equal(interface.reset(1), interface.reset(2))


@each_interface
def test_seed__without_one_the_stream_goes_on(name: str) -> None:
    interface = make(name)
    first, second = interface.reset(1), interface.reset()
    assert not np.array_equal(first, second)
    interface.reset(1)
    assert np.array_equal(interface.reset(), second)


@each_interface
def test_seed__an_environment_that_was_never_seeded_uses_fresh_entropy(name: str) -> None:
    assert not np.array_equal(make(name).reset(), make(name).reset())


@each_interface
@pytest.mark.parametrize("seed", [-1, 1.5, True, "1"])
def test_seed__anything_but_a_whole_number_from_0_is_refused(name: str, seed: Any) -> None:
    with pytest.raises(InvalidInput, match=r"reset: seed = .*must be None or a whole number, at least 0"):
        make(name).reset(seed)


@each_interface
@each_scenario
def test_observation__lies_in_its_finite_float32_space_at_every_step(name: str, scenario: Scenario) -> None:
    interface = make(name, scenario)
    assert np.isfinite(interface.space.low).all() and np.isfinite(interface.space.high).all()
    assert interface.space.dtype == np.float32
    seen = [interface.reset(5)]
    for turn in play(interface, 5):
        seen += [turn.observation, *(final[np.newaxis] for final in turn.final.values())]
        assert np.isfinite(turn.reward).all()
        assert len(turn.final) == turn.ended.sum()
    for batch in seen:
        assert batch.dtype == np.float32
        assert np.isfinite(batch).all()
        assert all(row in interface.space for row in batch)


@each_interface
def test_arrays__what_was_returned_never_changes_and_may_be_overwritten(name: str) -> None:
    untouched, abused = make(name), make(name)
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    untouched.reset(5), abused.reset(5).fill(np.nan)
    for action in actions(3, 120, abused.n):
        expected, turn = untouched.step(action.copy()), abused.step(action)
        assert turn.bits() == expected.bits()
        kept += [(array, array.copy()) for array in expected.arrays()]
        action.fill(np.nan)
        for array in turn.arrays():
            array.fill(True if array.dtype == np.bool_ else np.nan)
    assert all(np.array_equal(array, copy_) for array, copy_ in kept)


@each_interface
def test_actions__are_left_alone(name: str) -> None:
    interface = make(name)
    interface.reset(5)
    for action in actions(3, 20, interface.n):
        before = action.copy()
        interface.step(action)
        assert np.array_equal(action, before)


@each_batch
@each_scenario
def test_batch__its_worlds_differ_from_each_other_in_every_episode(name: str, scenario: Scenario) -> None:
    interface = make(name, scenario)
    starts = [row.tobytes() for row in interface.reset(5)]
    for turn in play(interface, 5):
        starts += [turn.observation[row].tobytes() for row in turn.final]
    assert len(starts) >= 2 * interface.n
    assert len(set(starts)) == len(starts)


@each_interface
def test_truncated__marks_the_horizon_and_nothing_else(name: str) -> None:
    # From 0.5 s to the horizon at 0.95 s: four steps of 0.1 s and one of 0.05 s.
    interface = make(name, PAPER.replace(horizon_s=0.95))
    turns = list(play(interface, 5, steps=15))
    assert [bool(turn.truncated.all()) for turn in turns] == [False, False, False, False, True] * 3
    assert not any(turn.terminated.any() for turn in turns)


@each_interface
def test_terminated__marks_the_moment_when_all_rest(name: str) -> None:
    interface = make(name, TWO)
    interface.reset(0)
    turns = [interface.step(np.full((interface.n, 1), -1.0, np.float32)) for _ in range(20)]
    assert [bool(turn.terminated.all()) for turn in turns] == ([False] * 9 + [True]) * 2
    assert not any(turn.truncated.any() for turn in turns)


@each_interface
def test_terminated__at_the_horizon_itself_is_not_truncated(name: str) -> None:
    interface = make(name, TWO.replace(horizon_s=1.5))
    interface.reset(0)
    turns = [interface.step(np.full((interface.n, 1), -1.0, np.float32)) for _ in range(10)]
    assert turns[-1].terminated.all() and not turns[-1].truncated.any()


@each_interface
def test_terminated__not_while_a_command_would_move_a_vehicle_at_rest(name: str) -> None:
    # Driving from 1.45 s on: the vehicle rests for an instant only, and the horizon ends the episode.
    interface = make(name, TWO.replace(horizon_s=2.0))
    interface.reset(0)
    for _ in range(9):
        interface.step(np.full((interface.n, 1), -1.0, np.float32))
    turns = [interface.step(np.full((interface.n, 1), 1.0, np.float32)) for _ in range(6)]
    assert not any(turn.terminated.any() for turn in turns)
    assert turns[-1].truncated.all()


@each_interface
@each_scenario
@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
def test_clone__in_mid_episode_goes_on_alike_and_apart(name: str, scenario: Scenario, clone: Any) -> None:
    interface = make(name, scenario)
    list(play(interface, 5, steps=10))
    twin = copy.copy(interface)
    twin.env = clone(interface.env)
    twin_turns = [twin.step(action).bits() for action in actions(8, 90, interface.n)]
    assert [interface.step(action).bits() for action in actions(8, 90, interface.n)] == twin_turns


@pytest.mark.slow
def test_spawn__another_process_sees_the_same_bits() -> None:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        elsewhere = pool.apply(all_digests)
    assert elsewhere == all_digests()
    assert len(set(elsewhere.values())) > len(SCENARIOS)


@each_scenario
@pytest.mark.parametrize("reward", ["harm", "total-harm", "paper"])
def test_interfaces__agree_on_every_episode(scenario: Scenario, reward: str) -> None:
    runs = {name: list(play(INTERFACES[name](scenario, 1, reward=reward), 7)) for name in INTERFACES}
    assert sum(turn.ended.sum() for turn in runs["single"]) >= 2
    assert any(turn.reward[0] != 0.0 for turn in runs["single"])
    expected = [turn.bits() for turn in runs["single"]]
    for name, turns in runs.items():
        assert [turn.bits() for turn in turns] == expected, name


@each_interface
@each_scenario
def test_batch__of_one_is_row_k_of_a_batch(name: str, scenario: Scenario) -> None:
    n, seed = 5, 7
    worlds = scenario.sample(n, seed, channel="training").worlds
    batch = INTERFACES["vector"](scenario, n)
    start = batch.reset(seed)
    columns = actions(3, 70, n)
    turns = [batch.step(action) for action in columns]
    for k in range(n):
        alone = INTERFACES[name](scenario, 1)
        assert np.array_equal(alone.reset(options={"initial_state": initial_state(worlds, k)})[0], start[k])
        for turn, action in zip(turns, columns, strict=True):
            mine = alone.step(action[k : k + 1])
            assert np.float32(mine.reward[0]) == np.float32(turn.reward[k])
            assert (mine.terminated[0], mine.truncated[0]) == (turn.terminated[k], turn.truncated[k])
            if mine.ended[0]:
                assert np.array_equal(mine.final[0], turn.final[k])
                assert mine.harm[0] == turn.harm[k]
                break
            assert np.array_equal(mine.observation[0], turn.observation[k])
        else:
            pytest.fail("the episode did not end")


@each_interface
@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.nan, r"nan; must be in \[-1, 1\]"),
        (1.001, r"1\.001; must be in \[-1, 1\]"),
        (-np.inf, r"-inf; must be in \[-1, 1\]"),
        ("full", r"'full'.* is not a number"),
    ],
)
def test_action__one_that_cannot_be_used_is_refused_and_changes_nothing(name: str, value: Any, message: str) -> None:
    interface, untouched = make(name), make(name)
    list(play(interface, 5, steps=10)), list(play(untouched, 5, steps=10))
    bad = np.zeros((interface.n, 1), object)
    bad[-1] = value
    with pytest.raises(InvalidInput, match=message):
        interface.step(bad)
    for action in actions(8, 5, interface.n):
        assert interface.step(action).bits() == untouched.step(action).bits()


@each_interface
def test_action__of_another_shape_is_refused(name: str) -> None:
    interface = make(name)
    interface.reset(5)
    with pytest.raises(InvalidInput, match="shape"):
        interface.step(np.zeros((interface.n, 2), np.float32))


@each_interface
def test_step__before_the_first_reset_is_refused(name: str) -> None:
    interface = make(name)
    with pytest.raises(InvalidInput, match="step: no episode is running; call reset first"):
        interface.step(np.zeros((interface.n, 1), np.float32))


@each_interface
def test_options__an_unknown_one_warns_and_is_ignored(name: str) -> None:
    interface = make(name)
    expected = interface.reset(5)
    with pytest.warns(UnknownResetOption, match="reset: unknown option colour, ignored; known: initial_state") as seen:
        given = interface.reset(5, {"colour": "red"})
    assert len(seen) == 1
    assert np.array_equal(given, expected)


@each_interface
@pytest.mark.parametrize("state", [{"gaps_m": [7, -1]}, {"gap_m": 7}, {"speeds_mps": [1, 2]}, [7, 7], None])
def test_options__a_bad_initial_state_is_refused_and_changes_nothing(name: str, state: Any) -> None:
    interface, untouched = make(name), make(name)
    list(play(interface, 5, steps=10)), list(play(untouched, 5, steps=10))
    with pytest.raises(InvalidInput, match="initial_state"):
        interface.reset(
            None if name == "sb3" else 3, {"initial_state": state}
        )  # SB3 keeps a seed until a reset succeeds
    assert np.array_equal(interface.reset(), untouched.reset())


@each_interface
def test_options__an_initial_state_serves_one_episode_in_every_world(name: str) -> None:
    interface = make(name)
    state = {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}
    start = interface.reset(5, {"initial_state": state})
    assert (start == start[0]).all()
    assert np.array_equal(start, interface.reset(6, {"initial_state": state}))
    own_speed = 18.0 / 20.0
    assert start[0, 0] == np.float32(own_speed)
    assert not np.array_equal(interface.reset(), start)


@pytest.mark.parametrize("name", ["single", "vector"])
def test_learners__these_interfaces_need_exactly_one(name: str) -> None:
    with pytest.raises(InvalidInput, match=r"2 learners \(vehicle_2, vehicle_3\)"):
        make(name, learners=["vehicle_2", "vehicle_3"])
    with pytest.raises(InvalidInput, match=r"0 learners \(none\)"):
        make(name, FIVE, learners=[])


@each_interface
@pytest.mark.parametrize("learner", ["vehicle_1", "vehicle_3", "vehicle_5"])
def test_learners__any_vehicle_may_be_the_one(name: str, learner: str) -> None:
    five = FIVE.replace(obstacle_gap_m=30) if learner == "vehicle_1" else FIVE
    interface, same = make(name, five, learners=[learner]), make(name, five, learners=[int(learner[-1]) - 1])
    turns = list(play(interface, 5, steps=30))
    assert [turn.bits() for turn in turns] == [turn.bits() for turn in play(same, 5, steps=30)]
    other = make(name, five, learners=["vehicle_4"])
    assert [turn.bits() for turn in turns] != [turn.bits() for turn in play(other, 5, steps=30)]


@each_interface
def test_learners__vehicle_1_needs_an_obstacle_ahead(name: str) -> None:
    with pytest.raises(InvalidInput, match=r"roles\.vehicle_1 = learner: has nothing to lose .* obstacle_gap_m: 42"):
        make(name, FIVE, learners=["vehicle_1"])
