"""The shipped tables of best known harm."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from ethbrake_marl.extensions.search.best_harm import task_problem
from ethbrake_marl.extensions.search.tables import BestHarmTable
from ethbrake_marl.first_edition.engine.profiles import ProfileProblem, Profiles
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Worlds
from ethbrake_marl.first_edition.scenario.task import Task

TABLES = Path(__file__).with_name("_tables")


@cache
def shipped_tables() -> tuple[BestHarmTable, ...]:
    """Return every shipped table, sorted by file name."""
    return tuple(BestHarmTable.load(path) for path in sorted(TABLES.glob("*.npz")))


def best_known(worlds: Worlds, task: Task) -> dict[HarmCount, Floats]:
    """Return the best known harm of worlds at t = 0 from the shipped tables, for each harm count, [n] m2/s2.

    The harm is NaN if no shipped table contains the world. The tables identify a world by a hash of everything that
    affects its harm: state, parameters, scripts of the other vehicles, time step, horizon and controlled vehicles.
    Raises ``InvalidInput`` if a script's command is not fixed at the alert.
    """
    identity = task_problem(worlds, task).identity
    known = {harm_count: np.full(worlds.n, np.nan) for harm_count in HARM_COUNTS}
    for table in shipped_tables():
        known = {harm_count: np.fmin(harm, table.harm(identity, harm_count)) for harm_count, harm in known.items()}
    return known


def shipped_profiles(problem: ProfileProblem, harm_count: HarmCount) -> tuple[Profiles, Bools]:
    """Return the stored profile of each world of ``problem``, and a mask [n]: True for worlds with a stored profile.

    ``problem`` has one controlled vehicle.
    """
    last_step, least = problem.last_step, np.full(problem.n, np.inf)
    profiles, known = Profiles(last_step[:, np.newaxis].copy(), np.zeros((problem.n, 1, 1))), np.zeros(problem.n, bool)
    for table in shipped_tables():
        stored, here = table.profiles(problem.identity, harm_count, last_step)
        harm = table.harm(problem.identity, harm_count)
        here &= np.nan_to_num(harm, nan=np.inf) < least
        least[here] = harm[here]
        profiles, stored = Profiles.padded([profiles, stored], 1)
        profiles.ends[here] = stored.ends[here]
        profiles.commands_mps2[here] = stored.commands_mps2[here]
        known |= here
    return profiles, known
