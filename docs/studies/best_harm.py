"""Search the least harm of every world of a list and save a table, or print the shipped tables.

``python docs/studies/best_harm.py --scenario paper-random --episodes 1000 --output paper-random.npz`` searches a list.
With ``--output``, finished chunks are saved beside the file, and the same command continues after an interruption.
``--merge`` takes the better of several tables in each world, so that searches with other seeds add up.
``--shipped`` prints proven and best known harm of every shipped table that has harm, and the gap between them.
``--restamp`` renews the digest of the physics in every shipped table whose harms are still the same, bit for bit.
"""

from __future__ import annotations

import argparse
import shlex
import shutil
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.agent_names import make_teams, open_game
from ethbrake_marl.episode.counts import COUNTS, IMPACT_COUNTS, HarmCount
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.extensions.proofs.measures import contact_avoidable, proven_harm
from ethbrake_marl.extensions.search.best_harm import SEARCH_BUDGET, search_list
from ethbrake_marl.extensions.search.pricing import best_of, problem_of
from ethbrake_marl.extensions.search.tables import TABLE_FOLDER, BestHarmTable, outdated_tables, shipped_tables
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.files.store import check_target
from ethbrake_marl.motion.digest import physics_digest
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.scenario import Scenario

NO_HARM = 1e-3  # less total harm (m2/s2), an impact at 0.03 m/s, counts as next to none


