"""Tables of best known harm: the shipped ones hold what they say, and a damaged one is refused."""

import io
import json
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.counts import HarmCount
from ethbrake_marl.errors import CorruptBundle
from ethbrake_marl.extensions.search import best_harm as searching
from ethbrake_marl.extensions.search.pricing import Problem, problem_of
from ethbrake_marl.extensions.search.tables import BestHarmTable, best_stored, outdated_tables, shipped_tables
from ethbrake_marl.motion.digest import physics_digest
from tests.refused import refused

SCENARIO, GAME = eb.open_game("paper-random")

best_harm = partial(searching.best_harm, harm_counts=("first", "total"))
MEANS = {  # harm of docs/least-harm.md, m2/s2: first-impact, total
    "cooperation-2-blocked": (16.609, 16.718), "cooperation-2-five": (11.554, 11.640),
    "paper-delay-high": (21.930, 22.089), "paper-delay-low": (0.160, 0.162), "paper-delay-middle": (1.915, 1.938),
    "paper-distance": (1.044, 1.063), "paper-random": (6.427, 6.482), "paper-random-brake-only": (7.891, 7.960),
    "paper-random-early": (3.091, 3.150), "paper-random-obstacle": (22.219, 31.504),
    "realistic-mixed": (4.609, 4.707),
    "realistic-motorway": (0.933, 0.933), "stress-wide": (50.652, 54.413),
}  # fmt: skip

COSTS = {  # honest cost of docs/results/benchmark.md, m2/s2
    "benchmark-all": 0.286, "benchmark-blocked": 36.837, "benchmark-five": 0.386, "benchmark-noisy": 19.252,
    "benchmark-pair": 14.211, "benchmark-truck": 16.483,
}  # fmt: skip


@cache
def sampled() -> eb.State:
    return SCENARIO.sample(8, seed=11)


@cache
def paper() -> Problem:
    return problem_of(GAME, sampled())


@pytest.fixture(scope="module")
def table() -> BestHarmTable:
    return best_harm(GAME, sampled(), budget=100, threads=1)


@pytest.mark.parametrize("name", MEANS)
def test_shipped__hold_the_first_worlds_of_their_list_with_the_harm_of_their_profiles(name: str) -> None:
    (table,) = (each for each in shipped_tables() if each.header["scenario"] == name)
    scenario, game = eb.open_game(name)
    problem = problem_of(game, scenario.sample(40, seed=table.header["list_seed"]))
    assert table.rows(problem.identity).tolist() == [*range(40)] and table.header["episodes"] == len(table.identity)
    for count, mean in zip(("first", "total"), MEANS[name], strict=True):
        assert table.harm[count].mean() == pytest.approx(mean, abs=6e-4)
        harm, profiles = table.stored(problem, HarmCount.of(count))
        assert problem.values(profiles)[count] == pytest.approx(harm, abs=1e-9)
        known, best = best_stored(problem, HarmCount.of(count))
        assert (known <= harm).all() and problem.values(best)[count] == pytest.approx(known, abs=1e-9)


@pytest.mark.parametrize("name", COSTS)
def test_shipped__of_a_task_have_the_honest_cost_alone(name: str) -> None:
    (table,) = (each for each in shipped_tables() if each.header["scenario"] == name)
    scenario, game = eb.open_game(name)
    problem = problem_of(game, scenario.sample(40, seed=7))
    assert table.rows(problem.identity).tolist() == [*range(40)] and len(table.identity) == 2000
    assert {*table.harm} == {"honest"} and table.harm["honest"].mean() == pytest.approx(COSTS[name], abs=6e-4)
    cost, profiles = table.stored(problem, HarmCount.of("honest"))
    assert problem.values(profiles)["honest"] == pytest.approx(cost, abs=1e-9)
    limits = eb.evaluate(name, "full_brake", episodes=40, measures="limits", harm_count="honest")["full_brake"]
    assert (limits["best_known_honest"] <= cost).all() and "best_known_first" not in limits  # of all tables the least


def test_shipped__are_for_this_physics_as_new_ones_are(table: BestHarmTable) -> None:
    renew = (
        "after a change of motion/ that keeps the bits: python docs/studies/best_harm.py --restamp (docs/physics.md)"
    )
    assert outdated_tables() == {} and len(shipped_tables()) == len(MEANS | COSTS), renew
    assert table.header["physics"] == physics_digest()


