from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.agents import make_agent, optimise_coupled
from ethbrake_marl.agents.planner import BestHarm
from ethbrake_marl.agents.registry import drive
from ethbrake_marl.defaults import HARM_COUNTS
from ethbrake_marl.errors import CorruptBundle, InvalidInput, PhysicsError
from ethbrake_marl.evaluation.measures import TESTS
from ethbrake_marl.limits.limits import (
    LEFT_OUT,
    TABLES,
    BestHarmTable,
    best_harm,
    best_known,
    search_list,
    shipped_profiles,
    shipped_tables,
    task_problem,
)
from ethbrake_marl.physics import Floats, Worlds, advance, make_worlds
from ethbrake_marl.scenario import Scenario, Task, load_scenario
from ethbrake_marl.search import Profiles, profile_problem
from tests.failing_worlds import planted_list, without

BUDGET = 800


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario("paper-random")


@pytest.fixture(scope="module")
def worlds(scenario: Scenario) -> Worlds:
    return scenario.sample(12, seed=11).worlds


@pytest.fixture(scope="module")
def table(scenario: Scenario, worlds: Worlds) -> BestHarmTable:
    return best_harm(scenario, worlds, budget=BUDGET, threads=1)


def two_cars() -> Worlds:
    """Vehicle 1 stands 20 m ahead of vehicle 2 at 20 m/s, which can brake with 5 m/s2: w^2 = 400 - 2 * 5 * 20 = 200."""
    return make_worlds(
        [20.0], [0.0, 20.0], braking_capacity_mps2=5.0, driving_capacity_mps2=5.0, latency_s=0.0, mass_t=1.0,
        speed_limit_mps=40.0, restitution=0.0,
    )  # fmt: skip


def test_follow__hits_a_standing_car_with_the_closing_speed_computed_by_hand() -> None:
    problem = profile_problem(two_cars(), [1])
    first, total = problem.follow(problem.constant(np.array([[[-5.0]]])))
    assert first == pytest.approx([400.0 - 2 * 5 * 20])
    # 0.5 s of braking, then coasting: v^2 = 17.5^2 at the wall
    half = Profiles(np.array([[5, 80]]), np.array([[[-5.0], [0.0]]]))
    assert problem.follow(half)[0] == pytest.approx([17.5**2])
    assert total[0] >= first[0]


def test_search__cannot_beat_full_braking_before_a_standing_car() -> None:
    problem = profile_problem(two_cars(), [1])
    start = problem.constant(np.array([[[2.0]]]))
    _, harm = problem.search(start, budget=2000)
    assert harm["first"] == pytest.approx([200.0], abs=1e-3)


def test_profiles__say_which_command_is_in_force() -> None:
    profile = Profiles(np.array([[3, 5, 5]]), np.array([[[-1.0], [2.0], [9.0]]]))
    at = [float(profile.at(np.array([step]))[0, 0]) for step in (0, 2, 3, 4)]
    assert at == [-1.0, -1.0, 2.0, 2.0]


def test_best_harm__is_never_worse_than_the_best_constant_deceleration(
    scenario: Scenario, worlds: Worlds, table: BestHarmTable
) -> None:
    for harm_count in HARM_COUNTS:
        constant = optimise_coupled(worlds, 1, harm_count=harm_count).harm
        assert (table.best[harm_count].harm <= constant + 1e-7).all()
        assert table.best[harm_count].harm.mean() < 0.7 * constant.mean()


def test_best_harm__does_not_depend_on_batch_order_or_threads(
    scenario: Scenario, worlds: Worlds, table: BestHarmTable
) -> None:
    rows = np.array([7, 2, 10])
    part = best_harm(scenario, worlds.take(rows), budget=BUDGET, threads=2)
    for harm_count in HARM_COUNTS:
        assert np.array_equal(part.best[harm_count].harm, table.best[harm_count].harm[rows])
        assert np.array_equal(
            part.best[harm_count].profiles.commands_mps2, table.best[harm_count].profiles.commands_mps2[rows]
        )


def test_best_harm__another_seed_searches_elsewhere(scenario: Scenario, worlds: Worlds, table: BestHarmTable) -> None:
    other = best_harm(scenario, worlds, budget=BUDGET, threads=1, seed=1, counts=["first"])
    assert not np.array_equal(other.best["first"].harm, table.best["first"].harm)


def test_best_harm__starts_from_what_is_known_and_never_gets_worse(
    scenario: Scenario, worlds: Worlds, table: BestHarmTable
) -> None:
    again = best_harm(scenario, worlds, budget=100, threads=1, seed=2, known=table)
    for harm_count in HARM_COUNTS:
        assert (again.best[harm_count].harm <= table.best[harm_count].harm + 1e-6).all()
    assert again.header["after"]["budget"] == BUDGET


