"""The engine: a reset or renewal that fails leaves everything as it was; worlds start at the alert."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.engine import Engine, Stream
from ethbrake_marl.envs.interfaces import make_engine
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Worlds, advance
from ethbrake_marl.scenario import load_scenario

PAPER = load_scenario("paper-random").replace(early_impacts="keep")


def engine(n=2, third=None, seed=0, first=None):
    scripts = {0: first or make_agent("full_brake"), 2: third or make_agent("constant:5")}
    return Engine(PAPER, n, learners=(1,), scripts=scripts, seed=seed)


def state(running):
    packed = running.packed
    return [packed.state.tolist(), packed.params.tolist(), running.wanted_mps2.tolist(), running.ended.tolist()]


def too_weak(n):
    """Worlds in which vehicle 3 cannot brake with 5 m/s2."""
    given = {"gaps_m": 3, "braking_capacity_mps2": 4, "speeds_mps": 20}
    return PAPER.worlds_from_state(given).take(np.zeros(n, np.int64))


class Remembering:
    """Brakes with 5 m/s2, asked at every step; refuses to begin when told so."""

    name = "remembering"
    refuses = False

    def begin(self, alert, vehicle, scripts):
        if self.refuses:
            raise InvalidInput("remembering: will not begin")
        return None

    def act(self, worlds, memory, vehicle):
        return np.full(worlds.n, -5.0), memory


@pytest.mark.parametrize("first", [None, Remembering()])
def test_reset__that_fails_leaves_the_running_episodes_alone(first):
    running, twin = engine(first=first), engine(first=first)
    for one in (running, twin):
        one.step({1: np.zeros(2)})
    before = state(running)
    with pytest.raises(InvalidInput, match=r"constant:5|vehicle_1"):
        running.reset(seed=9, worlds=too_weak(2))
    assert state(running) == before
    assert running.seed == 0
    running.step({1: np.zeros(2)})
    twin.step({1: np.zeros(2)})
    assert state(running) == state(twin)
    running.reset()
    twin.reset()
    assert state(running) == state(twin)


def test_renew__that_fails_leaves_the_running_episodes_and_the_stream_alone():
    script = Remembering()
    running, twin = engine(third=script), engine(third=Remembering())
    before = state(running)
    script.refuses = True
    with pytest.raises(InvalidInput, match="will not begin"):
        running.renew(np.array([1]))
    assert state(running) == before
    script.refuses = False
    running.renew(np.array([1]))
    twin.renew(np.array([1]))
    assert state(running) == state(twin)


def test_renew__a_watcher_that_fails_leaves_the_running_episodes_alone():
    running = engine()
    before = state(running)

    class Refusing:
        def begun(self, memory, alert, rows):
            raise InvalidInput("watcher: no")

    running.watch(Refusing(), None)
    for start in (lambda: running.renew(np.array([0])), running.reset):
        with pytest.raises(InvalidInput, match="watcher"):
            start()
        assert state(running) == before


def test_renew__leaves_what_the_other_rows_wanted():
    class ByTheClock(Remembering):
        def act(self, worlds, memory, vehicle):
            return -worlds.time_s, memory

    running = engine(third=ByTheClock())
    running.step({1: np.zeros(2)})
    wanted = running.wanted_mps2.copy()
    running.renew(np.array([1]))
    assert running.wanted_mps2[0].tolist() == wanted[0].tolist()
    assert running.wanted_mps2[1, 2] == 0.0


def test_reset__takes_worlds_at_the_alert_only():
    worlds = PAPER.sample(2, 0).worlds
    late, _ = advance(worlds, -worlds.vehicles.braking_capacity_mps2, until_s=[0.0, 0.3])
    with pytest.raises(InvalidInput, match=r"world 1 is at 0.3 s; episodes start at the alert"):
        engine().reset(worlds=late)
    worlds.pair_hit[0, 1] = True
    with pytest.raises(InvalidInput, match="world 0 is after an impact"):
        engine().reset(worlds=worlds)


def test_stream__gives_every_world_of_its_list_once_and_in_order_across_its_blocks():
    scripts = {0: make_agent("full_brake"), 2: make_agent("constant:5")}
    stream = Stream(PAPER, [1], scripts, seed=4)
    taken = Worlds.concatenate([stream.take(count).alert for count in (1000, 100, 3000, 50)])
    expected = PAPER.sample(4150, 4, channel="training").worlds
    assert (taken.gaps_m == expected.gaps_m).all() and (taken.speeds_mps == expected.speeds_mps).all()


@pytest.mark.parametrize(
    ("horizon_s", "latency_s", "steps"), [(8.0, 0.5, 75), (3.0, 0.65, 24), (3.0, 2.3, 7), (8.0, 5.1, 29)]
)
def test_horizon__is_reached_after_as_many_steps_as_fit(horizon_s, latency_s, steps):
    scenario = PAPER.replace(horizon_s=horizon_s, latency_s=[0, latency_s, latency_s], gaps_m=100, speeds_mps=30)
    scripts = {0: make_agent("coast"), 2: make_agent("coast")}
    running = Engine(scenario, 1, learners=(1,), scripts=scripts)
    ended = [bool(running.step(np.zeros((1, 1))).truncated[0]) for _ in range(steps)]
    assert ended == [False] * (steps - 1) + [True]
    assert running.worlds.time_s.tolist() == [horizon_s]


def test_ended__rows_are_paid_nothing_until_they_are_renewed():
    reward = {"harm": 1.0, "risk": 1.0, "jerk": 1.0, "terminal": 5.0, "shaping": 1.0}
    running = make_engine("paper-random", 20, seed=1, reward=reward)
    rng = np.random.default_rng(0)
    paid_after = np.zeros(20)
    for _ in range(80):
        over = running.ended
        paid = running.step(rng.uniform(-1.0, 1.0, (20, 1))).reward
        assert (paid[over] == 0.0).all() and (paid[~over] != 0.0).any(axis=1).all()
        paid_after[over] += 1
    assert (paid_after > 0).all()


class Counting:
    """Brakes with 5 m/s2 plus a little for each decision it has made; notes when it made them."""

    name = "counting"

    def __init__(self, adds=0.1):
        self.adds = adds

    def begin(self, alert, vehicle, scripts):
        return {"made": np.zeros(alert.n, np.int64), "asked_s": np.zeros((alert.n, 99))}

    def act(self, worlds, memory, vehicle):
        memory["asked_s"][np.arange(worlds.n), memory["made"]] = worlds.time_s  # its own copy
        memory["made"] += 1
        return -5.0 - self.adds * (memory["made"] % 7), memory


OWN_GRID = PAPER.replace(latency_s=[0.03, {"uniform": [0.2, 0.7]}, 0.55], horizon_s=3.0)


@pytest.mark.parametrize("learners", [(1,), (2,), (1, 2), ()])
def test_script__decides_on_its_own_grid_whoever_learns(learners):
    worlds = OWN_GRID.sample(5, 3).worlds
    others = {i: make_agent("full_brake") for i in (1, 2) if i not in learners}
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
    scripts = {0: Counting(), 1: make_agent("full_brake"), 2: make_agent("full_brake")}
    alone = Engine(OWN_GRID, 5, learners=(), scripts=scripts, deciders=(0,), worlds=worlds)
    while not alone.ended.all():
        alone.step({})
    assert np.abs(alone.ledger.world_harm("first") - ledger).max() < 1e-9


def decisions_before(end_s):
    return int(np.ceil((end_s - 0.03) / 0.1 - 1e-9))


def test_script__of_which_a_row_is_renewed_remembers_the_others_as_they_were():
    scripts = {0: Counting(), 2: make_agent("full_brake")}
    running = Engine(OWN_GRID, 4, learners=(1,), scripts=scripts, seed=1)
    for _ in range(4):
        running.step(np.zeros((4, 1)))
    made, wanted, packed = running.memories[0]["made"], running.wanted_mps2.copy(), running.packed.state.copy()
    running.renew(np.array([1]))
    start_s = running.packed.state[1, 0]
    expected = np.where(np.arange(4) == 1, decisions_before(start_s), made)
    assert running.memories[0]["made"].tolist() == expected.tolist()
    for row in (0, 2, 3):
        assert running.wanted_mps2[row].tolist() == wanted[row].tolist()
        assert running.packed.state[row].tolist() == packed[row].tolist()


def test_script__that_never_changes_its_mind_changes_no_bit():
    runs = []
    for third in (Counting(adds=0.0), make_agent("constant:5")):
        running = Engine(OWN_GRID, 20, learners=(1,), scripts={0: make_agent("full_brake"), 2: third}, seed=5)
        rng = np.random.default_rng(0)
        runs.append([running.step(rng.uniform(-1.0, 1.0, (20, 1))).reward for _ in range(20)])
        runs[-1] += [running.worlds.gaps_m, running.worlds.speeds_mps, running.ledger.total_harm]
    assert all(np.array_equal(a, b) for a, b in zip(*runs, strict=True))


def test_jerk__of_a_learner_is_counted_over_the_step_though_a_script_decides_within_it():
    runs = []
    for first in (Counting(), make_agent("full_brake")):
        scripts = {0: first, 2: make_agent("full_brake")}
        running = Engine(OWN_GRID, 3, learners=(1,), scripts=scripts, reward={"harm": 0.0, "jerk": 1.0}, seed=5)
        runs.append([running.step(np.full((3, 1), action)).further["jerk"][:, 1] for action in (-1.0, 0.5, -0.3, 1.0)])
    assert np.array_equal(*runs) and np.any(runs[0])
