"""Harm, honest cost and processor time of agents on the same worlds, for docs/findings.md.

    .venv/bin/python docs/studies/equal_time.py [AGENT ...]

Agents that search minimise the honest cost. All agents are compared with the first one: harms and cost are divided by
its own. The time is for whole episodes: the work at the alert, all decisions, and the motion of the worlds. No shipped
table contains the worlds of this list, so ``best_harm:K`` has to search.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.evaluation.evaluate import known_by
from ethbrake_marl.evaluation.statistics import difference
from ethbrake_marl.extensions.studies.machine import this_machine
from ethbrake_marl.names import make_teams

AGENTS = ("universal", "universal+search", "best_harm:1000", "best_harm:40000")
WORLDS, SEED, REPEATS = 1000, 8, 2
AT_ONCE = 500  # worlds simulated together, equal for all agents
HEAD = ("agent", "knows", "CPU, ms per world", "first-impact harm", "total harm", "honest cost", "difference")


def drive(
    worlds: eb.State, teams: Mapping[str, eb.Team], game: eb.Game, repeats: int
) -> dict[str, tuple[float, eb.State]]:
    """Median processor time per world (ms) and the last states of every team. The teams drive in turn."""
    parts = [worlds.take(slice(first, first + AT_ONCE)) for first in range(0, worlds.n, AT_ONCE)]
    for team in teams.values():
        eb.play_to_end(
            game, worlds.take(slice(0, 2)), team
        )  # compiles kernels and reads tables, before the measurement
    spent: dict[str, list[float]] = {name: [] for name in teams}
    last = {}
    for _ in range(repeats):
        for name, team in teams.items():
            begin = time.process_time()
            last[name] = [eb.play_to_end(game, part, team) for part in parts]
            spent[name].append(1e3 * (time.process_time() - begin) / worlds.n)
    return {name: (float(np.median(spent[name])), eb.State.join(_plain(last[name]))) for name in teams}


def _plain(states: Sequence[eb.State]) -> list[eb.State]:
    return [state._replace(memories={}) for state in states]


def rows_of(driven: Mapping[str, tuple[float, eb.State]], teams: Mapping[str, eb.Team]) -> list[Sequence[str]]:
    """Rows of the table, fastest team first.

    The difference in honest cost from the first team is paired by world, with its 95 % interval.
    """
    against, rows = next(iter(teams)), []
    for name, (spent_ms, last) in sorted(driven.items(), key=lambda each: each[1][0]):
        change = difference(last.harm("honest"), driven[against][1].harm("honest"))
        low, high = change.interval or (change.value, change.value)
        shown = "" if name == against else f"{change.value:+.3f} [{low:+.3f}, {high:+.3f}]"
        means = [
            f"{100.0 * last.harm(count).mean() / driven[against][1].harm(count).mean():.1f} %"
            for count in ("first", "total", "honest")
        ]
        rows.append([f"`{name}`", known_by(teams[name]), f"{spent_ms:.2f}", *means, shown])
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("agents", nargs="*", default=AGENTS)
    scenario, game = eb.open_game("paper-random")
    teams = make_teams(parser.parse_args().agents, scenario, harm_count="honest")
    rows = rows_of(drive(scenario.sample(WORLDS, SEED), teams, game, REPEATS), teams)
    print("\n".join(f"| {' | '.join(cells)} |" for cells in (HEAD, ["---"] * len(HEAD), *rows)))
    print(f"\nMachine: {this_machine()}")