def test_best_harm__two_vehicles_together_are_not_worse_than_one_of_them(
    scenario: Scenario, worlds: Worlds, table: BestHarmTable
) -> None:
    few = worlds.take(np.arange(4))
    alone = best_harm(scenario, few, counts=["first"], budget=200, threads=1).best["first"].harm
    joint = best_harm(scenario, few, counts=["first"], vehicles=(0, 1), budget=200, threads=1)
    assert (joint.best["first"].harm <= alone + 1e-6).all()
    assert joint.best["first"].harm.sum() < 0.9 * alone.sum()
    assert joint.best["first"].profiles.commands_mps2.shape[2] == 2
    assert np.array_equal(
        task_problem(few, Task(scenario, (0, 1))).follow(joint.best["first"].profiles)[0], joint.best["first"].harm
    )


def test_best_harm__joint_optimum_of_two_cars_by_hand() -> None:
    """Vehicle 2 alone cannot do better than 400 - 2 * 5 * 20; vehicle 1 drives away with 4: 400 - 2 * (5 + 4) * 20."""
    scenario = Scenario(
        name="two", vehicles=2, gaps_m=20.0, speeds_mps=[0.0, 20.0], braking_capacity_mps2=5.0,
        driving_capacity_mps2=[4.0, 5.0], mass_t=1.0, latency_s=0.0, restitution=0.0,
        roles={"vehicle_2": "learner"},
    )  # fmt: skip
    worlds = scenario.sample(1, seed=1).worlds
    for vehicles, harm in (((1,), 200.0), ((0,), 40.0), ((0, 1), 40.0)):
        found = best_harm(scenario, worlds, vehicles=vehicles, budget=1000, threads=1)
        for harm_count in HARM_COUNTS:
            assert found.best[harm_count].harm == pytest.approx([harm], abs=1e-2), (vehicles, harm_count)


def test_stored_profile__driven_in_the_engine_does_the_stored_harm_bit_for_bit(
    scenario: Scenario, worlds: Worlds, table: BestHarmTable, tmp_path: Path
) -> None:
    table.save(tmp_path / "t.npz")
    kept = BestHarmTable.load(tmp_path / "t.npz")
    for harm_count in HARM_COUNTS:
        agent = BestHarm(
            lambda problem, c: kept.profiles(problem.identity, c, problem.last_step), harm_count=harm_count
        )
        shuffled = np.random.default_rng(0).permutation(worlds.n)
        episodes = drive(worlds.take(shuffled), agent, scenario, 1)
        assert np.array_equal(episodes.ledger.world_harm(harm_count), table.best[harm_count].harm[shuffled])
        assert np.array_equal(episodes.memories[1]["predicted_harm"], table.best[harm_count].harm[shuffled])
        assert not episodes.memories[1]["searched"].any()


def test_best_harm_agent__searches_a_world_that_no_table_holds(scenario: Scenario, worlds: Worlds) -> None:
    few = worlds.take(np.arange(3))
    agent = BestHarm(lambda problem, c: (Profiles(problem.last_step[:, None], np.zeros((problem.n, 1, 1))),
                                         np.zeros(problem.n, np.bool_)), budget=300)  # fmt: skip
    episodes = drive(few, agent, scenario, 1)
    memory = episodes.memories[1]
    assert memory["searched"].all()
    assert np.array_equal(episodes.ledger.world_harm("first"), memory["predicted_harm"])
    assert (memory["predicted_harm"] <= optimise_coupled(few, 1).harm + 1e-7).all()


def test_table__finds_worlds_by_what_they_are(scenario: Scenario, worlds: Worlds, table: BestHarmTable) -> None:
    order = np.random.default_rng(1).permutation(worlds.n)
    identity = task_problem(worlds.take(order), Task(scenario, scenario.learners)).identity
    assert np.array_equal(table.harm(identity, "total"), table.best["total"].harm[order])


@pytest.mark.parametrize("change", ["gap", "mass", "horizon", "time step", "others", "vehicle"])
def test_table__does_not_know_a_world_that_differs_in_anything(
    scenario: Scenario, worlds: Worlds, table: BestHarmTable, change: str
) -> None:
    vehicles: tuple[int, ...] = (1,)
    if change == "gap":
        worlds = replace(worlds, gaps_m=worlds.gaps_m + np.array([0.0, 1e-12]))
    elif change == "mass":
        worlds = replace(worlds, vehicles=replace(worlds.vehicles, mass_t=worlds.vehicles.mass_t * 1.1))
    elif change == "horizon":
        scenario = scenario.replace(horizon_s=7.9)
    elif change == "time step":
        scenario = scenario.replace(time_step_s=0.05)
    elif change == "others":
        scenario = scenario.replace(roles={**scenario.roles, "vehicle_3": "constant:5"})
    else:
        vehicles = (2,)
    assert np.isnan(table.harm(task_problem(worlds, Task(scenario, vehicles)).identity, "first")).all()