def main(words: list[str]) -> None:
    """Search a list and print the mean harms, or print the shipped tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--shipped", action="store_true", help="print the shipped tables instead")
    add("--restamp", action="store_true", help="after a change of the physics' code: renew the shipped tables' digests")
    add("--scenario", default="paper-random")
    add("--episodes", type=int, default=10_000, help="worlds of the list")
    add("--seed", type=int, default=7, help="seed of the list")
    add(
        "--harm-count",
        choices=[*COUNTS],
        help="count to minimise; default: those of --start, or both harms. Other counts of --start stay as they are",
    )
    add("--vehicles", metavar="A,B,...", help="vehicles to control together; default: the learners")
    add("--budget", type=int, default=SEARCH_BUDGET, help="candidate profiles per world and count")
    add("--search-seed", type=int, default=0)
    add("--threads", type=int, help="worlds searched at the same time; changes no result")
    add("--start", type=Path, metavar="FILE.npz", help="a table to start from; no world gets more harm")
    add("--agents", default="", metavar="A,B,...", help="agents that the search also starts from")
    add("--output", type=Path, metavar="FILE.npz", help="the table to write")
    add(
        "--merge",
        nargs="+",
        type=Path,
        metavar="FILE.npz",
        help="search nothing: the best of these tables in each world",
    )
    given = parser.parse_args(words)
    if given.restamp:
        sys.exit(0 if restamp(TABLE_FOLDER) else 1)
    if given.shipped:
        if outdated := outdated_tables():
            print(f"left out, because they were made for other physics: {', '.join(outdated)}", file=sys.stderr)
        sheet = shipped_bounds(table for table in shipped_tables() if "total" in table.harm)
        heads = [column if isinstance(column, str) else column.heading for column in sheet.columns]
        print(
            "\n".join(
                f"| {' | '.join(row)} |" for row in (heads, *([c.in_words for c in r] for r in sheet.formatted_rows()))
            )
        )
        return
    names = [Path(word).name if word.endswith(".npz") else word for word in words]  # without folders
    command = shlex.join(["docs/studies/best_harm.py", *names])
    table = merged(given.merge, command) if given.merge else search(given, command)
    for key, value in table.header.items():
        print(f"{key:28} {value}")
    for count, harm in table.harm.items():
        print(f"{f'best known harm, {count}':28} {harm.mean():.4f} m2/s2, {(harm == 0.0).mean():.1%} of worlds without")
    if given.output is not None:
        table.save(given.output)
        shutil.rmtree(parts_beside(given.output), ignore_errors=True)
        print(f"every world: {given.output}", file=sys.stderr)


def parts_beside(output: Path) -> Path:
    """Folder of the finished chunks of a search."""
    return output.with_name(f".{output.name}.parts")


def search(given: argparse.Namespace, command: str) -> BestHarmTable:
    """Table that the arguments ask for."""
    if given.output is not None:
        check_target(given.output)
    scenario, game = open_game(given.scenario, given.vehicles and given.vehicles.split(","))
    if not scenario.learners:
        raise InvalidInput(f"scenario {scenario.name!r} has no learner; give vehicles to control: --vehicles vehicle_2")
    alert = scenario.sample(given.episodes, seed=given.seed)
    known = None if given.start is None else BestHarmTable.load(given.start)
    counts = (given.harm_count,) if given.harm_count else IMPACT_COUNTS if known is None else tuple(known.harm)
    teams = [make_teams(given.agents, scenario, harm_count=count) if given.agents else {} for count in counts]
    table = search_list(
        game, alert, chunks=None if given.output is None else parts_beside(given.output), harm_counts=counts,
        budget=given.budget, seed=given.search_seed, threads=given.threads, known_table=known,
        teams=[team for each in teams for team in each.values()],
    )  # fmt: skip
    header = {**table.header, "episodes": given.episodes, "list_seed": given.seed, "command": command}
    header |= {} if known is None else {"after": known.header.get("command", "a table without a command")}
    harm, profiles = dict(table.harm), dict(table.profiles)
    for count in known.harm if known is not None else ():
        if count not in harm:  # stays as it was
            harm[count], profiles[count] = known.stored(problem_of(game, alert), HarmCount.of(count))
    return BestHarmTable(table.identity, harm, profiles, header)


def merged(paths: Sequence[Path], command: str) -> BestHarmTable:
    """Best of several tables of the same worlds, world by world, in the counts of the first."""
    first, *others = tables = [BestHarmTable.load(path) for path in paths]
    if any(not np.array_equal(each.identity, first.identity) for each in others):
        raise InvalidInput("--merge: the tables are of different worlds")
    harm, profiles = {}, {}
    for count in first.harm:
        harm[count], profiles[count] = best_of([(t.harm[count], t.profiles[count]) for t in tables if count in t.harm])
    after = " | ".join(str(table.header.get("command", "a table without a command")) for table in tables)
    return BestHarmTable(first.identity, harm, profiles, {**first.header, "command": command, "after": after})


def worlds_of(table: BestHarmTable) -> tuple[Scenario, Game, State]:
    """Shipped scenario that a table's header names, its game, and the table's list of worlds."""
    scenario, game = open_game(load_scenario(table.header["scenario"]), table.header["vehicles"])
    return scenario, game, scenario.sample(int(table.header["episodes"]), seed=int(table.header["list_seed"]))


def restamp(folder: Path) -> bool:
    """Write this installation's digest of the physics into the tables of a folder whose harms it gives bit for bit.

    Prints a line for each table. Returns whether it wrote all.
    """
    refusals = []
    for path in sorted(folder.glob("*.npz")):
        table = BestHarmTable.load(path)
        refusals.append(difference(table))
        if not refusals[-1]:
            replace(table, header={**table.header, "physics": physics_digest()}).save(path)
        print(f"{path.stem}: {refusals[-1] or f'same bits, physics {physics_digest()}'}")
    return not any(refusals)


def difference(table: BestHarmTable) -> str:
    """Replay every profile of a table; return in words which harms differ, by any bit. Empty: none."""
    _, game, alert = worlds_of(table)
    problem = problem_of(game, alert)
    if not np.array_equal(problem.identity, table.identity):
        return "NOT renewed: its worlds are not those of its list"
    try:
        again = {count: problem.values(profiles)[count] for count, profiles in table.profiles.items()}
    except PhysicsError as error:
        return f"NOT renewed: {error}"
    changed = {count: int((again[count] != harm).sum()) for count, harm in table.harm.items()}
    words = ", ".join(f"{number:,} of {alert.n:,} ({count})" for count, number in changed.items() if number)
    return words and f"NOT renewed: other harms in worlds: {words}; search the list again"


# *Contact certain* is not *impact proven*. In the worlds between the two, every command leads to contact, but perhaps
# not to an impact. Either leaning without an impact is possible there, or the proof is loose. The harm of the best
# known profiles in these worlds shows which: almost no harm, or much harm.


def proven(game: Game, alert: State, first: Floats, total: Floats) -> list[Any]:
    """Mean proven harm, rates of proven contact and impact, and of worlds between; and what is known there."""
    try:
        bound, verdict = proven_harm(game, alert, alert), contact_avoidable(game, alert, alert)
    except InvalidInput:
        return [None] * 6
    assert isinstance(bound, dict) and isinstance(verdict, dict)
    between = ~verdict[""] & ~bound["impact"]
    there = [float(first[between].mean()), float((total[between] < NO_HARM).mean())] if between.any() else [None, None]
    rates = (float(each.mean()) for each in (~verdict[""], bound["impact"], between))
    return [float(bound[""].mean()), *rates, *there]


def shipped_bounds(tables: Iterable[BestHarmTable]) -> Sheet:
    """Best known harm, proven harm and the gap of every table, as a sheet of means.

    gap = (best known harm - proven harm) / best known harm. The header of a table names a shipped scenario and a list
    of its worlds. Raises ``InvalidInput`` if the table holds none of these worlds.
    """
    harm, share = partial(Column, digits=3), partial(Column, digits=1, scale=100.0, unit=" %")
    columns = (
        "list", Column("worlds"), harm("proven"), harm("best known, first"), share("gap"),
        harm("best known, total"), share("gap"), share("contact certain"),
        share("impact proven"), share("between"), harm("best known there, first"),
        share("next to none there"),
    )  # fmt: skip
    rows = []
    for table in tables:
        scenario, game, alert = worlds_of(table)
        table.check_holds_any(problem_of(game, alert).identity)
        first, total = table.harm["first"], table.harm["total"]
        least, *rates = proven(game, alert, first, total)
        means = [float(np.mean(each)) for each in (first, total)]
        gaps = [None if least is None else 1.0 - least / mean for mean in means]
        rows.append((
            f"{scenario.name} (seed {table.header['list_seed']})", f"{alert.n:,}", least, means[0], gaps[0], means[1],
            gaps[1], *rates,
        ))  # fmt: skip
    return Sheet("", columns, rows)


if __name__ == "__main__":
    main(sys.argv[1:])
