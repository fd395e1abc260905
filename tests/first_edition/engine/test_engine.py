"""The engine: episodes from the alert on, scripts on their own grid, snapshots, moments played on in several ways."""

from typing import Any

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.envs.making import make_engine
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS
from ethbrake_marl.first_edition.scenario.tables import worlds_from_state

PAPER = eb.load_scenario("paper-random").replace(early_impacts="keep")


def engine(n: int = 2, third: Any = None, first: Any = None) -> Engine:
    scripts = {0: first or eb.make_agent("full_brake"), 2: third or eb.make_agent("constant:5")}
    return Engine(PAPER, n, learners=(1,), scripts=scripts, seed=0)


def state(running: Engine) -> list[Any]:
    packed = running.packed
    arrays = (packed.state, packed.params, running.wanted_mps2, running.ended, running.seed)
    return [np.asarray(array).tolist() for array in arrays]


class Refusing:
    """A script that brakes with 5 m/s2, or a watcher; refuses to begin when told so."""

    name, refuses = "refusing", False

    def begin(self, *alert):
        if self.refuses:
            raise InvalidInput("refusing: will not begin")

    begun = begin

    def act(self, worlds, memory, vehicle):
        return np.full(worlds.n, -5.0), memory

    def stepped(self, memory, before, after):
        return memory


# ---------------------------------------------------------------- what fails changes nothing

# Vehicle 3 of these worlds cannot brake with 5 m/s2.
WEAK = worlds_from_state(PAPER, {"gaps_m": 3, "braking_capacity_mps2": 4, "speeds_mps": 20}).take([0, 0])


@pytest.mark.parametrize("who", ["script", "watcher", "constant:5"])
@pytest.mark.parametrize("start", [Engine.reset, lambda one: one.renew(np.array([1]))])
def test_start__that_fails_leaves_the_running_episodes_and_the_stream_alone(start: Any, who: str) -> None:
    refusing = Refusing()
    running, twin = (engine(third=each if who == "script" else None) for each in (refusing, Refusing()))
    if who == "watcher":
        running.watch(refusing, None)
    for one in (running, twin):
        one.step({1: np.zeros(2)})
    before, refusing.refuses = state(running), True
    with pytest.raises(InvalidInput, match="constant:5" if who == "constant:5" else "will not begin"):
        running.reset(seed=9, worlds=WEAK) if who == "constant:5" else start(running)
    assert state(running) == before
    refusing.refuses = False
    for go_on in (lambda one: one.step({1: np.zeros(2)}), start, Engine.reset):
        for one in (running, twin):
            go_on(one)
        assert state(running) == state(twin)


# ---------------------------------------------------------------- episodes


@pytest.mark.parametrize(
    ("horizon_s", "latency_s", "steps"), [(8.0, 0.5, 75), (3.0, 0.65, 24), (3.0, 2.3, 7), (8.0, 5.1, 29)]
)
def test_horizon__is_reached_after_as_many_steps_as_fit(horizon_s: float, latency_s: float, steps: int) -> None:
    scenario = PAPER.replace(horizon_s=horizon_s, latency_s=[0, latency_s, latency_s], gaps_m=100, speeds_mps=30)
    running = Engine(scenario, 1, learners=(1,), scripts={0: eb.make_agent("coast"), 2: eb.make_agent("coast")})
    ended = [bool(running.step(np.zeros((1, 1))).truncated[0]) for _ in range(steps)]
    assert ended == [False] * (steps - 1) + [True] and running.worlds.time_s.tolist() == [horizon_s]


def test_ended__rows_are_paid_nothing_until_they_are_renewed() -> None:
    reward = {"harm": 1.0, "risk": 1.0, "jerk": 1.0, "terminal": 5.0, "shaping": 1.0}
    running = make_engine("paper-random", 20, seed=1, reward=reward)
    rng, paid_after = np.random.default_rng(0), np.zeros(20)
    for _ in range(80):
        over = running.ended
        paid = running.step(rng.uniform(-1.0, 1.0, (20, 1))).reward
        assert (paid[over] == 0.0).all() and (paid[~over] != 0.0).any(axis=1).all()
        paid_after[over] += 1
    assert (paid_after > 0).all()


# ---------------------------------------------------------------- scripts


class Counting:
    """Brakes with 5 m/s2 plus a little for each decision it has made; notes when it made them."""

    name = "counting"

    def __init__(self, adds: float = 0.1) -> None:
        self.adds = adds

    def begin(self, alert, vehicle, scripts):
        return {"made": np.zeros(alert.n, np.int64), "asked_s": np.zeros((alert.n, 99))}

    def act(self, worlds, memory, vehicle):
        memory["asked_s"][np.arange(worlds.n), memory["made"]] = worlds.time_s  # its own copy
        memory["made"] += 1
        return -5.0 - self.adds * (memory["made"] % 7), memory


