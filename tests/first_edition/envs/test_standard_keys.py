"""What Gymnasium and its wrappers name, works here as there: reset_mask, max_episode_steps, settings in a spec."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.envs.making import UnknownResetOption
from ethbrake_marl.first_edition.scenario.schema import Scenario
from tests.first_edition.contract.interfaces import PAPER, REST, actions
from tests.first_edition.envs.test_interfaces import SHORT, FromOneStream, assert_same_infos, initial_state

MASK = np.array([False, True, True, False])


def ran(steps: int = 3, **settings: Any) -> eb.EthBrakeVectorEnv:
    """Four worlds in mid-episode."""
    env = eb.EthBrakeVectorEnv(4, **settings)
    env.reset(seed=5)
    for action in actions(3, steps, 4):
        env.step(action)
    return env


# ---------------------------------------------------------------- reset_mask


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_reset_mask__is_heeded_as_gymnasiums_own_vector_environment_does(mode: str) -> None:
    worlds = SHORT.sample(200, 5, channel="training").worlds
    listed = (initial_state(worlds, k) for k in range(200))
    native = eb.EthBrakeVectorEnv(3, SHORT, autoreset_mode=mode)
    own = SyncVectorEnv([lambda: FromOneStream(listed)] * 3, autoreset_mode=mode)
    native.reset(seed=5), own.reset(seed=5)
    rng, ended, partial = np.random.default_rng(1), np.zeros(3, bool), 0
    for k, action in enumerate(actions(11, 200, 3)):
        mask = ended if mode == "Disabled" else rng.random(3) < 0.1
        if mask.any():
            partial += not mask.all()
            (ours, told), (theirs, told_own) = (env.reset(options={"reset_mask": mask.copy()}) for env in (native, own))
            assert np.array_equal(ours, theirs), k
            assert_same_infos(told, told_own, alone=False)
            assert np.array_equal(told["_world"], mask)
        (ours, *ending, told), (theirs, *ending_own, told_own) = native.step(action), own.step(action)
        assert np.array_equal(ours, theirs)
        assert all(np.array_equal(a, b) for a, b in zip(ending, ending_own, strict=True))
        assert_same_infos(told, told_own, alone=False)
        ended = ending[1] | ending[2]
    assert partial > 5


def test_reset_mask__leaves_the_other_rows_and_the_options_as_they_are() -> None:
    env, untouched = ran(), ran()
    before, options = env.engine.observe(env.learner), {"reset_mask": MASK.copy()}
    seen, infos = env.reset(options=options)
    assert np.array_equal(options["reset_mask"], MASK)
    assert np.array_equal(seen[~MASK], before[~MASK]) and not (seen[MASK] == before[MASK]).all(axis=1).any()
    assert infos["world"].tolist() == [0, 4, 5, 0] and infos["_world"].tolist() == MASK.tolist()
    assert env.engine.roster.numbers.tolist() == [0, 4, 5, 3]
    turns = [each.step(np.zeros((4, 1), np.float32)) for each in (env, untouched)]
    assert np.array_equal(turns[0][0][~MASK], turns[1][0][~MASK])


def test_reset_mask__of_all_rows_is_a_reset() -> None:
    env, other = ran(), ran()
    every = {"reset_mask": np.ones(4, bool)}
    assert np.array_equal(env.reset(options=every)[0], other.reset()[0])
    assert np.array_equal(env.reset(seed=9, options=every)[0], other.reset(seed=9)[0])
    given = {"initial_state": {"gaps_m": 7, "speeds_mps": 20}}
    assert np.array_equal(env.reset(options=every | given)[0], other.reset(options=given)[0])


REFUSED_MASKS: list[tuple[dict[str, Any], str]] = [
    *(
        ({"reset_mask": mask}, r"reset: reset_mask = .*: must be a bool array of shape \(4,\) with at least one True")
        for mask in ([True] * 4, np.ones(3, bool), np.ones(4, int), np.zeros(4, bool), None, np.ones((4, 1), bool))
    ),
    (
        {"reset_mask": MASK, "initial_state": {"gaps_m": 7}},
        "reset: reset_mask omits some rows, but initial_state requires a reset of all rows; remove reset_mask",
    ),
    ({"reset_mask": MASK, "listed_world": {"seed": 1, "number": 1}}, "reset_mask omits some rows, but listed_world"),
]


@pytest.mark.parametrize(("options", "message"), REFUSED_MASKS, ids=range(len(REFUSED_MASKS)))
def test_reset_mask__that_cannot_be_heeded_is_refused(options: Any, message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        ran().reset(options=options)


def test_reset_mask__is_refused_with_a_seed_or_a_generator_that_no_row_has_started_from() -> None:
    env, some = ran(), {"reset_mask": MASK}
    with pytest.raises(InvalidInput, match="reset: reset_mask omits some rows, but seed requires a reset of all rows;"):
        env.reset(seed=3, options=some)
    env.np_random = np.random.default_rng(3)
    with pytest.raises(InvalidInput, match="reset: reset_mask omits some rows, but np_random requires"):
        env.reset(options=some)
    env.reset()
    assert env.reset(options=some)[1]["world"].tolist() == [0, 4, 5, 0]
    with pytest.raises(InvalidInput, match="reset: reset_mask omits some rows, but the first reset"):
        eb.EthBrakeVectorEnv(4).reset(options=some)
    with pytest.warns(UnknownResetOption, match=r"unknown keys colour, which are ignored; known keys: .*reset_mask"):
        env.reset(options={**some, "colour": "red"})


def test_disabled_autoreset__wants_its_ended_rows_reset() -> None:
    env = eb.EthBrakeVectorEnv(3, REST, autoreset_mode=AutoresetMode.DISABLED)
    env.reset(seed=0)
    for _ in range(10):
        *_, terminated, _, infos = env.step(np.full((3, 1), -1.0, np.float32))
    assert terminated.all() and "final_obs" not in infos
    with pytest.raises(InvalidInput, match=r"step: the episodes in rows 0, 1, 2 have ended; .*reset_mask"):
        env.step(np.zeros((3, 1), np.float32))
    env.reset(options={"reset_mask": np.array([True, False, True])})
    with pytest.raises(InvalidInput, match="step: the episodes in rows 1 have ended;"):
        env.step(np.zeros((3, 1), np.float32))
    env.reset(options={"reset_mask": np.array([False, True, False])})
    assert not env.step(np.zeros((3, 1), np.float32))[2].any()


# ---------------------------------------------------------------- max_episode_steps


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_max_episode_steps__in_make_vec_cuts_off_as_gymnasiums_time_limit_does(mode: str) -> None:
    worlds = SHORT.sample(200, 5, channel="training").worlds
    listed = (initial_state(worlds, k) for k in range(200))
    native = gymnasium.make_vec("EthBrake-v1", 3, scenario=SHORT, max_episode_steps=5, autoreset_mode=mode)
    rows = [lambda: gymnasium.wrappers.TimeLimit(FromOneStream(listed), 5)] * 3
    own = SyncVectorEnv(rows, autoreset_mode=mode)
    native.reset(seed=5), own.reset(seed=5)
    lengths, cut = np.zeros(3, int), 0
    for action in actions(11, 60, 3):
        (ours, *ending, told), (theirs, *ending_own, told_own) = native.step(action), own.step(action)
        assert np.array_equal(ours, theirs)
        assert all(np.array_equal(a, b) for a, b in zip(ending, ending_own, strict=True))
        assert_same_infos(told, told_own, alone=False)
        over = ending[1] | ending[2]
        lengths, cut = lengths + 1, cut + over.sum()
        assert lengths.max() <= 5 + (mode == "NextStep")
        lengths[over] = 0
        if mode == "Disabled" and over.any():
            options = ({"reset_mask": over.copy()} for _ in range(2))
            seen = [env.reset(options=each)[0] for env, each in zip((native, own), options, strict=True)]
            assert np.array_equal(*seen)
    assert cut >= 24


@pytest.mark.parametrize("way", ["vector_entry_point", "sync"])
def test_max_episode_steps__means_the_same_in_every_way_and_goes_into_the_spec(way: str) -> None:
    env = gymnasium.make_vec("EthBrake-v1", 2, vectorization_mode=way, scenario="paper-random", max_episode_steps=4)
    env.reset(seed=1)
    assert [env.step(np.zeros((2, 1), np.float32))[3].all() for _ in range(4)] == [False, False, False, True]
    spec = EnvSpec.from_json(env.spec.to_json())
    again = gymnasium.make_vec(spec)
    again.reset(seed=1)
    assert [again.step(np.zeros((2, 1), np.float32))[3].all() for _ in range(4)] == [False, False, False, True]
    assert type(again.unwrapped) is type(env.unwrapped) and spec == again.spec


@pytest.mark.parametrize("steps", [0, 1.5, True, "3"])
def test_max_episode_steps__must_be_a_whole_number(steps: Any) -> None:
    with pytest.raises(InvalidInput, match=r"max_episode_steps = .*: must be a whole number, at least 1"):
        eb.EthBrakeVectorEnv(2, max_episode_steps=steps)


@pytest.mark.parametrize(
    ("scenario", "most", "taken"),
    [(PAPER, 80, 75), (PAPER.replace(latency_s=0), 80, 80), (PAPER.replace(horizon_s=0.95), 10, 5)],
    ids=["paper", "at once", "short"],
)
def test_spec__holds_the_most_steps_of_an_episode(scenario: Scenario, most: int, taken: int) -> None:
    env = gymnasium.make("EthBrake-v1", scenario=scenario)
    many = gymnasium.make_vec("EthBrake-v1", 2, scenario=scenario)
    assert env.spec.max_episode_steps == many.spec.max_episode_steps == most
    env.reset(seed=0)
    steps = 1
    while not env.step(np.ones(1, np.float32))[3]:
        steps += 1
    assert steps == taken


# ---------------------------------------------------------------- settings that survive a spec's JSON

LEARNERS: list[Any] = [
    np.array([1]), np.array(["vehicle_2"]), range(1, 2), {1},
]  # fmt: skip


@pytest.mark.parametrize("vector", [False, True], ids=["single", "vector"])
@pytest.mark.parametrize(
    "settings",
    [
        *({"learners": learners} for learners in LEARNERS),
        {"reward": {"harm": np.float32(0.5), "terminal": np.int64(2)}},
        {"reward": eb.RewardParams(harm=0.5)},
        {"observation": list(np.array(["own", "front_1"]))},
        {"observation": {"vehicle_2": ("own", "front_1")}},
        {"observation": eb.ObservationSpec(2, 0)},
        {"scenario": {**PAPER.declared(), "horizon_s": np.float64(5)}},
        {"scenario": PAPER.replace(gaps_m=7)},
    ],
    ids=repr,
)
def test_spec__survives_json_whatever_the_settings_are_made_of(settings: dict[str, Any], vector: bool) -> None:
    make: Any = (lambda *given, **more: gymnasium.make_vec(*given, **more)) if vector else gymnasium.make
    made = make("EthBrake-v1", **settings)
    again = make(EnvSpec.from_json(made.spec.to_json()))
    for name in ("scenario", "reward", "observation", "learners"):
        assert getattr(again.unwrapped.engine, name) == getattr(made.unwrapped.engine, name)
    assert np.array_equal(again.reset(seed=5)[0], made.reset(seed=5)[0])