def test_shipped__are_not_used_under_another_impact_law(other_law: str) -> None:
    scenario, game = eb.open_game("paper-random")
    problem = problem_of(game, scenario.sample(5, seed=7))
    assert shipped_tables() == () and np.isinf(best_stored(problem, HarmCount.of("first"))[0]).all()
    assert outdated_tables().keys() == (MEANS | COSTS).keys()
    assert outdated_tables()["paper-random"].endswith(f"than this installation's ({other_law!r})")


def test_best_known__of_no_table_is_infinite_and_coasting() -> None:
    harm, profiles = best_stored(paper(), HarmCount.of("first"))
    assert np.isinf(harm).all() and not profiles.commands_mps2.any()
    paper().check(profiles)


def test_stored__where_a_table_holds_some_of_the_worlds(table: BestHarmTable) -> None:
    problem = problem_of(GAME, eb.State.join([SCENARIO.sample(2, seed=12), sampled().take([5])]))
    harm, profiles = table.stored(problem, HarmCount.of("total"))
    assert harm.tolist() == [np.inf, np.inf, table.harm["total"][5]]
    assert not profiles.commands_mps2[:2].any() and problem.values(profiles)["total"][2] == harm[2]


def test_save__and_load_are_the_same(table: BestHarmTable, tmp_path: Path) -> None:
    table.save(tmp_path / "t.npz")
    again = BestHarmTable.load(tmp_path / "t.npz")
    assert again.content() == table.content() and again.header == table.header
    for count in ("first", "total"):
        assert paper().values(again.profiles[count])[count].tolist() == table.harm[count].tolist()


def changed(**arrays: Callable[[Any], Any]) -> Callable[[BestHarmTable], bytes]:
    def content(table: BestHarmTable) -> bytes:
        with np.load(io.BytesIO(table.content())) as archive:
            members = {**archive, **{name: change(archive[name]) for name, change in arrays.items()}}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **{name: array for name, array in members.items() if array is not None})
        return buffer.getvalue()

    return content


def header(**entries: Any) -> Callable[[BestHarmTable], bytes]:
    return changed(header=lambda old: np.frombuffer(json.dumps(entries).encode(), np.uint8))


DAMAGED: dict[str, Callable[[BestHarmTable], bytes]] = {
    "header: must be an object with the entry format: 2": header(format=1),
    "first_harm: must be finite and at least 0 m2/s2": changed(first_harm=lambda harm: harm * np.nan),
    "total_harm: must be finite and at least 0 m2/s2": changed(total_harm=lambda harm: harm - 99.0),
    "first_commands: must be finite": changed(first_commands=lambda commands: commands + np.inf),
    "arrays of total: their shapes (8,), (7, ": changed(total_ends=lambda ends: ends[1:]),
    "first_ends: must not decrease within a world": changed(first_ends=lambda ends: ends[:, ::-1]),
    "total_ends: must not decrease within a world, and end above 0": changed(total_ends=np.zeros_like),
    "array 'total_commands': must not be in this file": changed(total_harm=lambda harm: None),
    "array 'identity': has type int32": changed(identity=lambda identity: identity.astype(np.int32)),
    "is not a table of best known harm": lambda table: table.content()[:-40],
}


@pytest.mark.parametrize("message", DAMAGED)
def test_load__refuses_what_is_no_table(table: BestHarmTable, tmp_path: Path, message: str) -> None:
    (tmp_path / "t.npz").write_bytes(DAMAGED[message](table))
    with refused(message, CorruptBundle):
        BestHarmTable.load(tmp_path / "t.npz")


def test_load__refuses_a_missing_file(tmp_path: Path) -> None:
    with refused("there is no such file; give the file of a table"):
        BestHarmTable.load(tmp_path / "t.npz")


def test_meanings__of_regret_and_of_the_share_differ() -> None:
    told = eb.summarise(eb.evaluate("paper-random", "full_brake,best_harm", episodes=20, measures="limits")).meanings()
    assert told["Regret, first-impact harm"].startswith("Harm (or honest cost) minus the least known")
    assert told["Share of possible, first-impact harm"].startswith("How much of what the best known braking saves")
    assert "Regret, honest cost" in told


def test_limits__of_the_honest_cost_have_columns_if_agents_minimise_it() -> None:
    result = eb.evaluate("paper-random", "full_brake,best_harm", episodes=20, measures="limits", harm_count="honest")
    table = eb.summarise(result)
    braking, best = table
    assert "regret_honest" in table.sheet().names and best["share_of_possible_reduction_honest"].value == 1.0
    cost = braking["honest_cost"].value - braking["best_known_honest"].value
    assert braking["regret_honest"].value == pytest.approx(cost) and cost > 1.0