def test_improved__takes_only_what_undercuts_by_more_than_the_tolerance(table: BestHarmTable) -> None:
    harm = table.best["first"].harm.copy()
    hit = np.flatnonzero(harm > 1.0)[:2]
    harm[hit[0]] -= 0.5
    harm[hit[1]] -= 5e-7
    better, where = table.improved(table.identity, "first", harm)
    assert np.flatnonzero(where).tolist() == [hit[0]]
    assert better.best["first"].harm[hit[0]] == harm[hit[0]]
    assert better.best["first"].harm[hit[1]] == table.best["first"].harm[hit[1]]
    _, known = better.profiles(table.identity, "first", np.full(len(harm), 75))
    assert not known[hit[0]] and known.sum() == len(harm) - 1
    with pytest.raises(InvalidInput, match="harms for"):
        table.improved(table.identity[:2], "first", harm)


def test_search_list__goes_on_where_it_stopped(
    scenario: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ethbrake_marl.limits.limits.CHUNK", 3)
    sample = scenario.sample(6, seed=11)
    kept = tmp_path / "parts"
    seen: list[tuple[int, int]] = []

    def stop_after_one(done: int, total: int) -> None:
        seen.append((done, total))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        search_list(scenario, sample, budget=50, threads=1, chunks=kept, on_progress=stop_after_one)
    assert seen == [(3, 6)]
    (first,) = kept.iterdir()
    stamp = first.stat().st_mtime_ns
    whole = search_list(scenario, sample, budget=50, threads=1, chunks=kept)
    assert first.stat().st_mtime_ns == stamp
    alone = best_harm(scenario, sample.worlds, budget=50, threads=1)
    assert np.array_equal(whole.best["first"].harm, alone.best["first"].harm)
    assert np.array_equal(whole.identity, alone.identity)
    search_list(scenario, sample, budget=60, threads=1, chunks=kept)  # another question: nothing is taken
    assert first.stat().st_mtime_ns != stamp


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"vehicles": ()}, "at least one is needed"),
        ({"vehicles": (1, 1)}, "each once"),
        ({"vehicles": (3,)}, "from 0 to 2"),
        ({"budget": 0}, "budget = 0"),
        ({"threads": 0}, "threads = 0"),
        ({"counts": ()}, "first, total, or both"),
        ({"counts": ("all",)}, "first, total, or both"),
    ],
)
def test_best_harm__refuses(scenario: Scenario, worlds: Worlds, arguments: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        best_harm(scenario, worlds.take([0]), **{"budget": 10, "threads": 1, **arguments})  # type: ignore[arg-type]


def test_profiles__beyond_a_capacity_or_out_of_order_are_refused(worlds: Worlds) -> None:
    problem = profile_problem(worlds.take([0]), [1])
    with pytest.raises(InvalidInput, match="beyond"):
        problem.follow(problem.constant(np.array([[[-7.1]]])))
    with pytest.raises(InvalidInput, match="in order"):
        problem.follow(Profiles(np.array([[9, 5, 75]]), np.zeros((1, 3, 1))))
    with pytest.raises(InvalidInput, match="in order"):
        problem.follow(Profiles(np.array([[9]]), np.zeros((1, 1, 1))))


@pytest.mark.parametrize("content", [b"no table", b""])
def test_table__a_damaged_file_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "t.npz").write_bytes(content)
    with pytest.raises(CorruptBundle, match="not a table"):
        BestHarmTable.load(tmp_path / "t.npz")
    with pytest.raises(InvalidInput, match="there is no such table"):
        BestHarmTable.load(tmp_path / "other.npz")


def test_shipped_tables__hold_the_shipped_lists_and_their_profiles_do_the_stored_harm() -> None:
    assert shipped_tables(), f"no table in {TABLES}"
    long = [(name, 10_000) for name in (*TESTS, "paper-random-early", "paper-distance")]
    for name, n in [*long, ("paper-delay-low", 2000), ("paper-delay-high", 2000)]:
        scenario = load_scenario(name)
        for first in (0, n - 5):
            worlds = scenario.sample(5, seed=7, first=first).worlds
            for harm_count in HARM_COUNTS:
                known = best_known(worlds, Task(scenario, scenario.learners))[harm_count]
                assert np.isfinite(known).all()
                problem = profile_problem(worlds, [1], harm_count=harm_count)
                profiles, found = shipped_profiles(problem, harm_count)
                harm = problem.follow(profiles)[harm_count == "total"]
                assert np.array_equal(harm[found], known[found])
                assert (known <= optimise_coupled(worlds, 1, harm_count=harm_count).harm + 1e-7).all()
    assert max(path.stat().st_size for path in TABLES.glob("*.npz")) < 700_000


