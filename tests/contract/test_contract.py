"""What every interface promises, bare and behind the shield, stricter than the libraries' own checkers."""

import copy
import json
import pickle
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import open_game
from ethbrake_marl.episode.shaping import potential
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.faces.stream import UnknownResetOption
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.describe import columns_of
from ethbrake_marl.worlds.scenario import Scenario
from tests.contract.interfaces import (
    BARE,
    FIVE,
    INTERFACES,
    PAPER,
    REST,
    STEP,
    Interface,
    Turn,
    actions,
    initial_state,
    line,
    rows_of,
)

# What a shield changes is told by `shields/`; here one shielded interface stands for all of them.
EACH = [*BARE, "shielded vector"]
each_interface = pytest.mark.parametrize("name", EACH)
each_bare = pytest.mark.parametrize("name", BARE)
each_scenario = pytest.mark.parametrize(
    ("name", "scenario"),
    [*((name, PAPER) for name in EACH), ("vector", FIVE)],
    ids=lambda value: value if isinstance(value, str) else value.name,
)


def make(name: str, scenario: Scenario = PAPER, **settings: Any) -> Interface:
    return INTERFACES[name](scenario, rows_of(name), **settings)


def play(interface: Interface, seed: int | None, steps: int = 160) -> Iterator[Turn]:
    interface.reset(seed)
    for action in actions(3, steps, interface.n):
        yield interface.step(action)


def bits(turns: Iterator[Turn] | list[Turn]) -> list[bytes]:
    return [turn.bits() for turn in turns]


@each_scenario
def test_seed__repeats_whole_episodes_bit_for_bit_whatever_happened_before(name: str, scenario: Scenario) -> None:
    first, used = list(play(make(name, scenario), 11)), make(name, scenario)
    list(play(used, 99, steps=7))
    assert bits(play(used, 11)) == bits(first) and sum(turn.ended.sum() for turn in first) >= 2 * rows_of(name) - 1


@each_interface
def test_seed__others_differ_and_without_one_the_stream_goes_on_or_is_fresh(name: str) -> None:
    interface = make(name)
    first, second = interface.reset(1), interface.reset()
    starts = [first, second, interface.reset(2), make(name).reset(), make(name).reset()]
    assert len({start.tobytes() for start in starts}) == 5
    assert np.array_equal(interface.reset(1), first) and np.array_equal(interface.reset(), second)


@each_scenario
def test_observation__lies_in_its_finite_float32_space_at_every_step(name: str, scenario: Scenario) -> None:
    interface = make(name, scenario)
    assert np.isfinite(interface.space.low).all() and np.isfinite(interface.space.high).all()
    seen = [interface.reset(5)]
    for turn in play(interface, 5):
        seen += [turn.observation, *(final[np.newaxis] for final in turn.final.values())]
        assert np.isfinite(turn.reward).all() and len(turn.final) == turn.ended.sum()
    assert {batch.dtype for batch in seen} == {interface.space.dtype} == {np.dtype(np.float32)}
    assert all(np.isfinite(row).all() and row in interface.space for batch in seen for row in batch)


@each_interface
def test_arrays__what_was_returned_never_changes_and_what_was_given_is_left_alone(name: str) -> None:
    untouched, abused = make(name), make(name)
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    untouched.reset(5), abused.reset(5).fill(np.nan)
    for given in actions(3, 120, abused.n):
        action = given.copy()
        expected, turn = untouched.step(given.copy()), abused.step(action)
        assert turn.bits() == expected.bits() and np.array_equal(action, given)
        kept += [(array, array.copy()) for array in expected.arrays()]
        action.fill(np.nan)
        for array in turn.arrays():
            array.fill(True if array.dtype == np.bool_ else np.nan)
    assert all(np.array_equal(array, copy_) for array, copy_ in kept)


TWELVE = FIVE.replace(
    vehicles=12, braking_capacity_mps2=6, latency_s=0.4, roles={f"vehicle_{i}": "learner" for i in range(2, 13)}
)


def spoil(value: Any) -> None:
    """Change all that can be changed in what a caller got."""
    for part in value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else ():
        spoil(part)
    if isinstance(value, list):
        value.reverse()
        value[1:] = []
    elif isinstance(value, dict):
        value.clear()
    elif isinstance(value, np.ndarray):
        value.fill(True if value.dtype.kind in "bO" else 77)


