"""The tables of best known harm that travel with the package, and the agent that drives their profiles."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from ethbrake_marl.agents.best_profile import SEARCH_BUDGET, BestHarm
from ethbrake_marl.agents.planner import MOST_CANDIDATES
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.registry import AgentSettings
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.limits.best_harm import world_identity
from ethbrake_marl.limits.best_harm_table import BestHarmTable, load_table
from ethbrake_marl.physics import Bools, Floats, Worlds
from ethbrake_marl.scenario import Task
from ethbrake_marl.search.problem import ProfileProblem
from ethbrake_marl.search.profiles import Profiles, pad_profiles

TABLES = Path(__file__).resolve().parents[1] / "_tables" / "best_harm"


@cache
def shipped_tables() -> tuple[BestHarmTable, ...]:
    """Every shipped table, by name of its file."""
    return tuple(load_table(path) for path in sorted(TABLES.glob("*.npz")))


def best_known(worlds: Worlds, task: Task) -> dict[HarmCount, Floats]:
    """The least harm known in each world (at t = 0) under each count, [n] m2/s2; NaN where no shipped table holds it.

    Worlds are recognised by everything their harm depends on: state, parameters, the others' scripts, time step,
    horizon and the driven vehicles. Raises ``InvalidInput`` for a script whose command is not fixed at the alert, as no
    search knows it.
    """
    identity = world_identity(worlds, task)
    known = {harm_count: np.full(worlds.n, np.nan) for harm_count in HARM_COUNTS}
    for table in shipped_tables():
        known = {harm_count: np.fmin(harm, table.harm(identity, harm_count)) for harm_count, harm in known.items()}
    return known


def shipped_profiles(problem: ProfileProblem, harm_count: HarmCount) -> tuple[Profiles, Bools]:
    """Kept profiles of a problem with one controlled vehicle, [n], and where there is one, [n]."""
    last_step = problem.last_step
    profiles, known = Profiles(last_step[:, np.newaxis].copy(), np.zeros((problem.n, 1, 1))), np.zeros(problem.n, bool)
    for table in shipped_tables():
        kept, here = table.profiles(problem.identity, harm_count, last_step)
        profiles, kept = pad_profiles([profiles, kept], 1)
        profiles.ends[here] = kept.ends[here]
        profiles.commands_mps2[here] = kept.commands_mps2[here]
        known |= here
    return profiles, known


def make_best_harm(argument: str | None, settings: AgentSettings) -> Agent:
    """``best_harm[:candidates]``: the shipped profile, or a search with so many candidates where there is none."""
    number = SEARCH_BUDGET if argument is None else parse_numeral(argument)
    if number is None or (argument is not None and not argument.isdecimal()) or not 1 <= number <= MOST_CANDIDATES:
        raise InvalidInput(
            f"agent 'best_harm:{argument}': the argument must be a number of candidates, for instance {SEARCH_BUDGET},"
            f" at most {MOST_CANDIDATES:,}"
        )
    budget = int(number) if settings.most_candidates is None else min(int(number), settings.most_candidates)
    return BestHarm(
        shipped_profiles, harm_count=settings.harm_count, horizon_s=settings.horizon_s, budget=budget,
        time_step_s=settings.time_step_s,
    )  # fmt: skip