OWN_GRID = PAPER.replace(latency_s=[0.03, {"uniform": [0.2, 0.7]}, 0.55], horizon_s=3.0)


def decisions_before(end_s: float) -> int:
    return int(np.ceil((end_s - 0.03) / 0.1 - 1e-9))


@pytest.mark.parametrize("learners", [(1,), (2,), (1, 2), ()])
def test_script__decides_on_its_own_grid_whoever_learns(learners: tuple[int, ...]) -> None:
    worlds = OWN_GRID.sample(5, 3).worlds
    others = {i: eb.make_agent("full_brake") for i in (1, 2) if i not in learners}
    running = Engine(OWN_GRID, 5, learners=learners, scripts={0: Counting(), **others}, worlds=worlds)
    paid = 0.0
    while not running.ended.all():
        paid = paid + running.step(np.full((5, len(learners)), -1.0)).reward[:, 0]
    ledger = running.ledger.world_harm("first")
    assert np.abs(paid + ledger).max() < 1e-9 and ledger.max() > 1.0
    for row, end_s in enumerate(running.worlds.time_s):
        made = decisions_before(end_s)
        assert running.memories[0]["made"][row] == made
        assert running.memories[0]["asked_s"][row, :made] == pytest.approx(0.03 + 0.1 * np.arange(made), abs=1e-9)
    scripts = {0: Counting(), 1: eb.make_agent("full_brake"), 2: eb.make_agent("full_brake")}
    alone = Engine(OWN_GRID, 5, learners=(), scripts=scripts, deciders=(0,), worlds=worlds)
    while not alone.ended.all():
        alone.step({})
    assert np.abs(alone.ledger.world_harm("first") - ledger).max() < 1e-9


def test_script__of_which_a_row_is_renewed_remembers_the_others_as_they_were() -> None:
    running = Engine(OWN_GRID, 4, learners=(1,), scripts={0: Counting(), 2: eb.make_agent("full_brake")}, seed=1)
    for _ in range(4):
        running.step(np.zeros((4, 1)))
    made, wanted, packed = running.memories[0]["made"], running.wanted_mps2.copy(), running.packed.state.copy()
    running.renew(np.array([1]))
    expected = np.where(np.arange(4) == 1, decisions_before(running.packed.state[1, 0]), made)
    assert running.memories[0]["made"].tolist() == expected.tolist()
    others = [0, 2, 3]
    assert np.array_equal(running.wanted_mps2[others], wanted[others])
    assert np.array_equal(running.packed.state[others], packed[others])


def test_jerk__of_a_learner_is_counted_over_the_step_though_a_script_decides_within_it() -> None:
    runs = []
    for first in (Counting(), eb.make_agent("full_brake")):
        scripts = {0: first, 2: eb.make_agent("full_brake")}
        running = Engine(OWN_GRID, 3, learners=(1,), scripts=scripts, reward={"harm": 0.0, "jerk": 1.0}, seed=5)
        runs.append([running.step(np.full((3, 1), action)).further["jerk"][:, 1] for action in (-1.0, 0.5, -0.3, 1.0)])
    assert np.array_equal(*runs) and np.any(runs[0])


# ---------------------------------------------------------------- an obstacle ahead of Vehicle 1

ALL = eb.load_scenario("cooperation-4-all")
NEAR = ALL.replace(obstacle_gap_m={"uniform": [10, 45]})  # within the way of full braking in many worlds


def test_engine__steps_as_advance_does_and_its_ledger_counts_the_obstacle() -> None:
    running = make_engine(NEAR.replace(v2x="congested"), 60, seed=5, reward="total-harm")
    worlds, ledger = running.worlds, running.ledger
    rng, rewards = np.random.default_rng(2), np.zeros(60)
    for _ in range(70):
        going_on = ~running.ended
        step = running.step(rng.uniform(-1.0, -0.8, (60, 3)))
        until = np.where(going_on, running.worlds.time_s, worlds.time_s)
        worlds, impacts = eb.advance(worlds, running.wanted_mps2, until_s=until)
        ledger, rewards = ledger.add(impacts), rewards + step.reward[:, 0]
    assert np.array_equal(running.worlds.obstacle_gap_m, worlds.obstacle_gap_m)
    assert np.array_equal(running.worlds.obstacle_hit, worlds.obstacle_hit)
    for harm_count in HARM_COUNTS:
        assert np.array_equal(running.ledger.obstacle_harm(harm_count), ledger.obstacle_harm(harm_count))
        shares = running.ledger.vehicle_harm(harm_count)
        np.testing.assert_allclose(shares.sum(axis=1), running.ledger.world_harm(harm_count), rtol=1e-12)
    struck = running.ledger.obstacle_count > 0
    assert struck.sum() > 20 and not struck.all() and running.ledger.collided[struck].all()
    np.testing.assert_allclose(rewards, -running.ledger.world_harm("total"), rtol=1e-12)