def test_best_known__is_nan_where_no_table_holds_the_world(scenario: Scenario) -> None:
    known = best_known(scenario.sample(2, seed=8).worlds, Task(scenario, scenario.learners))["first"]
    assert np.isnan(known).all()


def test_make_agent__knows_best_harm(scenario: Scenario) -> None:
    from ethbrake_marl.evaluation.inputs import make_lineup

    (agent,) = make_lineup(["best_harm:50"], scenario).values()
    assert isinstance(agent, BestHarm)
    with pytest.raises(InvalidInput, match="number of candidates"):
        make_lineup(["best_harm:many"], scenario)
    assert make_agent("planner:8").name == "planner:8"


def _realised(worlds: Worlds, command: Floats) -> Floats:
    _, impacts = advance(worlds, command, until_s=8.0)
    return impacts.first_impact_harm.sum(axis=1)


def test_follow__phase_by_phase_agrees_with_advance_over_long_segments(worlds: Worlds) -> None:
    problem = profile_problem(worlds, [1])
    constants = np.linspace(-7.0, 3.0, worlds.n)
    command = -worlds.vehicles.braking_capacity_mps2
    command[:, 1] = constants
    first, _ = problem.follow(problem.constant(constants[:, None, None]))
    assert first == pytest.approx(_realised(worlds, command), abs=1e-7)


def test_even_grid__ends_at_the_capacities_to_the_bit() -> None:
    low, high = -4.0, 1.2
    assert low + (high - low) > high  # an ulp beyond what the vehicle has
    worlds = replace_capacities(two_cars(), braking=-low, driving=high)
    grid = profile_problem(worlds, [1]).even_grid(5)
    assert grid[0, [0, -1], 0].tolist() == [low, high]
    assert grid[0, :, 0] == pytest.approx([-4.0, -2.7, -1.4, -0.1, 1.2])


def replace_capacities(worlds: Worlds, *, braking: float, driving: float) -> Worlds:
    full = np.ones(worlds.speeds_mps.shape)
    vehicles = replace(worlds.vehicles, braking_capacity_mps2=braking * full, driving_capacity_mps2=driving * full)
    return replace(worlds, vehicles=vehicles)


@pytest.mark.parametrize("vehicles", [(1,), (0, 1)])
def test_best_harm__searches_where_the_capacities_differ_by_an_ulp_too_much(
    scenario: Scenario, worlds: Worlds, vehicles: tuple[int, ...]
) -> None:
    rounded = replace_capacities(worlds, braking=4.0, driving=1.2)
    table = best_harm(scenario, rounded, counts=["first"], vehicles=vehicles, budget=100, threads=1)
    assert np.isfinite(table.best["first"].harm).all()


def test_planner__starts_from_capacities_that_differ_by_an_ulp_too_much(scenario: Scenario, worlds: Worlds) -> None:
    rounded = replace_capacities(worlds, braking=4.0, driving=1.2)
    assert np.isfinite(drive(rounded, make_agent("planner:8"), scenario, 1).ledger.world_harm("first")).all()


def test_search_list__leaves_a_world_out_that_cannot_be_advanced(scenario: Scenario, tmp_path: Path) -> None:
    sample = planted_list(scenario, 5, 11, [1, 3])
    found = search_list(scenario, sample, budget=100, threads=1, chunks=tmp_path)
    assert sorted(found.header[LEFT_OUT]) == ["1", "3"]
    assert "a contact was missed" in found.header[LEFT_OUT]["3"]
    rows = without(5, [1, 3])
    alone = best_harm(scenario, sample.worlds.take(rows), budget=100, threads=1)
    assert np.array_equal(found.identity, alone.identity)
    assert np.array_equal(found.best["total"].harm, alone.best["total"].harm)
    again = search_list(scenario, sample, budget=100, threads=1, chunks=tmp_path, known=None)
    assert again.header == found.header and np.array_equal(again.best["first"].harm, found.best["first"].harm)
    with pytest.raises(PhysicsError, match="world 1: a contact was missed"):
        search_list(scenario, replace(sample, worlds=sample.worlds.take([1]), index=np.array([1])), budget=100)