# Reset and step of an environment as its library calls them, and what else can be read of it.
LIBRARIES: dict[str, tuple[Callable[[], Any], Callable[[Any], Any], list[str]]] = {
    "PettingZoo": (
        lambda: eb.parallel_env(TWELVE, reward_vector="vehicles"),
        lambda env: env.step({f"vehicle_{i}": [-0.1 * (i % 9)] for i in range(2, 13)}),
        ["possible_agents", "agents", "observation_spaces", "action_spaces", "reward_spaces", "metadata"],
    ),
    "PettingZoo, learners alone": (
        lambda: eb.parallel_env(TWELVE, agents="learners"),
        lambda env: env.step({f"vehicle_{i}": [-0.1 * (i % 9)] for i in range(2, 13)}),
        ["possible_agents", "agents", "observation_spaces", "action_spaces"],
    ),
    "Gymnasium": (
        lambda: eb.EthBrakeEnv(PAPER, reward_vector="vehicles"), lambda env: env.step([-0.3]), ["metadata"]
    ),
    "vector": (lambda: eb.EthBrakeVectorEnv(4, PAPER, max_episode_steps=9), lambda env: env.step([[-0.3]] * 4), []),
    "SB3": (
        lambda: eb.make_sb3_vec_env(PAPER, 4, step_infos=True, max_cycles=9),
        lambda env: env.step([[-0.3]] * 4),
        ["reset_infos"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LIBRARIES)
def test_what_is_returned__can_be_changed_without_harm(name: str) -> None:
    make_env, step, names = LIBRARIES[name]
    told: list[list[str]] = []
    for is_spoilt in (False, True):
        env, seen = make_env(), []

        def read(value: Any, seen: list[str] = seen, is_spoilt: bool = is_spoilt) -> None:
            seen.append(repr(value))
            if is_spoilt:
                spoil(value)

        if name == "SB3":
            read(env.seed(7))
            read(env.reset())
        else:
            read(env.reset(seed=7))
        for _ in range(12):
            read(step(env))
            for attribute in names:
                read(getattr(env, attribute))
            read(env.describe_worlds())
            if hasattr(env, "state"):
                read(env.state())
        told.append(seen)
    assert told[0] == told[1] and len(set(told[0])) > 12


@pytest.mark.parametrize(
    ("name", "scenario", "driven", "ends"),
    [
        # From 0.5 s to the horizon at 0.95 s: four steps of 0.1 s and one of 0.05 s.
        *((name, PAPER.replace(horizon_s=0.95), [0.3] * 15, "....c" * 3) for name in EACH),
        *((name, REST, [-1.0] * 20, ".........r" * 2) for name in EACH),
        ("vector", REST.replace(horizon_s=1.5), [-1.0] * 10, ".........r"),
        # Driving from 1.45 s on: the vehicle rests for an instant only, and the horizon ends the episode.
        ("vector", REST.replace(horizon_s=2.0), [-1.0] * 9 + [1.0] * 6, "." * 14 + "c"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_end__is_terminated_where_all_rest_and_else_cut_off_at_the_horizon(
    name: str, scenario: Scenario, driven: list[float], ends: str
) -> None:
    interface, told = make(name, scenario), ""
    interface.reset(0)
    for value in driven:
        turn = interface.step(np.full((interface.n, 1), value, np.float32))
        assert (turn.terminated == turn.terminated[0]).all() and (turn.truncated == turn.truncated[0]).all()
        told += {(False, False): ".", (True, False): "r", (False, True): "c"}[turn.terminated[0], turn.truncated[0]]
    assert told == ends


@each_interface
@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
def test_clone__in_mid_episode_goes_on_alike_and_apart(name: str, clone: Any) -> None:
    interface = make(name)
    list(play(interface, 5, steps=10))
    twin = copy.copy(interface)
    twin.env = clone(interface.env)
    twin_turns = bits([twin.step(action) for action in actions(8, 90, interface.n)])
    assert bits([interface.step(action) for action in actions(8, 90, interface.n)]) == twin_turns


@pytest.mark.parametrize(
    ("scenario", "reward"),
    [(PAPER, "paper-reward"), (FIVE, "first-impact-harm"), (line(2).with_learners(["vehicle_1"]), "total-harm")],
    ids=lambda value: value if isinstance(value, str) else value.name,
)
def test_interfaces__agree_on_every_episode(scenario: Scenario, reward: str) -> None:
    runs = {name: list(play(BARE[name](scenario, 1, reward=reward), 7)) for name in BARE}
    assert sum(turn.ended.sum() for turn in runs["single"]) >= 2
    assert any(turn.reward[0] != 0.0 for turn in runs["single"])
    assert {name: bits(turns) for name, turns in runs.items()} == dict.fromkeys(BARE, bits(runs["single"]))


@each_bare
def test_default_reward__is_the_scaled_honest_cost_and_in_sum_a_constant_of_the_world(name: str) -> None:
    game, interface, given = open_game(PAPER, reward="honest")[1], BARE[name](PAPER, 1), [[-0.3]]
    state, total, factor = game.reset(PAPER.sample(6, seed=7).take([5])), 0.0, 1.0
    interface.reset(options={"listed_world": {"seed": 7, "number": 5}})
    constant = -0.05 * potential(game.settings, state)[0]
    while not state.ended[0]:
        state, step = game.step(state, np.array(given))
        turn = interface.step(np.array(given, np.float32))
        total += factor * (turn.reward[0] + 0.05 * step.cost[0])
        factor *= 0.99
    assert turn.ended[0] and constant > 0.1 and total == pytest.approx(constant, abs=1e-5)


def test_interfaces__agree_behind_the_shield_and_differ_from_the_bare_ones() -> None:
    runs = {name: bits(play(STEP[name](PAPER, 1), 7)) for name in STEP}
    assert runs == dict.fromkeys(STEP, runs["shielded single"])
    assert bits(play(BARE["single"](PAPER, 1), 7)) != runs["shielded single"]


NEWS = {"preset": "nominal", "link_latency_s": 0.6, "hears": "front", "sensing_s": [0.9, 0.9]}  # without chance


@pytest.mark.parametrize("scenario", [FIVE, PAPER.replace(v2x=NEWS, objective="own", early_impacts="keep")])
def test_batch__row_k_is_the_world_alone(scenario: Scenario) -> None:
    n, seed = 5, 7
    worlds = scenario.sample(n, seed, purpose="training")
    batch = BARE["vector"](scenario, n)
    start, columns = batch.reset(seed), actions(3, 80, n)
    turns = [batch.step(action) for action in columns]
    for k in range(n):
        alone = BARE["single"](scenario, 1)
        assert np.array_equal(alone.reset(options={"initial_state": initial_state(worlds, k)})[0], start[k])
        for turn, action in zip(turns, columns, strict=True):
            mine = alone.step(action[k : k + 1])
            assert np.float32(mine.reward[0]) == np.float32(turn.reward[k])
            assert (mine.terminated[0], mine.truncated[0]) == (turn.terminated[k], turn.truncated[k])
            if mine.ended[0]:
                assert np.array_equal(mine.final[0], turn.final[k]) and mine.harm[0] == turn.harm[k]
                break
            assert np.array_equal(mine.observation[0], turn.observation[k])
        else:
            pytest.fail("the episode did not end")


def acts(value: Any, shape: tuple[int, ...] = (1,)) -> Callable[[Interface], Any]:
    def step(interface: Interface) -> None:
        given = np.zeros((interface.n, *shape), object if isinstance(value, str) else float)
        given[-1] = value
        interface.step(given)

    return step


def starts(state: Any) -> Callable[[Interface], Any]:
    def reset(interface: Interface) -> None:  # Stable-Baselines3 keeps a seed until a reset succeeds
        interface.reset(3 if not hasattr(interface.env, "reset_infos") else None, {"initial_state": state})

    return reset


REFUSED: list[tuple[Callable[[Interface], Any], str]] = [
    *((acts(value), r"(nan|1\.001): must be from -1 \(full braking\) to 1") for value in (np.nan, 1.001)),
    (acts("full"), r"must be a number in \[-1, 1\]"),
    (acts(0.5, (2,)), "must have shape"),
    *(
        (lambda given, seed=seed: given.reset(seed), "seed = .*must be None or a")
        for seed in (-1, True, 3.0, "7", b"ab", np.array(3), np.array("3"), {3, 4})
    ),
    *((starts(state), "initial_state") for state in ({"gaps_m": [7, -1]}, 0)),
    (starts({"gaps_m": 3, "speeds_mps": 20, "braking_capacity_mps2": 4}), "constant:5"),  # of the script of Vehicle 3
]


# Everything is refused in one interface, and one thing in each of the others. In turn, PettingZoo keeps a bad action.
OTHERS = [name for name in EACH if name != "vector"]
ASKED = [
    *(("vector", *each) for each in REFUSED),
    *((name, *REFUSED[4 if name.endswith("in turn") else k]) for k, name in enumerate(OTHERS)),
]


@pytest.mark.parametrize(("name", "ask", "message"), ASKED, ids=range(len(ASKED)))
def test_refusal__changes_nothing(name: str, ask: Callable[[Interface], Any], message: str) -> None:
    roles = {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "constant:5"}
    interface, untouched = (make(name, PAPER.replace(roles=roles)) for _ in range(2))
    list(play(interface, 5, steps=10)), list(play(untouched, 5, steps=10))
    with pytest.raises(InvalidInput, match=message):
        ask(interface)
    assert all(interface.step(action).bits() == untouched.step(action).bits() for action in actions(8, 5, interface.n))
    assert np.array_equal(interface.reset(), untouched.reset())


@pytest.mark.parametrize("name", [name for name in EACH if not name.endswith("in turn")])  # PettingZoo's own
def test_step__before_the_first_reset_is_refused(name: str) -> None:
    interface = make(name)
    with pytest.raises(InvalidInput, match="step: no episode is running; call reset first"):
        interface.step(np.zeros((interface.n, 1), np.float32))
    with pytest.raises(InvalidInput, match="step: no episode is running; call reset first"):
        interface.step(np.full((interface.n, 1), np.nan, np.float32))  # whatever the action


@each_bare
def test_action__as_a_number_or_one_float32_step_beyond_1_is_the_same(name: str) -> None:
    interfaces = [make(name) for _ in range(3)]
    beyond = np.nextafter(np.float32(1), np.float32(2))
    for interface in interfaces:
        interface.reset(3)
    for value, other in ((-0.5, -0.5), (1.0, beyond)):
        column = np.full((interfaces[0].n, 1), value, np.float32)
        given = (column, column.reshape(-1), np.full_like(column, other))
        turns = [interface.step(action) for interface, action in zip(interfaces, given, strict=True)]
        assert bits(turns) == [turns[0].bits()] * 3


@each_interface
def test_options__an_unknown_one_warns_and_is_ignored(name: str) -> None:
    interface = make(name)
    expected = interface.reset(5)
    with pytest.warns(
        UnknownResetOption, match="unknown keys colour, which are ignored; known keys: initial_state"
    ) as seen:
        given = interface.reset(5, {"colour": "red"})
    assert len(seen) == 1 and np.array_equal(given, expected)


@each_interface
def test_options__an_initial_state_serves_one_episode_in_every_world(name: str) -> None:
    interface = make(name)
    state = {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}
    start = interface.reset(5, {"initial_state": state})
    assert (start == start[0]).all() and start[0, 0] == np.float32(18.0 / 20.0)  # the own speed
    assert np.array_equal(start, interface.reset(6, {"initial_state": state}))
    assert not np.array_equal(interface.reset(), start)


@each_interface
def test_options__a_listed_world_and_those_that_follow_serve_one_episode(name: str) -> None:
    interface, stream = make(name), make(name)
    start = interface.reset(5, {"listed_world": {"seed": 7, "number": np.int64(40)}})
    worlds, alone = PAPER.sample(interface.n, 7, first=40), BARE["single"](PAPER, 1)
    for k, row in enumerate(start):
        assert np.array_equal(alone.reset(options={"initial_state": initial_state(worlds, k)})[0], row)
    assert np.array_equal(interface.reset(), stream.reset(5))


@cache
def mixture() -> Scenario:
    """Types in one of the two."""
    return load_scenario(
        {"name": "both", "mixture": [{"scenario": "realistic-mixed"}, {"scenario": "realistic-truck"}]}
    )


def drawn(seed: int, world: int) -> dict[str, Any]:
    columns = columns_of(mixture().draw(1, seed, first=world, purpose="training"))
    assert "scenario" in columns
    return {"world_seed": seed} | {name: column[0].item() for name, column in columns.items()}


@each_interface
def test_describe_world__tells_the_numbers_of_its_sample_for_every_world_that_has_begun(name: str) -> None:
    interface = make(name, mixture())
    interface.reset(3)
    assert interface.drawn() == [drawn(3, world) for world in range(interface.n)]
    for _ in range(60):
        interface.step(np.full((interface.n, 1), -1.0, np.float32))
    told = interface.drawn()
    assert told == [drawn(3, world["world"]) for world in told] and json.dumps(told)
    assert min(world["world"] for world in told) > 0