# ---------------------------------------------------------------- snapshots

SCENARIO = eb.load_scenario("paper-random")
SHAPED = eb.RewardParams(harm=0.05, shaping=0.1, shaping_discount=0.99, terminal=0.5)


def steps_of(running: Engine, rng: np.random.Generator, steps: int) -> list[np.ndarray]:
    """Everything that ``steps`` random decisions show, new episodes included."""
    seen = []
    for _ in range(steps):
        step = running.step(rng.uniform(-1.0, 1.0, (running.n, len(running.learners))))
        seen += [step.reward, step.ended, running.wanted_mps2.copy()]
        running.renew(np.flatnonzero(step.ended))
        seen.append(running.observe_all(np.array(running.learners)))
    return seen


def with_script(script: str) -> eb.Scenario:
    roles = {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": script}
    return SCENARIO.replace(roles=roles, early_impacts="keep")


@pytest.mark.parametrize(
    ("scenario", "reward"),
    [
        (SCENARIO, SHAPED),
        (SCENARIO, "paper"),
        (SCENARIO.with_learners(["vehicle_2", "vehicle_3"]), SHAPED),
        (eb.load_scenario("cooperation-4-congested"), SHAPED),
        (eb.load_scenario("stress-wide"), "total-harm"),
        (
            eb.load_scenario("cooperation-2-paper").replace(
                early_impacts="keep", v2x={"preset": "congested", "persistence": "periodic"}
            ),
            "harm",
        ),
        (with_script("e_v2x_bm:pairwise"), "harm"),
    ],
)
@pytest.mark.parametrize("before", [0, 45])
def test_restore__the_next_steps_are_the_same_to_the_bit(scenario: eb.Scenario, reward: Any, before: int) -> None:
    check_restore(scenario, reward, before)


def check_restore(scenario: eb.Scenario, reward: Any, before: int) -> None:
    first = make_engine(scenario, 6, reward=reward, seed=3)
    rng = np.random.default_rng(0)
    steps_of(first, rng, before)
    kept = first.snapshot()
    copied = {name: array.copy() for name, array in kept.items()}
    drawn = rng.bit_generator.state
    expected = steps_of(first, rng, 50)
    assert all(np.array_equal(kept[name], copied[name]) for name in kept)  # a copy: the engine went on

    second = make_engine(scenario, 6, reward=reward, seed=99)
    steps_of(second, np.random.default_rng(5), 7)
    second.restore(kept)
    rng.bit_generator.state = drawn
    for k, (a, b) in enumerate(zip(expected, steps_of(second, rng, 50), strict=True)):
        assert np.array_equal(a, b), k
    for name, value in vars(first).items():
        if isinstance(value, np.ndarray):
            assert np.array_equal(value, vars(second)[name]), name


def test_restore__of_a_vec_env_returns_and_lengths_of_running_episodes_go_on() -> None:
    first, second = (eb.make_sb3_vec_env(SCENARIO, 6, seed=seed) for seed in (3, 8))
    first.reset()
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, (120, 6, 1)).astype(np.float32)
    for action in actions[:30]:
        first.step(action)
    second.restore(first.snapshot())
    ended = 0
    for action in actions[30:]:
        (*seen, infos), (*again, told) = first.step(action), second.step(action)
        assert all(np.array_equal(a, b) for a, b in zip(seen, again, strict=True))
        assert [info.get("episode") for info in infos] == [info.get("episode") for info in told]
        assert [info.keys() for info in infos] == [info.keys() for info in told]
        ended += int(seen[2].sum())
    assert ended > 5


def test_reward_terms__are_of_the_learners_where_another_vehicle_sets_the_grid():
    brake = eb.make_agent("full_brake")
    reward = {"harm": 0.0, "shaping": 1.0}
    engine = Engine(PAPER, 1, learners=(1,), scripts={0: brake, 2: brake}, deciders=(2,), reward=reward, seed=7)
    shaped = np.stack([engine.step(np.zeros((1, 1))).reward[0] for _ in range(3)])
    assert shaped[:, 1].all() and not shaped[:, [0, 2]].any()
