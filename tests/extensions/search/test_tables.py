"""Tables of best known harm: the shipped ones hold what they say, and a damaged one is refused."""

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.errors import CorruptBundle
from ethbrake_marl.extensions.search.best_harm import best_harm, lowered
from ethbrake_marl.extensions.search.pricing import problem_of
from ethbrake_marl.extensions.search.tables import SHIPPED, BestHarmTable, best_known, shipped_tables
from tests.refused import refused

SCENARIO, GAME = eb.open_game("paper-random")
WORLDS = SCENARIO.sample(8, seed=11)
PROBLEM = problem_of(GAME, WORLDS)

MEANS = {  # harm of docs/results/best-harm.md, m2/s2: first-impact, total
    "cooperation-2-blocked": (16.610, 16.722), "cooperation-2-five": (11.555, 11.641),
    "paper-delay-high": (21.935, 22.093), "paper-delay-low": (0.160, 0.163), "paper-delay-middle": (1.916, 1.938),
    "paper-distance": (1.046, 1.065), "paper-random": (6.436, 6.489), "paper-random-brake-only": (7.906, 7.972),
    "paper-random-early": (3.095, 3.154), "paper-random-obstacle": (22.900, 36.290),
    "realistic-mixed": (11.333, 11.480),
    "realistic-motorway": (6.388, 6.426), "stress-wide": (50.670, 54.423),
}  # fmt: skip


@pytest.fixture(scope="module")
def table() -> BestHarmTable:
    return best_harm(GAME, WORLDS, budget=100, threads=1)


def test_shipped__all_of_them() -> None:
    assert {each.header["scenario"] for each in shipped_tables()} == {*MEANS}


@pytest.mark.parametrize("table", shipped_tables(), ids=lambda table: table.header["scenario"])
def test_shipped__hold_the_first_worlds_of_their_list_with_the_harm_of_their_profiles(table: BestHarmTable) -> None:
    scenario, game = eb.open_game(table.header["scenario"])
    problem = problem_of(game, scenario.sample(40, seed=table.header["list_seed"]))
    assert table.rows(problem.identity).tolist() == [*range(40)] and table.header["episodes"] == len(table.identity)
    for count, mean in zip(("first", "total"), MEANS[scenario.name], strict=True):
        assert table.harm[count].mean() == pytest.approx(mean, abs=6e-4)
        harm, profiles = table.stored(problem, count)
        assert problem.values(profiles)[count] == pytest.approx(harm, abs=1e-9)
        known, best = best_known(problem, count)
        assert (known <= harm).all() and problem.values(best)[count] == pytest.approx(known, abs=1e-9)


def test_best_known__of_no_table_is_missing() -> None:
    harm, profiles = best_known(PROBLEM, "first")
    assert np.isnan(harm).all() and not profiles.commands_mps2.any()
    PROBLEM.check(profiles)


def test_save__and_load_are_the_same(table: BestHarmTable, tmp_path: Path) -> None:
    table.save(tmp_path / "t.npz")
    again = BestHarmTable.load(tmp_path / "t.npz")
    assert again.content() == table.content() and again.header == table.header
    for count in ("first", "total"):
        assert PROBLEM.values(again.profiles[count])[count].tolist() == table.harm[count].tolist()
    first = shipped_tables()[0]
    assert (
        BestHarmTable.load(SHIPPED / "cooperation-2-blocked.npz").harm["total"].tolist() == first.harm["total"].tolist()
    )


def test_lowered__takes_what_agents_do_better_and_says_so(table: BestHarmTable) -> None:
    worse = {count: harm + 1.0 * (np.arange(8) % 2) for count, harm in table.harm.items()}
    table = BestHarmTable(table.identity, worse, table.profiles, table.header)
    universal = eb.make_agent("universal", scenario=SCENARIO)
    after = lowered(table, GAME, WORLDS, {"first": universal}, "universal")
    driven = eb.evaluate(WORLDS, {"universal": universal}, scenario=SCENARIO)["universal"]
    for count in ("first", "total"):
        column = driven["first_impact_harm" if count == "first" else "total_harm"]
        assert (
            after.harm[count].tolist()
            == np.where(column < table.harm[count] - 1e-6, column, table.harm[count]).tolist()
        )
        assert after.header["lowered_by"]["universal"][count] == (after.harm[count] < table.harm[count]).sum()
        less = after.harm[count] < table.harm[count]
        assert PROBLEM.values(after.profiles[count])[count][less].tolist() == after.harm[count][less].tolist()
    assert sum(after.header["lowered_by"]["universal"].values()) > 0
    other = BestHarmTable(table.identity, table.harm, table.profiles, {**table.header, "objective": "own"})
    with refused("the table holds values of the objective 'own'"):
        lowered(other, GAME, WORLDS, {"first": universal}, "universal")


def changed(change: Callable[[dict[str, Any]], object]) -> Callable[[BestHarmTable], bytes]:
    def content(table: BestHarmTable) -> bytes:
        with np.load(io.BytesIO(table.content())) as archive:
            arrays = dict(archive)
        change(arrays)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        return buffer.getvalue()

    return content


def put(name: str, row: int, value: Any) -> Callable[[BestHarmTable], bytes]:
    return changed(lambda arrays: arrays[name].__setitem__(row, value))


def header(**entries: Any) -> Callable[[BestHarmTable], bytes]:
    return changed(lambda arrays: arrays.update(header=np.frombuffer(json.dumps(entries).encode(), np.uint8)))


DAMAGED: dict[str, Callable[[BestHarmTable], bytes]] = {
    "header: must be an object with the entry format: 1": header(format=2),
    "header: must be an object with the entry format": header(format=True),
    "first_harm: must be finite and at least 0 m2/s2": put("first_harm", 2, np.nan),
    "total_harm: must be finite and at least 0 m2/s2": put("total_harm", 0, -1.0),
    "first_commands: must be finite": changed(lambda arrays: arrays["first_commands"].fill(255)),
    "first_phases: ": put("first_phases", 1, 40),
    "total_phases: ": put("total_phases", 1, 0),
    "first_ends: must not decrease within a world": changed(
        lambda arrays: arrays.update(first_ends=arrays["first_ends"][::-1])
    ),
    "array 'total_commands': must not be in this file": changed(lambda arrays: arrays.pop("total_harm")),
    "identity": changed(lambda arrays: arrays.update(identity=arrays["identity"].astype(np.int32))),
    "is not a table of best known harm": lambda table: table.content()[:-40],
}  # fmt: skip


@pytest.mark.parametrize("message", DAMAGED)
def test_load__refuses_what_is_no_table(table: BestHarmTable, tmp_path: Path, message: str) -> None:
    (tmp_path / "t.npz").write_bytes(DAMAGED[message](table))
    with refused(message, CorruptBundle):
        BestHarmTable.load(tmp_path / "t.npz")


def test_load__refuses_a_missing_file(tmp_path: Path) -> None:
    with refused("there is no such file; give the file of a table"):
        BestHarmTable.load(tmp_path / "t.npz")
