"""Episodes on the page of an ablation: the same few lines of vehicles, driven level by level."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ethbrake_marl.agents.team import Driver, Team
from ethbrake_marl.errors import count_of
from ethbrake_marl.learning.team_file import load_team
from ethbrake_marl.pages.chosen import Chosen, drive_played
from ethbrake_marl.pages.frame import Section
from ethbrake_marl.pages.player import Played, player
from ethbrake_marl.studies.ablation.plan import Level, Plan, Training
from ethbrake_marl.studies.ablation.run import Measured

_MOST, _USUAL, _LEAST = 3, 2, 2  # worlds in which most, as usual and least is saved


def choose_worlds(measured: Sequence[Measured]) -> list[Chosen]:
    """A few worlds by what the last level of the ladder saves against the first, in total harm, of the first seed."""
    ladder = [one for one in measured if one.level.clear is None]
    first, last = ladder[0], ladder[-1]
    before, after = (one.reached.world["total"][0] for one in (first, last))
    order = np.argsort(after - before, kind="stable")
    middle = max((len(order) - _USUAL) // 2, 0)
    kinds = (
        (f"Where {last.level.name} saves most against {first.level.name}", order[:_MOST]),
        ("As usual", order[middle : middle + _USUAL]),
        ("Where it saves least, or harms", order[::-1][:_LEAST]),
    )
    found: dict[int, Chosen] = {}
    for kind, rows in kinds:
        for row in map(int, rows):
            why = f"total harm {before[row]:.2f} to {after[row]:.2f}"
            found.setdefault(row, Chosen(row, kind, why))
    return list(found.values())


def episodes_section(plan: Plan, measured: Sequence[Measured]) -> Section:
    """A few worlds of the ablation to watch, level beside level; each trained level by its first seed."""
    chosen = choose_worlds(measured)
    rows = np.array([each.row for each in chosen], np.int64)
    played = [Played(each.row, each.kind, each.why, {}, {}) for each in chosen]
    driven: dict[str, tuple[int, ...]] = {}
    for name, level, driver, spelling in _drivers(plan):
        worlds = level.scenario.sample(plan.episodes, plan.list_seed).worlds.take(rows)
        drive_played(played, worlds, name, driver, level.scenario, spelling, seed=plan.list_seed)
        driven[name] = level.scenario.learners
    told = (
        f"{count_of(len(chosen), 'world')}, the same line at every level; of several seeds the first drives."
        f" The conditions are those of {plan.levels[0].name}: delays of messages and an obstacle ahead are each"
        " level's own."
    )
    return Section("Episodes", [told, player(played, driven)])


def _drivers(plan: Plan) -> Iterator[tuple[str, Level, Driver, str]]:
    """Name, level, who drives and how that is written on a command line, level by level."""
    trained: dict[tuple[str, str], Training] = {}
    for training in plan.trainings():
        trained.setdefault((training.level.name, training.algorithm), training)
    for level in plan.levels:
        if not level.trained:  # who drives nobody changes nothing
            yield level.name, level, Team({}, level.name), "full_brake"
            continue
        for algorithm in plan.algorithms:
            training = trained[level.name, algorithm]
            name = level.name if len(plan.algorithms) == 1 else f"{level.name}, {algorithm}"
            team = load_team(training.folder, level.scenario, name)
            yield name, level, team, f"{training.recipe.algorithm}@{training.folder}"
